"""Gains against python-control and scipy; sampled transitions against scipy."""

import dataclasses

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
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.observability import DetectabilityWarning
from jaxbeam.control.estimation.observer import kalman_gain, placed_gain, sampled_kalman_gain
from jaxbeam.control.estimation.sampled_plant import SampleTiming, sample_timing
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.numerics.stages import balance
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.differences import central
from tests.loop_as_oracle import expected, parts_of
from tests.oracles.sampled_plant import SampledPlant

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


# Kalman filters in closed loops on beams with more modes than the design, against numpy.

LOOP_MODES, LOOP_PERIOD, DELAY = 2, 2e-3, 5e-4
WEIGHTS = [3e4, 3e4, 1.0, 1.0, 0.0]
LOOP_FORCE, LOOP_NOISE = 0.02, 1e-5
TIMES = np.linspace(0.0, 0.05, 26)


def loop(estimator, command_weight=0.01, delay: float | None = DELAY, loads=True, modes=4):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(0.17), jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.4, speed=2.0, entry_time=0.0)] if loads else [],
        controller=jb.LQR(
            WEIGHTS,
            [command_weight],
            period=LOOP_PERIOD,
            delay=delay,
            design=DesignModel(modes=LOOP_MODES),
            estimator=estimator,
        ),
        run=jb.Run(0.05),
    )


def design_plant(case, loaded=False):
    """Design plant of the estimator, by the oracle."""
    span, loads, *parts = parts_of(case)
    span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, LOOP_MODES, 0.01)
    return SampledPlant(span, loads if loaded else [], *parts)


def regulator(case):
    A, B, _, _ = design_plant(case).matrices(0.0)
    return control.lqr(A, B, np.diag(WEIGHTS), case.controller.command_weight[0] * np.eye(1))[0]


class NumpyKalman:
    """Law and filter in numpy; the covariance starts from rest without error, or is steady."""

    def __init__(self, case, loaded):
        self.gain, self.loaded = regulator(case), loaded
        self.plant = design_plant(case, loaded)
        size = self.plant.size
        self.intensity = np.diag([0, 0, LOOP_FORCE, LOOP_FORCE, 0.0] + [0.0] * loaded)
        self.state, self.covariance = np.zeros(size), np.zeros((size, size))
        self.previous, self.command = np.zeros(1), np.zeros(1)
        if loaded:
            self.state[-1], self.covariance[-1, -1] = 0.4 * 9.81, 4.0
            return
        self.step = self.plant.step(0.0, LOOP_PERIOD, DELAY, self.intensity)
        self.C = self.plant.matrices(0.0)[2]
        self.covariance = scipy.linalg.solve_discrete_are(
            self.step.transition.T, self.C.T, self.step.noise, LOOP_NOISE**2 * np.eye(2)
        )

    def __call__(self, readings, state, t):
        command = self.command
        step = (
            self.step if not self.loaded else self.plant.step(t, LOOP_PERIOD, DELAY, self.intensity)
        )
        C = self.plant.matrices(t)[2]
        prior = step.transition @ self.state + step.before @ self.previous + step.after @ command
        P = self.covariance
        if self.loaded:
            P = step.transition @ P @ step.transition.T + step.noise
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + LOOP_NOISE**2 * np.eye(2))
        if self.loaded:
            self.covariance = P - gain @ C @ P
        self.state, self.previous = prior + gain @ (readings - C @ prior), command
        self.command = -self.gain @ self.state[:5]
        return self.command


def run(case):
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, loop_schedule(case, TIMES))
    return jb.simulate(case, jnp.asarray(TIMES), plan)


@pytest.mark.parametrize(
    ("kalman", "tolerance"),
    [
        (Kalman(LOOP_FORCE, LOOP_NOISE), 1e-9),
        (Kalman(LOOP_FORCE, LOOP_NOISE, loads="estimated", weight_deviation=2.0), 1e-4),
    ],
)
def test_feedback_of_estimates(kalman, tolerance):
    """Crossing of a beam with two modes more than the design."""
    case = loop(kalman)
    record = run(case)
    truth = expected(case, TIMES, NumpyKalman(case, kalman.loads == "estimated"))
    for found, true in ((record.deflection, truth.deflection), (record.command, truth.command)):
        assert_allclose(found, true, rtol=0, atol=tolerance * np.max(np.abs(true)))


@pytest.mark.parametrize(
    "estimator",
    [
        Kalman(LOOP_FORCE, LOOP_NOISE),
        jb.MovingHorizon(LOOP_FORCE, LOOP_NOISE, loads="known", deflection_limit=2e-5),
    ],
    ids=["kalman", "moving-horizon"],
)
def test_loops_in_amplitudes_of_sines_are_those_in_modal_coordinates(estimator):
    """q = sqrt(m L / 2) a of the amplitude a of a sine, so that gains of a are so many times those.

    The limit of the deflections is met.
    """
    gain, records = np.array([[50.0, -80.0, 4.0, 1.5, 0.1]]), []
    factor = np.append(np.full(4, np.sqrt(0.535 * 0.6 / 2)), 1.0)
    for coordinates, own in (("modal", gain), ("sine", gain * factor)):
        case = loop(None, modes=LOOP_MODES)
        law = jb.StateFeedback(
            own, coordinates=coordinates, period=LOOP_PERIOD, delay=DELAY, estimator=estimator
        )
        records.append(run(dataclasses.replace(case, controller=law)))
    modal, sine = records
    assert np.max(np.abs(modal.command)) > 1e-3
    scale = np.max(np.abs(modal.command))
    assert_allclose(sine.command, modal.command, rtol=0, atol=1e-7 * scale)
