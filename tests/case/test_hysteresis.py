"""Hysteresis of actuators: properties of the operator, its inverse, and loops with both."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import held_command_limits
from jaxbeam.case.validation import check_case
from jaxbeam.simulation.commands import acting_ranges, command_operator, with_exact_compensation
from jaxbeam.simulation.stored_record import record_from_xarray

OPERATOR = jb.actuators.Hysteresis([0.0, 0.5, 1.5, 3.0], [0.7, 0.15, 0.1, 0.15])
COMMANDS = arrays(float, st.integers(2, 12), elements=st.floats(-6, 6, allow_subnormal=False))


def patch_case(limits=None, **operators) -> jb.Case:
    patch = jb.Patch(0.2575, 0.3425, 0.15, limits=limits, **operators)
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, damping_ratio=0.03, modes=2),
        actuators=[patch],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=3.0)],
        controller=jb.Feedback([3000.0], period=0.004, delay=0.006),
        run=jb.Run(0.2, 250.0),
    )


def by_hand(commands):
    """Outputs of OPERATOR by play operators written out."""
    plays, found = [0.0] * 4, []
    for u in commands:
        for i, r in enumerate((0.0, 0.5, 1.5, 3.0)):
            if u - plays[i] > r:
                plays[i] = u - r
            elif plays[i] - u > r:
                plays[i] = u + r
        found.append(0.7 * plays[0] + 0.15 * plays[1] + 0.1 * plays[2] + 0.15 * plays[3])
    return found


@settings(deadline=None, max_examples=8)
@given(COMMANDS)
def test_properties_of_the_operator(commands):
    outputs = OPERATOR.outputs(commands)
    assert_allclose(outputs, by_hand(commands), atol=1e-12)
    # Rate independence: the same at whatever times, with points in between on the way.
    between = np.interp(np.arange(0, 3 * len(commands) - 2) / 3, np.arange(len(commands)), commands)
    assert_allclose(OPERATOR.outputs(between)[::3], outputs, atol=1e-12)
    # Wiping out: a loop within the range of the next command leaves no memory.
    low, high = sorted(commands[:2])
    loop = [low, high, (low + high) / 2, high, *commands]
    wiped = OPERATOR.outputs([low, high, *commands])[2:]
    assert_allclose(OPERATOR.outputs(loop)[4:], wiped, atol=1e-12)
    # The inverse undoes the operator, on either side.
    inverse = OPERATOR.inverse()
    assert_allclose(OPERATOR.outputs(inverse.outputs(commands)), commands, atol=1e-12)
    assert_allclose(inverse.outputs(outputs), commands, atol=1e-12)


def test_limits_are_those_of_the_commands_that_are_sent():
    """At the limits the law knows what acts, so that the inverse follows on leaving them."""
    record = jb.simulate(patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR, compensation=OPERATOR))
    command = np.asarray(record.command)
    assert command.max() == 2.0 and command.min() >= -1.0
    # 0.7 x 2 + 0.15 x 1.5 + 0.1 x 0.5, and 0.7 + 0.15 x 0.5 on the other side.
    assert_allclose(np.max(record.acting_command), 1.675, rtol=1e-12)
    low, high, _ = held_command_limits(record.case, 0.004)
    assert_allclose([low[0], high[0]], [-0.775, 1.675])


def test_commands_of_the_bound_act_where_the_hysteresis_is_compensated():
    case = patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR)
    least = jb.bound(case, period=0.04)
    replay = dataclasses.replace(with_exact_compensation(case), controller=least.controller())
    assert_allclose(jb.simulate(replay).peak_deflection.max(), least.peak, rtol=2e-3)


@pytest.mark.parametrize(
    ("operator", "message"),
    [
        (([0.0, 1.0], [0.5]), "actuators.0.hysteresis.weights must be as many as thresholds"),
        (([0.1, 1.0], [0.5, 0.5]), "actuators.0.hysteresis.thresholds must begin with 0"),
        (([0.0, 1.0], [0.5, -0.1]), "actuators.0.hysteresis.weights must not be negative"),
    ],
)
def test_errors(operator, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(patch_case(hysteresis=jb.actuators.Hysteresis(*operator)))


def test_hysteresis_needs_samples():
    case = patch_case(hysteresis=OPERATOR)
    continuous = dataclasses.replace(case, controller=jb.Feedback([3000.0]))
    with pytest.raises(ValueError, match="the hysteresis of actuators.0 needs a controller that"):
        check_case(continuous)


def test_round_trip_of_a_record():
    record = jb.simulate(patch_case(hysteresis=OPERATOR))
    found = record_from_xarray(record.to_xarray())
    assert_allclose(found.acting_command, record.acting_command)
    assert found.case.actuators[0].hysteresis.weights[3] == 0.15


# Creep of actuators against its differential equations, its inverse, and loops with both.

CREEP = jb.actuators.Creep([20.0, 2.0, 0.2], [0.05, 0.04, 0.03])
CREEP_OTHER = jb.actuators.Creep([12.0, 1.0], [0.06, 0.05])
PERIOD = np.asarray(0.01)


def acting(operator, commands):
    """What acts for commands in turn, and the state at the end."""
    state, found = operator.start(1), []
    for command in commands:
        state = operator.follow(state, np.full(1, command))
        found.append(operator.output(state)[0])
    return np.array(found), state


def test_mean_over_each_period_is_that_of_the_equations():
    """z_i' = a_i (v - z_i) by scipy under held commands, behind the hysteresis."""
    commands = 3 * np.sin(0.9 * np.arange(12)) + 1
    at_once = OPERATOR.outputs(commands)
    state, means = np.zeros(6), []
    for held in at_once:

        def rates(t, y, held=held):
            return [*(CREEP.rates * (held - y[:3])), *y[:3]]

        state[3:] = 0
        found = solve_ivp(rates, (0, PERIOD), state, rtol=1e-11, atol=1e-13)
        state = found.y[:, -1]
        means.append(held + CREEP.weights @ state[3:] / PERIOD)
    found, _ = acting(command_operator(OPERATOR, CREEP, PERIOD), commands)
    assert_allclose(found, means, rtol=1e-8)


def test_step_response_rises_as_the_logarithm_of_time():
    """Equal weights a decade apart: as much in each decade, 0.02 a decade (within 8 %)."""
    creep = jb.actuators.Creep(10.0 ** np.arange(3.0, -4.0, -1), np.full(7, 0.02))
    times = np.array([0.1, 1.0, 10.0])
    final = 1 + 0.02 * np.sum(1 - np.exp(-creep.rates * times[:, None]), axis=1)
    found = [creep.outputs(np.ones(2), t)[1] for t in times]
    assert_allclose(found, final, rtol=1e-12)
    assert_allclose(np.diff(found), 0.02, rtol=0.08)
    assert_allclose(creep.final_gain, 1.14)


@pytest.mark.parametrize("hysteresis", [None, OPERATOR])
def test_inverse_undoes_the_operator(hysteresis):
    operator = command_operator(hysteresis, CREEP, np.asarray(0.3))
    wanted = np.random.default_rng(2).normal(size=25)
    commands, _ = acting(operator.inverse(), wanted)
    assert_allclose(acting(operator, commands)[0], wanted, atol=1e-12)
    assert np.max(np.abs(commands - wanted)) > 0.1


def test_compensated_loop_is_that_of_the_linear_patch_of_creep():
    linear = jb.simulate(patch_case())
    both = {"hysteresis": OPERATOR, "creep": CREEP}
    exact = with_exact_compensation(patch_case(**both))
    rough = patch_case(**both, compensation=OPERATOR, creep_compensation=CREEP_OTHER)
    runs = [jb.simulate(case) for case in (patch_case(**both), rough, exact)]
    size = np.max(np.abs(linear.deflection))
    errors = [np.max(np.abs(run.deflection - linear.deflection)) for run in runs]
    assert errors[0] > 0.02 * size and errors[1] < errors[0] / 2 and errors[2] < 1e-11 * size
    assert_allclose(runs[2].acting_command, linear.command, atol=1e-9)
    # What acts in the loop is what the operator makes of the commands that were sent.
    sent, acted = (np.asarray(part)[:, 0] for part in (runs[0].command, runs[0].acting_command))
    first = np.flatnonzero(sent)[0]
    operator = command_operator(OPERATOR, CREEP, patch_case().controller.period)
    assert_allclose(acted[first:], acting(operator, sent[first:])[0], atol=1e-12)


def test_sensors_between_commands_do_not_hasten_the_creep():
    """Events of a sensor that samples more often than the law leave the creep as it is."""
    case = patch_case(creep=CREEP)
    quick = jb.Sensor(0.2, sampling_period=0.001)
    often = dataclasses.replace(case, sensors=(*case.sensors, quick))
    assert_allclose(jb.simulate(often).acting_command, jb.simulate(case).acting_command, atol=1e-9)


def test_range_of_what_acts_holds_under_any_command():
    case = patch_case(limits=[-1.0, 2.0], hysteresis=OPERATOR, creep=CREEP)
    low, high, _ = acting_ranges(case)
    assert_allclose([low[0], high[0]], [-0.775 * 1.12, 1.675 * 1.12])
    operator = command_operator(OPERATOR, CREEP, np.asarray(2.0))
    assert_allclose(acting(operator, np.full(30, 2.0))[0][-1], 1.675 * 1.12, rtol=1e-4)


@pytest.mark.parametrize(
    ("creep", "message"),
    [
        (
            jb.actuators.Creep([1.0, 2.0], [0.5]),
            "actuators.0.creep.weights must be as many as rates",
        ),
        (
            jb.actuators.Creep([0.0], [0.5]),
            "actuators.0.creep.rates.0 must be positive; it is 0 1/s",
        ),
        (jb.actuators.Creep([1.0], [-0.5]), "actuators.0.creep.weights.0 must not be negative"),
    ],
)
def test_errors_of_creep(creep, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(patch_case(creep=creep))


def test_creep_needs_samples():
    case = dataclasses.replace(patch_case(creep=CREEP), controller=jb.Feedback([3000.0]))
    with pytest.raises(ValueError, match="the creep of actuators.0 needs a controller that"):
        check_case(case)
