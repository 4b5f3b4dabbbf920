"""Logs matched with cases: loads that must have crossed, or stay on the beam."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from tests.tuning.small_rig import rig
from tuning import Log
from tuning.logs.pairing import case_of_log, check_loads, pad_cases

TIMES = np.linspace(0.0, 0.5, 51)
LOG = Log(TIMES, np.zeros((51, 1)), ("w",), ("deflection",), ("m",), "run.csv")


def case_with(load) -> jb.Case:
    """The small rig without its controller, crossed by a load."""
    return dataclasses.replace(rig(), controller=None, loads=(load,))


def test_a_load_that_stops_on_the_beam_need_not_leave_it():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5, deceleration=5.0)))


def test_a_load_that_leaves_the_beam_must_do_so_within_the_log():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5)))
    with pytest.raises(ValueError, match="before the first load has crossed at 0.6 s"):
        check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.0)))


@pytest.fixture
def shaken_beside_a_spring() -> tuple[jb.Case, Log]:
    """A spring before the patch, and a log of the patch's voltage."""
    rig = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
        actuators=[
            jb.SpringDamper(0.5, stiffness=3000.0, damping=5.0),
            jb.Patch(0.2, 0.3, 0.15, limits=(-3.0, 3.0)),
        ],
        sensors=[jb.Sensor(0.3)],
    )
    times = np.arange(5) * 0.01
    values = np.stack([np.zeros(5), [0.0, 1.0, 2.0, 1.0, 0.5]], axis=1)
    columns = ("w", "u"), ("deflection", "voltage"), ("m", "V"), "shaking"
    return rig, Log(times, values, *columns, loads=(), sensors=(0, None), actuators=(None, 1))


def test_springs_take_no_logged_command(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    times = np.arange(7) * 0.01
    shaken = case_of_log(rig, log, times)
    check_case(shaken)
    np.testing.assert_array_equal(shaken.controller.values, [[0.0, 1.0, 2.0, 1.0, 0.5, 0.5, 0.5]])
    idle, _ = pad_cases([rig, shaken], [times, times])
    check_case(idle)
    assert np.all(idle.controller.values == np.zeros((1, 7)))
    # As a shaker of that suspension with zero volts: the same deflections.
    shaker = jb.Shaker(0.5, stiffness=3000.0, damping=5.0)
    other = dataclasses.replace(rig, actuators=(shaker, rig.actuators[1]))
    run, expected = (jb.simulate(case_of_log(c, log, log.times)) for c in (rig, other))
    np.testing.assert_allclose(
        run.deflection, expected.deflection, rtol=0, atol=1e-12 * np.abs(expected.deflection).max()
    )


def test_a_command_to_a_spring_is_refused(shaken_beside_a_spring):
    rig, log = shaken_beside_a_spring
    wrong = dataclasses.replace(log, actuators=(None, 0))
    with pytest.raises(ValueError, match="u is the command to actuators.0, a spring, which takes"):
        case_of_log(rig, wrong, log.times)
