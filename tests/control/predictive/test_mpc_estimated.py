"""Predictive control behind an estimator that knows three of twelve modes; loads seen coming."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation import Kalman
from tests.control.predictive.test_mpc import PATCH, PERIOD, THESIS, mpc, rig

INTENSITY, NOISE = 0.05, 1e-6
TICKS, FINE = 40, 4


def estimated(readings, commands):
    """States of three modes by a filter of numpy's, from readings and commands that acted."""
    plant = jb.state_space(rig()).unloaded
    A, B, C = map(np.asarray, (plant.A, plant.B, plant.C))
    size = A.shape[0]
    # Van Loan's exponentials: of the plant with its command, and of the noise of a period.
    held = scipy.linalg.expm(PERIOD * np.block([[A, B], [np.zeros((1, size + 1))]]))
    drift, push = held[:size, :size], held[:size, size:]
    white = np.diag([0.0] * 3 + [INTENSITY] * 3)
    grown = scipy.linalg.expm(PERIOD * np.block([[-A, white], [np.zeros_like(A), A.T]]))
    noise = drift @ grown[:size, size:]
    P = scipy.linalg.solve_discrete_are(drift.T, C.T, noise, NOISE**2 * np.eye(1))
    gain = P @ C.T / (C @ P @ C.T + NOISE**2)
    state, found = np.zeros(size), []
    for reading, command in zip(readings, commands, strict=True):
        state = drift @ state + push @ command
        state = state + gain @ (reading - C @ state)
        found.append(state)
    return np.array(found)


@pytest.mark.slow
def test_three_modes_estimated_on_twelve():
    """Commands are those of the law fed by a filter of numpy's; the peak still falls by a sixth."""
    believing = {"design": DesignModel(modes=3), "estimator": Kalman(INTENSITY, NOISE)}
    case = rig(mpc(**believing), modes=12)
    law, model = case.controller, jb.state_space(case)
    middles = (np.arange(TICKS * FINE) + 0.5) * PERIOD / FINE

    @eqx.filter_jit
    def loop(model, controlled):
        system = jax.vmap(lambda t: model.at(t).discretize(PERIOD / FINE))(middles)
        loads = system.B[:, :, 1:] @ model.weights
        parts = [x.reshape(TICKS, FINE, *x.shape[1:]) for x in (system.A, system.B[..., :1], loads)]
        C = model.unloaded.C

        def tick(carry, now):
            state, given, memory = carry
            t, *fine = now
            readings = C @ state
            wanted, memory = law.step(memory, Measurement(readings, state, given), t)
            wanted = jnp.where(controlled, jnp.clip(wanted, *PATCH.limits), 0.0)
            after, _ = jax.lax.scan(
                lambda x, part: (part[0] @ x + part[1] @ wanted + part[2], None), state, tuple(fine)
            )
            return (after, wanted, memory), (readings, wanted, given)

        start = jnp.zeros(24), jnp.zeros(1), law.init(model)
        times = jnp.arange(TICKS) * PERIOD
        return jax.lax.scan(tick, start, (times, *parts))[1]

    readings, wanted, given = loop(model, True)
    free = loop(model, False)[0]
    states = estimated(np.asarray(readings), np.asarray(given))
    plain = mpc()
    small = jb.state_space(rig(plain))

    @eqx.filter_jit
    def asked(model):
        def tick(memory, at):
            seen, given = at
            command, memory = plain.step(memory, Measurement(jnp.zeros(1), seen, given), 0.0)
            return memory, command

        return jax.lax.scan(tick, plain.init(model), (jnp.asarray(states), given))[1]

    expected = np.clip(asked(small), *np.asarray(PATCH.limits))
    assert np.ptp(expected) > 5
    assert_allclose(wanted, expected, rtol=0, atol=1e-5)
    assert np.min(readings) > 0.83 * np.min(free)


@pytest.mark.slow
def test_loads_are_seen_coming_within_limits():
    """Each command against a bounded least squares over the commands to come, by scipy."""
    law = mpc(loads="known")
    case = jb.replace(rig(law), {"loads.0.entry_time": -0.1, "loads.0.mass": 0.4})
    force = dataclasses.replace(case, loads=(jb.MovingForce(mass=0.4, speed=1.0, entry_time=-0.1),))
    random = np.random.default_rng(1)
    states = random.normal(size=(12, 6)) * [4e-4, 2e-5, 5e-6, 5e-3, 5e-4, 5e-4]
    states[:, 0] -= 6e-4

    @eqx.filter_jit
    def asked(model):
        def tick(carry, at):
            given, memory = carry
            state, t = at
            given, memory = law.step(memory, Measurement(jnp.zeros(1), state, given), t)
            return (given, memory), given

        start = jnp.zeros(1), law.init(model)
        times = jnp.arange(len(states)) * PERIOD
        return jax.lax.scan(tick, start, (jnp.asarray(states), times))[1]

    commands = np.asarray(asked(jb.state_space(case)))[:, 0]
    pressed = jb.state_space(force)
    plant = pressed.unloaded.discretize(PERIOD)
    A, B, C = (np.asarray(x) for x in (plant.A, plant.B[:, 0], plant.C[0]))

    @eqx.filter_jit
    def pushes(times):
        return jax.vmap(lambda t: pressed.at(t).discretize(PERIOD).B[:, 1])(times)

    horizon, moves, weight = THESIS["horizon"], THESIS["moves"], THESIS["move_weight"]
    before, given, found = np.zeros(6), 0.0, []
    for k, state in enumerate(states):
        middles = (k + np.arange(-1, horizon) + 0.5) * PERIOD
        past, *future = np.asarray(pushes(jnp.asarray(middles))) * 0.4 * 9.81
        left = state - (A @ before + B * given + past)

        def ahead(inputs, state=state, given=given, future=future, left=left):
            outputs, x = [], state
            for i, push in enumerate(future):
                x = A @ x + B * inputs[min(i, moves - 1)] + push + left
                outputs.append(C @ x)
            steps = np.diff(inputs, prepend=given)
            return np.append(np.array(outputs), np.sqrt(weight) * steps)

        free = ahead(np.zeros(moves))
        slopes = np.stack([ahead(one) - free for one in np.eye(moves)], axis=1)
        scale = 1e5
        best = lsq_linear(scale * slopes, -scale * free, (-2.5, 7.5), tol=1e-14, method="bvls")
        given, before = best.x[0], state
        found.append(given)
    assert np.sum(np.isclose(found, 7.5)) >= 2 and np.sum(np.abs(found) < 7.4) >= 2
    assert_allclose(commands, found, rtol=0, atol=1e-5)
