"""A train of unlike vehicles is its vehicles, one behind the other."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.loads.planar.vehicle import load_vehicle
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, case_to_dict

FIRST, SECOND = "quarter-truck", "half-truck"
SPEED, LENGTHS = 20.0, (6.0, 12.0)


def case_of(*loads) -> jb.Case:
    beam = jb.Beam(
        length=20.0, flexural_rigidity=1e10, mass_per_length=8000.0, damping_ratio=0.02, modes=2
    )
    road = jb.profiles.SineProfile(amplitude=3e-3, wavelength=4.0)
    run = jb.Run(duration=2.5, sample_rate=100.0)
    return jb.Case(beam, sensors=[jb.Sensor(10.0)], loads=loads, run=run, profile=road)


def train(**changes) -> jb.TrainLoad:
    coaches = [jb.Coach(FIRST, length=LENGTHS[0]), jb.Coach(SECOND, count=2, length=LENGTHS[1])]
    return dataclasses.replace(
        jb.TrainLoad(coaches=coaches, speed=SPEED, start_position=-1.0), **changes
    )


def test_a_train_is_its_vehicles():
    axles = load_vehicle(SECOND).axles
    wheelbase = float(axles[0].position - axles[-1].position)
    overhang = (LENGTHS[1] - wheelbase) / 2
    firsts = [0.0, LENGTHS[0] / 2 + overhang, LENGTHS[0] / 2 + overhang + LENGTHS[1]]
    alone = [
        jb.VehicleLoad(model, speed=SPEED, start_position=-1.0 - at)
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
        ({"coaches": (jb.Coach("half-car"),)}, r"coaches.0.model: there is no vehicle 'half-car'"),
        ({"coaches": (jb.Coach(FIRST),)}, r"coaches.0.length is missing, and quarter-truck has no"),
        (
            {"coaches": (jb.Coach(SECOND, length=1.0),)},
            r"coaches.0.length must exceed the wheelbase",
        ),
    ],
)
def test_bad_input(changes, words):
    with pytest.raises(ValueError, match=words):
        check_case(case_of(train(**changes)))
