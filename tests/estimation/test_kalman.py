"""Kalman filters against Gaussian conditioning by brute force, and their own statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.model.modes import mesh_layout
from tests.differences import central
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant, conditioned

PERIOD = 1e-3
NOISE = np.array([1e-5, 2e-4, 0.05, 5e-7])
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
    sensors=[
        jb.Sensor(0.15, noise=1e-5, offset=1e-4),
        jb.Sensor(0.25, "velocity", noise=2e-4),
        jb.Sensor(0.35, "acceleration", noise=0.05),
        jb.Sensor(0.45, "strain", fibre_distance=1.65e-3, noise=5e-7),
    ],
    loads=[jb.MovingMass(mass=0.4, speed=0.5, entry_time=-0.4)],
    controller=jb.Prescribed([0.0], period=PERIOD),
)
OFFSET = np.array([1e-4, 0.0, 0.0, 0.0])
FORCES = np.array([1e-2, 2e-2])
DEVIATION = 2.0
ESTIMATED = Kalman(FORCES, loads="estimated", weight_deviation=DEVIATION)
LAYOUT = mesh_layout(CASE)


def with_delay(case, delay):
    return dataclasses.replace(case, controller=jb.Prescribed([0.0], period=PERIOD, delay=delay))


@jax.jit
def filtered(kalman, case, commands, readings):
    """The memory after the last tick; and from every tick the estimate and the squared surprise."""

    def tick(memory, at):
        t, command, reading = at
        surprise = jnp.zeros(())
        if kalman.loads != "ignored":
            expected = memory.predicted(command, t)
            short = reading - expected.readings
            surprise = short @ jnp.linalg.solve(expected.spread, short)
        measurement = Measurement(reading, jnp.zeros(5), command)
        estimate, memory = kalman.step(memory, measurement, t)
        return memory, (estimate, surprise)

    start = kalman.init(jb.state_space(case, layout=LAYOUT))
    return jax.lax.scan(tick, start, (PERIOD * jnp.arange(len(readings)), commands, readings))


def oracle(case, ticks, delay=0.0, loaded=True):
    """Transitions, rows of the readings and intensity of the noise, by the oracle."""
    span, loads, actuators, sensors = parts_of(case)
    plant = SampledPlant(span, loads if loaded else [], actuators, sensors)
    intensity = np.diag([0.0, 0.0, *FORCES, 0.0, *([0.0] * loaded)])
    times = PERIOD * np.arange(ticks if loaded else 1)
    steps = [plant.step(t, PERIOD, delay, intensity) for t in times]
    rows = [plant.matrices(t)[2:] for t in times]
    return (steps, rows) if loaded else (steps * ticks, rows * ticks)


def signals(ticks):
    """Some commands and readings; no filter cares whether they fit."""
    random = np.random.default_rng(1)
    return random.normal(size=(ticks, 1)), NOISE * random.normal(size=(ticks, 4)) * 10


@pytest.mark.parametrize(
    ("kalman", "delay", "ticks"),
    [
        (Kalman(FORCES), 0.0022, 240),
        (Kalman(FORCES, loads="known"), None, 8),
        (ESTIMATED, 0.0013, 8),
    ],
    ids=lambda x: getattr(x, "loads", None),
)
def test_estimates_are_those_of_gaussian_conditioning(kalman, delay, ticks):
    """The time-invariant filter has forgotten its start by the last tick."""
    loaded = kalman.loads != "ignored"
    commands, readings = signals(ticks)
    memory, (estimate, _) = filtered(kalman, with_delay(CASE, delay), commands, readings)
    within = 0.0 if delay is None else delay % PERIOD
    steps, rows = oracle(CASE, ticks, within, loaded)
    size = steps[0].transition.shape[0]
    mean, covariance = np.zeros(size), np.zeros((size, size))
    if loaded:
        mean[-1] = 0.4 * 9.81
        covariance[-1, -1] = DEVIATION**2 if kalman.loads == "estimated" else 0.0
    state, covariance = conditioned(
        (mean, covariance), steps, rows, np.diag(NOISE**2), commands, readings - OFFSET
    )
    scale = np.sqrt(np.diag(covariance)) + 1e-6 * np.abs(state)
    assert_allclose(memory.state / scale, state / scale, rtol=0, atol=1e-4)
    if loaded:
        outer = scale * scale[:, None]
        assert_allclose(memory.covariance / outer, covariance / outer, rtol=0, atol=1e-4)
    if kalman.loads == "estimated":
        assert_allclose(estimate.weights[-1, 0], state[-1], rtol=1e-4)
    else:
        assert estimate.weights is None


def test_surprises_and_errors_are_as_large_as_stated():
    """Squares of surprises and errors over their covariances follow chi-square laws."""
    runs, ticks = 200, 8
    random = np.random.default_rng(2)
    steps, rows = oracle(CASE, ticks)
    state = np.zeros((runs, 6))
    state[:, -1] = 0.4 * 9.81 + DEVIATION * random.normal(size=runs)
    commands, readings = random.normal(size=(runs, ticks, 1)), np.zeros((runs, ticks, 4))
    before = np.zeros((runs, 1))
    for k, (step, (C, D)) in enumerate(zip(steps, rows, strict=True)):
        values, vectors = np.linalg.eigh(step.noise)
        root = vectors * np.sqrt(np.maximum(values, 0))
        now = commands[:, k]
        state = state @ step.transition.T + before @ step.before.T + now @ step.after.T
        state, before = state + random.normal(size=(runs, 6)) @ root.T, now
        readings[:, k] = state @ C.T + now @ D.T + OFFSET + NOISE * random.normal(size=(runs, 4))
    each = jax.vmap(filtered, in_axes=(None, None, 0, 0))
    memory, (estimate, surprise) = each(ESTIMATED, CASE, commands, readings)
    low, high = chi2.interval(0.999, 4 * runs * ticks)
    assert low < np.sum(surprise) < high
    # The state of the shaker is known for certain.
    kept = np.array([0, 1, 2, 3, 5])
    error = (np.asarray(memory.state) - state)[:, kept]
    covariance = np.asarray(memory.covariance)[:, kept[:, None], kept]
    squares = np.einsum("ri,ri->r", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    low, high = chi2.interval(0.999, 5 * runs)
    assert low < np.sum(squares) < high
    assert np.all(np.sqrt(covariance[:, 4, 4]) < 0.6 * DEVIATION)  # it has learnt something
    assert_allclose(estimate.weights[:, -1, 0], memory.state[:, -1])


def test_gradients():
    commands, readings = signals(8)

    @jax.jit
    @jax.value_and_grad
    def misfit(point):
        case = jb.replace(CASE, {"loads.0.mass": point[0], "sensors.0.noise": 1e-5 * point[1]})
        kalman = dataclasses.replace(
            ESTIMATED, process_noise=point[2] * FORCES, weight_deviation=point[3]
        )
        estimate = filtered(kalman, case, commands, readings)[1][0]
        return jnp.sum((estimate.state[:, 2:4] * 100) ** 2)

    at = jnp.array([0.4, 1.0, 1.0, 2.0])
    differences = central(lambda point: misfit(point)[0], at, 1e-3)
    assert_allclose(misfit(at)[1], differences, rtol=1e-6)
