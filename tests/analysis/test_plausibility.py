"""What looks wrong is said, and nothing else: planted mistakes, and cases that are right."""

import math
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from tests.modules import ROOT

BRIDGE = dict(length=25.0, flexural_rigidity=30e9, mass_per_length=15e3, damping_ratio=0.015)
RIGHT_FILES = [
    *sorted((ROOT / "jaxbeam/rigs").glob("*.toml")),
    *sorted((ROOT / "examples").glob("*.toml")),
]


def bridge(beam=None, supports=(), load=None, run=None, sensors=None, **other) -> jb.Case:
    """A bridge of 25 m under a truck of 30 t at 90 km/h, with some numbers changed."""
    return jb.Case(
        jb.Beam(**BRIDGE | (beam or {})),
        supports=supports,
        sensors=[jb.Sensor(position=12.5)] if sensors is None else sensors,
        loads=[jb.MovingMass(**dict(mass=30e3, speed=25.0) | (load or {}))],
        run=jb.Run(**dict(duration=2.0) | (run or {})),
        **other,
    )


@pytest.mark.parametrize("path", RIGHT_FILES, ids=lambda path: path.stem)
def test_rigs_and_examples_are_plausible(path: Path):
    assert jb.check(jb.load_case(path)).warnings == ()


def test_the_demonstration_is_plausible():
    case = jb.load_case(ROOT / "jaxbeam/demo/rig.toml")
    assert jb.check(case).warnings == ()
    for mass, speed in ((0.05, 0.5), (0.6, 6.0)):
        loads = [jb.MovingMass(mass=mass, speed=speed)]
        assert jb.check(jb.Case(case.beam, sensors=case.sensors, loads=loads)).warnings[1:] == ()


def test_numbers_are_those_of_the_closed_forms():
    found = jb.check(bridge(beam={"modes": 30}))
    EI, m, L, P = 30e9, 15e3, 25.0, 30e3 * 9.81
    first = math.pi / 2 / L**2 * math.sqrt(EI / m)
    assert found.warnings == ()
    assert found.first_frequency == pytest.approx(first, rel=1e-9)
    assert found.deflection == pytest.approx(P * L**3 / 48 / EI, rel=1e-4)
    assert found.span_over_deflection == pytest.approx(L / (P * L**3 / 48 / EI), rel=1e-4)
    assert found.own_deflection == pytest.approx(5 / 384 * m * 9.81 * L**4 / EI, rel=1e-3)
    assert found.mass_ratio == pytest.approx(30e3 / (m * L))
    assert found.crossing_time == pytest.approx(1.0)
    assert found.critical_speed == pytest.approx(math.pi / L * math.sqrt(EI / m))
    assert found.speed_ratio == pytest.approx(25.0 / found.critical_speed)
    assert f"{first:.4g} Hz" in str(found)


MISTAKES = {
    "EI in kN m^2": (bridge(beam={"flexural_rigidity": 30e6}), "not in kN m^2"),
    "EI in GN m^2": (bridge(beam={"flexural_rigidity": 30.0}), "more than its length"),
    "length in mm": (bridge(beam={"length": 25e3}), "beam.length in m"),
    "mass in t": (bridge(load={"mass": 30.0}), "not in t"),
    "beam in t/m": (bridge(beam={"mass_per_length": 15.0}), "not in t/m"),
    "damping in per cent": (bridge(beam={"damping_ratio": 2.0}), "0.01 for one per cent"),
    "damping of one": (bridge(beam={"damping_ratio": 1.0}), "0.01 for one per cent"),
    "speed in km/h": (bridge(load={"speed": 200.0}), "not in km/h"),
    "truck in km/h": (
        bridge(profile=jb.ISO8608Profile(road_class="A"), load={"speed": 80.0}),
        "faster than any road vehicle",
    ),
    "short run": (bridge(run={"duration": 0.5}), "has not left the beam by the end"),
    "late entry": (bridge(load={"entry_time": 10.0}), "loads.0 never enters the beam"),
    "no sensors": (bridge(sensors=[]), "there are no sensors"),
    "two supports": (
        bridge(supports=[jb.Support(position=x) for x in (10.0, 10.00001)]),
        "supports.0 and supports.1 are only 1e-05 m apart, and clamp",
    ),
    "support at the end": (
        bridge(supports=[jb.Support(position=0.01, stiffness=1e15)]),
        "the left end and supports.0",
    ),
    "f above 10 kHz": (
        bridge(beam={"length": 0.025, "flexural_rigidity": 30e9}, sensors=[]),
        "the first frequency is",
    ),
    "Rayleigh": (
        bridge(beam={"damping_ratio": 0.0, "rayleigh_damping": [20.0, 0.0]}),
        "beam.rayleigh_damping",
    ),
    "loss factor in per cent": (
        bridge(beam={"damping_ratio": 0.0, "loss_factor": 2.0}),
        "the loss factor of the beam makes a damping ratio of 1",
    ),
    "settlement in mm": (
        bridge(supports=[jb.Support(12.5, settlement=20.0)]),
        "is supports.0.settlement in m, not in mm?",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_planted_mistakes_are_found(mistake):
    case, words = MISTAKES[mistake]
    found = jb.check(case).warnings
    assert any(words in warning for warning in found), found


def test_soft_springs_beside_each_other_do_not_clamp():
    springs = [jb.Support(position=x, stiffness=1e7) for x in (10.0, 10.01)]
    assert jb.check(bridge(supports=springs)).warnings == ()


def test_beams_that_are_not_held_and_cases_without_loads():
    free = jb.Case(jb.Beam(**BRIDGE | {"ends": "free-free"}), sensors=[jb.Sensor(position=1.0)])
    found = jb.check(free)
    assert (found.deflection, found.own_deflection, found.mass_ratio) == (None, None, None)
    first = 4.730040744862704**2 / (2 * math.pi) / 25.0**2 * math.sqrt(30e9 / 15e3)
    assert found.first_frequency == pytest.approx(first, rel=1e-6)
    assert found.warnings == ()


def test_a_run_without_a_load_on_the_beam_is_not_praised():
    record = jb.simulate(bridge(load={"entry_time": 10.0}, run={"duration": 4.0}))
    assert record.verdict.startswith("no load is on the beam during the run")
    assert np.all(record.deflection == 0)
