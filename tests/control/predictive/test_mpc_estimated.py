"""Predictive control behind a Kalman filter of three of twelve modes; known loads."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation.kalman import Kalman
from tests.control.predictive.test_mpc import PATCH, PERIOD, THESIS, beam_case, mpc
from tests.oracles.held_period import over_period

INTENSITY, NOISE = 0.05, 1e-6
SAMPLES, SUBSTEPS = 40, 4


def estimates(readings, commands):
    """States (sample, state) of three modes by a Kalman filter in numpy."""
    plant = jb.state_space(beam_case()).unloaded
    A, B, C = map(np.asarray, (plant.A, plant.B, plant.C))
    size = A.shape[0]
    # Van Loan's exponentials: plant with its command, and noise of a period.
    held = scipy.linalg.expm(PERIOD * np.block([[A, B], [np.zeros((1, size + 1))]]))
    transition, input_matrix = held[:size, :size], held[:size, size:]
    white = np.diag([0.0] * 3 + [INTENSITY] * 3)
    block = scipy.linalg.expm(PERIOD * np.block([[-A, white], [np.zeros_like(A), A.T]]))
    noise = transition @ block[:size, size:]
    P = scipy.linalg.solve_discrete_are(transition.T, C.T, noise, NOISE**2 * np.eye(1))
    gain = P @ C.T / (C @ P @ C.T + NOISE**2)
    state, found = np.zeros(size), []
    for reading, command in zip(readings, commands, strict=True):
        state = transition @ state + input_matrix @ command
        state = state + gain @ (reading - C @ state)
        found.append(state)
    return np.array(found)


def test_filter_of_three_modes_on_twelve():
    """Commands equal those of the law behind a filter in numpy; the peak is reduced by a sixth."""
    settings = {"design": DesignModel(modes=3), "estimator": Kalman(INTENSITY, NOISE)}
    case = beam_case(mpc(**settings), modes=12)
    model = jb.state_space(case)
    midpoints = (np.arange(SAMPLES * SUBSTEPS) + 0.5) * PERIOD / SUBSTEPS

    @eqx.filter_jit
    def loop(model, controlled):
        system = jax.vmap(lambda t: model.at(t).discretize(PERIOD / SUBSTEPS))(midpoints)
        loads = system.B[:, :, 1:] @ model.weights
        parts = system.A, system.B[..., :1], loads
        parts = [x.reshape(SAMPLES, SUBSTEPS, *x.shape[1:]) for x in parts]
        law, C = case.controller.law(model), model.unloaded.C

        def period(carry, sample):
            state, previous, law_state = carry
            t, *matrices = sample
            readings = C @ state
            command, law_state, _ = law.step(law_state, Measurement(readings, state, previous), t)
            command = jnp.where(controlled, jnp.clip(command, *PATCH.limits), 0.0)
            after, _ = jax.lax.scan(
                lambda x, part: (part[0] @ x + part[1] @ command + part[2], None),
                state,
                tuple(matrices),
            )
            return (after, command, law_state), (readings, command, previous)

        start = jnp.zeros(24), jnp.zeros(1), law.initial_state()
        times = jnp.arange(SAMPLES) * PERIOD
        return jax.lax.scan(period, start, (times, *parts))[1]

    readings, commands, previous = loop(model, True)
    uncontrolled = loop(model, False)[0]
    states = estimates(np.asarray(readings), np.asarray(previous))
    with_true_state = mpc()

    @eqx.filter_jit
    def commands_for(model):
        law = with_true_state.law(model)

        def step(law_state, sample):
            state, previous = sample
            measurement = Measurement(jnp.zeros(1), state, previous)
            command, law_state, _ = law.step(law_state, measurement, 0.0)
            return law_state, command

        return jax.lax.scan(step, law.initial_state(), (jnp.asarray(states), previous))[1]

    expected = commands_for(jb.state_space(beam_case(with_true_state)))
    expected = np.clip(expected, *np.asarray(PATCH.limits))
    assert np.ptp(expected) > 5
    assert_allclose(commands, expected, rtol=0, atol=1e-5)
    assert np.min(readings) > 0.83 * np.min(uncontrolled)


def test_known_loads_within_limits():
    """Each command against bounded least squares over the future commands, by scipy."""
    controller = mpc(loads="known")
    case = jb.replace(beam_case(controller), {"loads.0.entry_time": -0.1, "loads.0.mass": 0.4})
    force = dataclasses.replace(case, loads=(jb.MovingForce(mass=0.4, speed=1.0, entry_time=-0.1),))
    random = np.random.default_rng(1)
    states = random.normal(size=(12, 6)) * [4e-4, 2e-5, 5e-6, 5e-3, 5e-4, 5e-4]
    states[:, 0] -= 6e-4

    @eqx.filter_jit
    def commands_for(model):
        law = controller.law(model)

        def step(carry, sample):
            command, law_state = carry
            state, t = sample
            measurement = Measurement(jnp.zeros(1), state, command)
            command, law_state, _ = law.step(law_state, measurement, t)
            return (command, law_state), command

        start = jnp.zeros(1), law.initial_state()
        times = jnp.arange(len(states)) * PERIOD
        return jax.lax.scan(step, start, (jnp.asarray(states), times))[1]

    commands = np.asarray(commands_for(jb.state_space(case)))[:, 0]
    under_force = jb.state_space(force)
    plant = under_force.unloaded.discretize(PERIOD)
    A, B, C = (np.asarray(x) for x in (plant.A, plant.B[:, 0], plant.C[0]))

    def matrices_at(t):
        system = under_force.at(t)
        return np.asarray(system.A), np.asarray(system.B)

    @functools.cache
    def force_input(period):
        start = period * PERIOD
        return over_period(matrices_at, start, start + PERIOD)[1][:, 1] * 0.4 * 9.81

    horizon, moves, weight = THESIS["horizon"], THESIS["moves"], THESIS["move_weight"]
    previous_state, previous, found = np.zeros(6), 0.0, []
    for k, state in enumerate(states):
        past, *future = map(force_input, range(k - 1, k + horizon))
        unexplained = state - (A @ previous_state + B * previous + past)
        fixed = state, previous, future, unexplained

        def residuals(inputs, fixed=fixed):
            state, previous, future, unexplained = fixed
            outputs, x = [], state
            for i, load_input in enumerate(future):
                x = A @ x + B * inputs[min(i, moves - 1)] + load_input + unexplained
                outputs.append(C @ x)
            steps = np.diff(inputs, prepend=previous)
            return np.append(np.array(outputs), np.sqrt(weight) * steps)

        at_zero = residuals(np.zeros(moves))
        slopes = np.stack([residuals(one) - at_zero for one in np.eye(moves)], axis=1)
        scale = 1e5
        best = lsq_linear(scale * slopes, -scale * at_zero, (-2.5, 7.5), tol=1e-14, method="bvls")
        previous, previous_state = best.x[0], state
        found.append(previous)
    assert np.sum(np.isclose(found, 7.5)) >= 2 and np.sum(np.abs(found) < 7.4) >= 2
    assert_allclose(commands, found, rtol=0, atol=1e-5)
