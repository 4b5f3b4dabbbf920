"""Oscillation of commands in unstable loops; loops that stationary loads make unstable."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.limit_cycles import command_oscillations, count_oscillations, turning_points
from jaxbeam.analysis.margins import stability_margin
from jaxbeam.rigs import load
from jaxbeam.simulation.integration_plan import integration_plan

TIMES = np.arange(2001) / 1000


def test_turning_points_leave_out_small_reversals():
    small = 0.05 * np.sin(2 * np.pi * 40 * TIMES)
    slow = np.sin(2 * np.pi * 1.0 * TIMES)
    turns = turning_points(slow + small)
    assert_allclose(TIMES[turns], [0.25, 0.75, 1.25, 1.75], atol=0.02)
    assert turning_points(TIMES) == turning_points(0 * TIMES) == []
    assert turning_points(np.where(TIMES > 1, np.nan, slow)) == []


def test_oscillations_are_counted_beyond_those_of_the_deflection():
    growing, zero = np.exp(TIMES) * np.sin(2 * np.pi * 9.0 * TIMES), np.zeros(TIMES.size)
    unlimited = count_oscillations(TIMES, growing, zero > 0, zero)
    assert unlimited.oscillates and not unlimited.limit_cycle
    assert_allclose(unlimited.frequency, 9.0, rtol=0.02)
    limited = count_oscillations(TIMES, np.clip(growing, -2, 2), np.abs(growing) >= 2, zero)
    assert limited.limit_cycle and limited.at_limits > 10
    forced = count_oscillations(TIMES, -growing, zero > 0, growing)
    assert forced.extra == 0 and not forced.oscillates


def unstable_case(gain: float, delay: float | None, damping: float) -> jb.Case:
    """Two spans under the cubic law, through filters of 20 Hz, as in section 6.2."""
    case = load("C")
    filtered = jb.Filter(20.0, order=10, realisation="analogue")
    sensors = tuple(dataclasses.replace(sensor, filter=filtered) for sensor in case.sensors)
    law = jb.Feedback([gain * 1e9] * 2, power=3, period=0.002, delay=delay)
    case = dataclasses.replace(case, sensors=sensors, controller=law)
    return jb.replace(case, {"beam.damping_ratio": damping})


def test_growth_rate_with_stationary_load_against_reference():
    """Rightmost pole of 0.509 kg at midspan, linear law with k = 2, filter of 10 Hz, 5 modes."""
    case = jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=5),
        actuators=[jb.Patch(0.2575, 0.3425, 2.65358032154821e-4, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.3, filter=jb.Filter(10.0, 10, realisation="analogue"))],
        loads=[jb.MovingMass(mass=0.509, speed=0.5)],
        controller=jb.Feedback([2e3]),
        run=jb.Run(1.2),
    )
    unstable = stability_margin(case).unstable
    assert unstable is not None and unstable.start < 0.6 < unstable.end
    assert_allclose(unstable.rate, 0.6891684603605122, rtol=1e-6)
    assert_allclose(2 * np.pi * unstable.frequency, 62.83126204745206, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_high_gain_has_published_limit_cycle():
    """k = 3, 30 ms of delay and low damping: unstable from 0.322 kg, not at 0.261 kg.

    With 0.261 kg the commands oscillate within the limits.
    """
    case = unstable_case(3.0, 0.03, 0.01)
    uncontrolled = dataclasses.replace(case, controller=None)
    plan, uncontrolled_plan = (
        integration_plan(case, None, 1e-4),
        integration_plan(uncontrolled, None, 1e-4),
    )
    for mass, limit_cycle in ((0.261, False), (0.322, True), (0.509, True)):
        change = {"loads.0.mass": mass}
        oscillations = command_oscillations(
            jb.simulate(jb.replace(case, change), plan=plan),
            jb.simulate(jb.replace(uncontrolled, change), plan=uncontrolled_plan),
        )
        assert [one.limit_cycle for one in oscillations] == [limit_cycle, limit_cycle]
    unstable = stability_margin(jb.replace(case, {"loads.0.mass": 0.322})).unstable
    assert unstable is not None and unstable.rate > 1
    assert_allclose(oscillations[0].frequency, unstable.frequency, rtol=0.25)
