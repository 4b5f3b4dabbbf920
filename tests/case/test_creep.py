"""Creep of actuators against its differential equations, its inverse, and loops with both."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.commands import acting_ranges, command_operator, with_exact_compensation
from tests.case.test_hysteresis import OPERATOR, patch_case
from tests.differences import central

CREEP = jb.actuators.Creep([20.0, 2.0, 0.2], [0.05, 0.04, 0.03])
OTHER = jb.actuators.Creep([12.0, 1.0], [0.06, 0.05])
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


def test_compensated_loop_is_that_of_the_linear_patch():
    linear = jb.simulate(patch_case())
    both = {"hysteresis": OPERATOR, "creep": CREEP}
    exact = with_exact_compensation(patch_case(**both))
    rough = patch_case(**both, compensation=OPERATOR, creep_compensation=OTHER)
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


def loop(values, commands):
    """Sum of squares of what acts under commands, with feedback of what acted before."""
    weights, rates, gain = values[:3], values[3:5], values[5]
    hysteresis = jb.actuators.Hysteresis(xp.asarray([0.0, 0.5, 1.5]), weights)
    operator = command_operator(
        hysteresis, jb.actuators.Creep(rates, xp.asarray([0.1, 0.2])), PERIOD
    )
    state, total, output = operator.start(1), 0.0, xp.zeros(1)
    for command in commands:
        state = operator.follow(state, command - gain * output)
        output = operator.output(state)
        total = total + output[0] ** 2
    return total


def test_derivatives_through_hysteresis_and_creep():
    point = np.array([0.7, 0.2, 0.1, 20.0, 2.0, 0.3])
    commands = 2 * np.sin(0.8 * np.arange(9.0))
    found = jax.jit(jax.grad(lambda values: loop(values, commands)))(jax.numpy.asarray(point))
    assert_allclose(found, central(lambda values: loop(values, commands), point), rtol=1e-8)


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
def test_errors(creep, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(patch_case(creep=creep))


def test_creep_needs_samples():
    case = dataclasses.replace(patch_case(creep=CREEP), controller=jb.Feedback([3000.0]))
    with pytest.raises(ValueError, match="the creep of actuators.0 needs a controller that"):
        check_case(case)
