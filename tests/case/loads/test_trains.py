"""Trains of the library against published sums and lengths, and an independent implementation."""

import dataclasses
import re

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.library.published import trains
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.loads.vehicles import load_vehicle
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, case_to_dict

GRAVITY = np.float64(9.81)

# Number of axles, sum of the loads (kN), distance of the outer axles less 0.025 m: README of KTH
# BeamDyn has the extremes 375.5 to 398.5 m and 7140 to 9600 kN.
HIGH_SPEED = {
    "HSLM-A1": (50, 8500, 397.5),
    "HSLM-A2": (48, 9600, 398.5),
    "HSLM-A3": (46, 8280, 397.5),
    "HSLM-A4": (44, 8360, 394.5),
    "HSLM-A5": (42, 7140, 389.5),
    "HSLM-A6": (40, 7200, 382.5),
    "HSLM-A7": (40, 7600, 397.5),
    "HSLM-A8": (38, 7220, 387.5),
    "HSLM-A9": (36, 7560, 375.5),
    "HSLM-A10": (36, 7560, 388.5),
}
# Axle load (kN) and axles behind the first of two coupled wagons (m), computed by an independent
# implementation from table A.1 of EN 15528.
WAGONS = {
    "EN15528-A": (156.96, [0.0, 1.8, 8.0, 9.8, 12.8, 14.6, 20.8, 22.6]),
    "EN15528-B2": (176.58, [0.0, 1.8, 6.45, 8.25, 11.25, 13.05, 17.7, 19.5]),
    "EN15528-C3": (196.2, [0.0, 1.8, 6.3, 8.1, 11.1, 12.9, 17.4, 19.2]),
    "EN15528-D2": (220.725, [0.0, 1.8, 9.25, 11.05, 14.05, 15.85, 23.3, 25.1]),
    "EN15528-D4": (220.725, [0.0, 1.8, 6.45, 8.25, 11.25, 13.05, 17.7, 19.5]),
    "EN15528-E4": (245.25, [0.0, 1.8, 7.7, 9.5, 12.5, 14.3, 20.2, 22.0]),
}


@pytest.mark.parametrize("name", HIGH_SPEED)
def test_high_speed_trains(name):
    axles, total, length = HIGH_SPEED[name]
    vehicle = Axles(train=name, speed=50.0).vehicle(GRAVITY)
    assert len(vehicle.offsets) == axles
    assert np.sum(vehicle.static_loads) == pytest.approx(1e3 * total)
    assert vehicle.offsets[-1] == pytest.approx(length + 0.025, abs=1e-9)
    np.testing.assert_allclose(np.diff(vehicle.offsets), np.diff(vehicle.offsets)[::-1], atol=1e-9)


@pytest.mark.parametrize(("lorry", "total"), [(1, 280), (2, 360), (4, 560), (5, 610)])
def test_frequent_lorries_weigh_what_programs_for_bridges_call_them(lorry, total):
    assert trains()[f"FLM2-lorry-{lorry}"].forces.sum() == 1e3 * total


def test_axles_of_the_first_universal_train():
    """As listed by an independent implementation; one bogie stands on each coupling of coaches."""
    expected = [0, 3, 14, 17, 20.525, 22.525, 35.7625, 37.7625, 53.7625, 55.7625, 71.7625, 73.7625]
    np.testing.assert_allclose(trains()["HSLM-A1"].offsets[:12], expected, atol=1e-12)


@pytest.mark.parametrize("name", WAGONS)
def test_line_categories(name):
    force, offsets = WAGONS[name]
    load = Axles(train=name, count=2, speed=20.0)
    vehicle = load.vehicle(GRAVITY)
    np.testing.assert_allclose(vehicle.static_loads, 1e3 * force, rtol=1e-12)
    row = (load.spacings()[:, None] + vehicle.offsets).ravel()
    np.testing.assert_allclose(row, offsets, atol=1e-12)


# Weight (kN) and length (m): EN 1991-2, 6.3.2; AASHTO LRFD, 3.6.1.2.
CODES = {"LM71-axles": (1000, 4.8), "HL93-truck": (325, 8.6), "HL93-tandem": (220, 1.2)}


@pytest.mark.parametrize("name", CODES)
def test_axles_of_codes(name):
    vehicle = Axles(train=name, speed=20.0).vehicle(GRAVITY)
    assert np.sum(vehicle.static_loads) / 1e3 == pytest.approx(CODES[name][0])
    assert vehicle.offsets[-1] == pytest.approx(CODES[name][1])


@pytest.mark.parametrize("name", trains())
def test_every_train_has_a_source_and_increasing_axles(name):
    train = trains()[name]
    assert "EN 1" in train.source
    assert "commit" in train.source or "table" in train.source
    assert train.offsets[0] == 0 and np.all(np.diff(train.offsets) > 0)
    assert (train.forces is None) != (train.masses is None)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"train": "HSLM-A11"}, "loads.0.train cannot be 'HSLM-A11'; did you mean 'HSLM-A1'"),
        ({"train": "HSLM-B"}, "'HSLM-B', which the library leaves out.*give positions and forces"),
        ({"train": "HSLM-A1", "count": 2}, "loads.0.count must be 1 for HSLM-A1.*whole train"),
        ({"train": "EN15528-A", "count": 2, "spacing": 9.0}, "exceed the wheelbase of the axles"),
        ({"train": "EN15528-A", "masses": 3.0}, "has both train and masses"),
    ],
)
def test_bad_input(settings, message):
    error = Axles(speed=20.0, **settings).validate("loads.0")
    assert error is not None and re.search(message, error), error


# A train of unlike vehicles is its vehicles, one behind the other.

FIRST, SECOND = "quarter-truck", "half-truck"
SPEED, LENGTHS = 20.0, (6.0, 12.0)


def case_of(*loads) -> jb.Case:
    beam = jb.Beam(
        length=20.0, flexural_rigidity=1e10, mass_per_length=8000.0, damping_ratio=0.02, modes=2
    )
    road = jb.profiles.SineProfile(amplitude=3e-3, wavelength=4.0)
    run = jb.Run(duration=2.5, sample_rate=100.0)
    return jb.Case(beam, sensors=[jb.Sensor(10.0)], loads=loads, run=run, profile=road)


def train(**changes) -> jb.vehicles.TrainLoad:
    coaches = [
        jb.vehicles.Coach(FIRST, length=LENGTHS[0]),
        jb.vehicles.Coach(SECOND, count=2, length=LENGTHS[1]),
    ]
    return dataclasses.replace(
        jb.vehicles.TrainLoad(coaches=coaches, speed=SPEED, start_position=-1.0), **changes
    )


def test_a_train_is_its_vehicles():
    axles = load_vehicle(SECOND).axles
    wheelbase = float(axles[0].position - axles[-1].position)
    overhang = (LENGTHS[1] - wheelbase) / 2
    firsts = [0.0, LENGTHS[0] / 2 + overhang, LENGTHS[0] / 2 + overhang + LENGTHS[1]]
    alone = [
        jb.vehicles.VehicleLoad(model, speed=SPEED, start_position=-1.0 - at)
        for model, at in zip((FIRST, SECOND, SECOND), firsts, strict=True)
    ]
    together, apart = jb.simulate(case_of(train())), jb.simulate(case_of(*alone))
    size = np.abs(apart.deflection).max()
    np.testing.assert_allclose(together.deflection, apart.deflection, atol=1e-6 * size)
    forces = np.asarray(apart.contact_force)
    np.testing.assert_allclose(together.contact_force, forces, atol=1e-5 * forces.max())
    assert together.bodies[-1].startswith("loads.0 coach 3 ")
    names = [name.split(" ", 3)[-1] for name in together.bodies]
    assert names == [name.split(" ", 1)[-1] for name in apart.bodies]


def test_in_case_files():
    table = {
        "kind": "train",
        "speed": 30.0,
        "coaches": [{"model": "ice3-coach"}, {"model": "ice3-middle-coach", "count": 2}],
    }
    beam = {"length": 20.0, "flexural_rigidity": 1e10, "mass_per_length": 8000.0}
    case = case_from_dict({"beam": beam, "loads": [table]})
    check_case(case)
    assert case_to_dict(case)["loads"][0]["coaches"][1] == {
        "model": "ice3-middle-coach",
        "count": 2,
    }
    assert case.loads[0].vehicle(np.float64(9.81)).static_loads.shape == (12,)


def test_vehicle_files_are_relative_to_the_case_file(tmp_path):
    axle = '[[axles]]\nbody = "body"\nposition = 0.0\nsuspension_stiffness = 1e6\n'
    (tmp_path / "own.toml").write_text(f'[[bodies]]\nname = "body"\nmass = 1e4\n{axle}')
    load = '[[loads]]\nkind = "train"\nspeed = 20.0\n[[loads.coaches]]\nmodel = "own.toml"\n'
    beam = "[beam]\nlength = 20.0\nflexural_rigidity = 1e10\nmass_per_length = 8000.0\n"
    (tmp_path / "case.toml").write_text(f"{beam}{load}length = 8.0\n")
    case = jb.load_case(tmp_path / "case.toml")
    assert float(case.loads[0].vehicle(np.float64(10.0)).static_loads[0]) == pytest.approx(1e5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"coaches": ()}, r"loads.0.coaches has no entry"),
        (
            {"coaches": (jb.vehicles.Coach("half-car"),)},
            r"coaches.0.model: there is no vehicle 'half-car'",
        ),
        (
            {"coaches": (jb.vehicles.Coach(FIRST),)},
            r"coaches.0.length is missing, and quarter-truck has no",
        ),
        (
            {"coaches": (jb.vehicles.Coach(SECOND, length=1.0),)},
            r"coaches.0.length must exceed the wheelbase",
        ),
    ],
)
def test_faulty_trains_of_loads(changes, words):
    with pytest.raises(ValueError, match=words):
        check_case(case_of(train(**changes)))
