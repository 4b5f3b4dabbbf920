"""Filters against scipy.signal, and their derivatives against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

from jaxbeam.case.sensors import (
    Filter,
    analogue_state_space,
    analogue_steady_state,
    filter_history,
    filter_step,
    second_order_sections,
    steady_filter_state,
)
from jaxbeam.numerics.stages import c2d

ORDERS = [1, 2, 3, 5, 10]
PERIOD = 1e-3
SIGNAL = np.random.default_rng(7).normal(size=(400, 3)).cumsum(axis=0)


def scipy_sections(order, cutoff):
    """Sections of the same digital filter by scipy."""
    return scipy.signal.butter(order, cutoff, fs=1 / PERIOD, output="sos")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("cutoff", [10.0, 120.0, 480.0])
def test_frequency_response_of_a_digital_filter(order, cutoff):
    frequencies = np.linspace(0.01, 499.0, 200)
    ours = np.asarray(second_order_sections(Filter(cutoff, order), PERIOD))
    found = scipy.signal.sosfreqz(ours, frequencies, fs=1 / PERIOD)[1]
    expected = scipy.signal.sosfreqz(scipy_sections(order, cutoff), frequencies, fs=1 / PERIOD)[1]
    significant = np.abs(expected) > 1e-12
    assert_allclose(found[significant], expected[significant], rtol=1e-9)
    at_cutoff = scipy.signal.sosfreqz(ours, [cutoff], fs=1 / PERIOD)[1]
    assert_allclose(np.abs(at_cutoff), 1 / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("cutoff", [10.0, 120.0])
def test_history_equals_sosfilt(order, cutoff):
    rows = second_order_sections(Filter(cutoff, order), PERIOD)
    rest = steady_filter_state(rows, np.zeros(3))
    expected = scipy.signal.sosfilt(scipy_sections(order, cutoff), SIGNAL, axis=0)
    found = filter_history(rows, rest, jnp.asarray(SIGNAL))
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(SIGNAL)))


def test_steps_add_up_to_the_history():
    rows = second_order_sections(Filter(40.0, 5), PERIOD)
    state = steady_filter_state(rows, np.ones(3))
    expected = filter_history(rows, state, jnp.asarray(SIGNAL[:20]))
    for sample, output in zip(SIGNAL[:20], expected, strict=True):
        found, state = filter_step(rows, state, jnp.asarray(sample))
        assert_allclose(found, output, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
def test_steady_state_is_kept_under_a_constant_input(order):
    rows = second_order_sections(Filter(20.0, order), PERIOD)
    level = np.array([2.0, -3.0, 0.5])
    found = filter_history(rows, steady_filter_state(rows, level), jnp.broadcast_to(level, (50, 3)))
    assert_allclose(found, np.broadcast_to(level, (50, 3)), rtol=1e-9)


def test_each_run_of_a_batch_may_have_its_own_filter():
    cutoffs = jnp.array([10.0, 50.0, 200.0])
    rows = jax.vmap(lambda c: second_order_sections(Filter(c, 3), PERIOD), out_axes=-1)(cutoffs)
    found = filter_history(rows, steady_filter_state(rows, np.zeros(3)), jnp.asarray(SIGNAL))
    for i, cutoff in enumerate(cutoffs):
        expected = scipy.signal.sosfilt(scipy_sections(3, float(cutoff)), SIGNAL[:, i])
        assert_allclose(found[:, i], expected, rtol=0, atol=1e-11 * np.max(np.abs(SIGNAL)))


def test_output_is_held_between_new_samples():
    rows = second_order_sections(Filter(50.0, 4), 5 * PERIOD)
    new, start = jnp.array(np.arange(400) % 5 == 0), steady_filter_state(rows, np.zeros(3))
    found = filter_history(rows, start, jnp.asarray(SIGNAL), new)
    slow = filter_history(rows, start, jnp.asarray(SIGNAL[::5]))
    assert_allclose(found, np.repeat(slow, 5, axis=0), rtol=0, atol=0)


def test_cutoff_above_half_the_sampling_frequency_is_refused():
    with pytest.raises(ValueError, match="below half the sampling frequency, 500 Hz; it is 500 Hz"):
        second_order_sections(Filter(500.0, 2), PERIOD)


@pytest.mark.parametrize("order", ORDERS)
def test_frequency_response_of_an_analogue_filter(order):
    cutoff = 30.0
    analogue = Filter(cutoff, order, realisation="analogue")
    matrix, column, row, direct = analogue_state_space(analogue)
    omega = 2 * np.pi * np.logspace(-1, 3, 60)
    inverse = np.linalg.inv(1j * omega[:, None, None] * np.eye(order) - np.asarray(matrix))
    found = np.einsum("i,wij,j->w", row, inverse, column) + direct
    zeros, poles, gain = scipy.signal.buttap(order)
    poles, gain = 2 * np.pi * cutoff * poles, gain * (2 * np.pi * cutoff) ** order
    expected = scipy.signal.freqs_zpk(zeros, poles, gain, omega)[1]
    assert_allclose(found, expected, rtol=1e-8, atol=1e-14)
    rest = analogue_steady_state(Filter(cutoff, order), 2.0)
    assert_allclose(matrix @ rest + column * 2.0, 0.0, atol=1e-12)
    assert_allclose(row @ rest, 2.0, rtol=1e-15)


@pytest.mark.parametrize("order", [1, 4, 7])
def test_discretisation_with_polynomial_holds_is_exact(order):
    """Zero order against cont2discrete, first order against lsim, cubics against half steps."""
    matrix, column, row, direct = analogue_state_space(Filter(30.0, order))
    system = matrix, column[:, None], row[None], direct[None, None]
    transition, inputs = c2d(matrix, column[:, None], PERIOD)
    discrete = scipy.signal.cont2discrete([np.asarray(x) for x in system], PERIOD)
    assert_allclose(transition, discrete[0], rtol=1e-12, atol=1e-13)
    assert_allclose(inputs[0], discrete[1], rtol=1e-10, atol=1e-14)

    transition, inputs = c2d(matrix, column[:, None], PERIOD, degree=1)
    times, signal = PERIOD * np.arange(400), SIGNAL[:, 0]
    expected = scipy.signal.lsim([np.asarray(x) for x in system], signal, times)[2]
    state, found = np.zeros(order), [np.zeros(order)]
    for value, rise in zip(signal[:-1], np.diff(signal), strict=True):
        state = transition @ state + inputs[0, :, 0] * value + inputs[1, :, 0] * rise
        found.append(state)
    assert_allclose(found, np.asarray(expected).reshape(400, order), rtol=0, atol=1e-9)

    cubic = np.array([1.0, -2.0, 0.5, 3.0])  # in s / h; its halves in s / (h / 2), from the start
    second = np.polynomial.Polynomial(cubic)(np.polynomial.Polynomial([0.5, 0.5])).coef
    transition, inputs = c2d(matrix, column[:, None], 0.02, degree=3)
    half_transition, half_inputs = c2d(matrix, column[:, None], 0.01, degree=3)
    middle = np.tensordot(cubic * 0.5 ** np.arange(4), half_inputs[..., 0], axes=1)
    expected = half_transition @ middle + np.tensordot(second, half_inputs[..., 0], axes=1)
    assert_allclose(np.tensordot(cubic, inputs[..., 0], axes=1), expected, rtol=1e-11)
