"""Gains against python-control and scipy; sampled transitions against scipy."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.observability import DetectabilityWarning
from jaxbeam.estimation.observer import kalman_gain, placed_gain, sampled_kalman_gain
from jaxbeam.estimation.sampled_plant import SampleTiming, sample_timing
from jaxbeam.numerics.discretisation import balance
from tests.differences import central

FREQUENCIES = np.array([128.0, 512.0, 1153.0])
SHAPES = np.array([[1.76, 2.47, 1.75], [2.4, 1.2, -1.8]])
A = jnp.block(
    [
        [np.zeros((3, 3)), np.eye(3)],
        [-np.diag(FREQUENCIES**2), -np.diag(2 * 0.03 * FREQUENCIES)],
    ]
)
C = jnp.hstack([1e5 * SHAPES, np.zeros((2, 3))])  # readings in units of 10 um
Q = jnp.diag(jnp.array([0.0, 0.0, 0.0, 0.01, 0.02, 0.03]))
R = jnp.diag(jnp.array([1.0, 4.0]))


CONTINUOUS, SAMPLED, PLACED = map(jax.jit, (kalman_gain, sampled_kalman_gain, placed_gain))


@jax.jit
def _transition(timing):
    return timing.transition(lambda t: (A, jnp.eye(6, 1)), Q, balance(A))


def transition(period, delay=None):
    """Transition over a period (s) in which the command begins after a delay (s)."""
    delay = None if delay is None else jnp.asarray(delay)
    return _transition(SampleTiming(jnp.asarray(period), delay))


def test_kalman_gain_in_continuous_time():
    """In coordinates times frequencies, in which python-control is accurate."""
    units = np.concatenate([FREQUENCIES, np.ones(3)])[:, None]
    gain, covariance, _ = control.lqe(A * units / units.T, np.eye(6), C / units.T, Q, R)
    found = CONTINUOUS(A, C, Q, R)
    scale = np.sqrt(np.diag(covariance))[:, None]
    outer = scale * scale.T
    assert_allclose(found[1] * units * units.T / outer, covariance / outer, rtol=0, atol=1e-9)
    assert_allclose(found[0] * units / scale, gain / scale, rtol=1e-8)


def test_sampled_kalman_gain():
    step = transition(2e-3)
    matrix, noise = step.matrix, step.noise_covariance
    gain, covariance, _ = control.dlqe(matrix, np.eye(6), C, noise, R)
    found = SAMPLED(matrix, C, noise, R)
    scale = np.sqrt(np.diag(covariance))
    outer = scale * scale[:, None]
    assert_allclose(found[1] / outer, covariance / outer, rtol=0, atol=1e-9)
    # The gain of python-control is that of the prediction of the next state.
    assert_allclose(matrix @ found[0] / scale[:, None], gain / scale[:, None], rtol=0, atol=1e-9)
    direct = scipy.linalg.solve_discrete_are(matrix.T, C.T, noise, R)
    assert_allclose(direct / outer, covariance / outer, rtol=0, atol=1e-9)


def test_sampled_gain_tends_to_the_continuous_one():
    """Samples with noise of covariance R / period tend to noise of intensity R."""
    continuous, covariance = CONTINUOUS(A, C, Q, R)
    scale = np.sqrt(np.diag(covariance))[:, None]
    errors = []
    for period in (2e-5, 1e-5):
        step = transition(period)
        gain, _ = SAMPLED(step.matrix, C, step.noise_covariance, R / period)
        error = np.max(np.abs((gain / period - continuous) / scale))
        errors.append(error / np.max(np.abs(continuous / scale)))
    assert errors[1] < 0.01
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("delay", [None, 7e-4])
def test_transition_of_a_time_invariant_plant(delay):
    """Noise by Van Loan's block exponential, inputs by A^-1 (exp(A s) - 1) B."""
    period, step = 2e-3, transition(2e-3, delay)
    matrix = scipy.linalg.expm(A * period)
    block = scipy.linalg.expm(np.block([[-A, Q], [np.zeros((6, 6)), A.T]]) * period)
    noise = block[6:, 6:].T @ block[:6, 6:]
    inputs = {
        s: np.linalg.solve(A, (scipy.linalg.expm(A * s) - np.eye(6)) @ np.eye(6, 1))
        for s in (period, 0.0 if delay is None else period - delay)
    }
    current = inputs[period] if delay is None else inputs[period - delay]
    scale = np.sqrt(np.diag(noise))
    outer = scale * scale[:, None]
    column = scale[:, None]
    assert_allclose(step.matrix * scale / column, matrix * scale / column, atol=1e-11)
    assert_allclose(step.noise_covariance / outer, noise / outer, rtol=0, atol=1e-10)
    assert_allclose(step.input_matrix / column, current / column, rtol=1e-9, atol=1e-9)
    both = (step.previous_input_matrix + step.input_matrix) / column
    assert_allclose(both, inputs[period] / column, rtol=1e-9, atol=1e-9)


def test_placed_gain():
    """With one output the gain is unique; with two the poles are placed."""
    poles = np.array([-100 + 80j, -150 + 500j, -200 + 1100j])
    poles = np.concatenate([poles, poles.conj()])
    desired = jnp.block(
        [
            [np.zeros((3, 3)), np.eye(3)],
            [-np.diag(np.abs(poles[:3]) ** 2), np.diag(2 * poles[:3].real)],
        ]
    )
    gain = PLACED(A, C[:1], desired)
    scale = np.concatenate([np.ones(3), FREQUENCIES])[:, None]
    expected = scipy.signal.place_poles(A.T, C[:1].T, poles).gain_matrix.T
    assert_allclose(gain / scale, expected / scale, rtol=1e-7)
    both = PLACED(A, C, desired)
    assert_allclose(np.sort_complex(np.linalg.eigvals(A - both @ C)), np.sort_complex(poles))


def test_a_placed_gain_of_unlike_sensors_has_the_derivative_by_the_stiffness():
    """The shares of a deflection and a velocity depend on the scale of the states."""
    rows = jnp.stack([C[0], jnp.roll(C[1], 3)])
    stiffness = jnp.tril(jnp.ones((6, 6)), -3) > 0

    @jax.jit
    def gain(ratio):
        return PLACED(jnp.where(stiffness, ratio, 1.0) * A, rows, 1.5 * A)

    differences = (gain(1 + 1e-5) - gain(1 - 1e-5)) / 2e-5
    size = np.max(np.abs(differences), axis=0)
    assert_allclose(jax.jacfwd(gain)(1.0) / size, differences / size, rtol=0, atol=1e-7)


def test_gradients_of_gains():
    step = transition(2e-3)
    matrix, noise = step.matrix, step.noise_covariance

    @jax.jit
    def gains(point):
        rows = C * jnp.array([[1.0], [point[0]]])
        found = (
            PLACED(matrix, rows, point[1] * matrix),
            SAMPLED(matrix, rows, point[2] * noise, R)[0],
            CONTINUOUS(A, rows, point[2] * Q, R)[0],
        )
        return jnp.stack([gain[:3] for gain in found]).reshape(3, -1)

    at = jnp.array([1.0, 0.8, 1.0])
    size = np.max(np.abs(gains(at)), axis=1)[:, None, None]
    differences = central(gains, at, 1e-2) / size
    assert_allclose(jax.jacrev(gains)(at) / size, differences, rtol=0, atol=1e-7)


# Kalman filter of a damped mode that no sensor observes, against scipy.

PERIOD, FORCE, NOISE, SPAN, MODES = 2e-3, 0.05, 1e-6, 0.6, 4


def two_spans(damping=0.03) -> jb.Case:
    """Two equal spans, a sensor in the middle of one: a node of each span's second mode."""
    return jb.Case(
        jb.Beam(2 * SPAN, 11.68, 0.535, damping, modes=MODES),
        supports=[jb.Support(SPAN)],
        actuators=[jb.PointForce(0.2)],
        sensors=[jb.Sensor(SPAN / 2)],
        controller=jb.StateFeedback(
            np.zeros((1, 2 * MODES)), period=PERIOD, estimator=Kalman(FORCE, NOISE)
        ),
    )


def test_a_mode_that_decays_by_itself_may_be_unseen():
    case, second = two_spans(), np.pi / 2 * (2 / SPAN) ** 2 * np.sqrt(11.68 / 0.535)
    with pytest.warns(
        DetectabilityWarning, match=f"no sensor observes the mode at {second:.4g} Hz"
    ):
        check_case(case)
    plant = jb.state_space(case)
    filter = case.controller.estimator.sampled_filter(plant, sample_timing(case.controller))
    system = plant.unloaded
    A, C = np.asarray(system.A), np.asarray(system.C)
    white = np.diag([0.0] * MODES + [FORCE] * MODES)
    block = scipy.linalg.expm(PERIOD * np.block([[-A, white], [np.zeros_like(A), A.T]]))
    transition = block[2 * MODES :, 2 * MODES :].T
    covariance = transition @ block[: 2 * MODES, 2 * MODES :]
    P = scipy.linalg.solve_discrete_are(transition.T, C.T, covariance, NOISE**2 * np.eye(1))
    expected = P @ C.T / (C @ P @ C.T + NOISE**2)
    found = np.asarray(filter.gain)[: 2 * MODES]
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    frequencies = np.sqrt(-np.diag(A[MODES:, :MODES])) / (2 * np.pi)
    unseen = int(np.argmin(np.abs(frequencies - second)))
    assert_allclose(found[[unseen, unseen + MODES]], 0.0, atol=1e-8 * np.abs(expected).max())


def test_an_undamped_one_is_refused():
    with pytest.raises(ValueError, match="observe every mode without damping: none of 1 observes"):
        check_case(two_spans(0.0))
