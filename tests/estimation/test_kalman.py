"""Kalman filters against brute-force Gaussian conditioning; statistics of innovations."""

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
from jaxbeam.estimation.sampled_plant import sample_timing
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
def filter_readings(kalman, case, commands, readings):
    """State of the filter after the last sample; estimates and squared innovations (sample, ...).

    Innovations are squared over their covariance.
    """
    plant = jb.state_space(case, layout=LAYOUT)
    filter = kalman.sampled_filter(plant, sample_timing(case.controller))

    def update(state, sample):
        t, command, reading = sample
        square = jnp.zeros(())
        if kalman.loads != "ignored":
            prediction = filter.predict(state, command, t)
            innovation = reading - prediction.readings
            square = innovation @ jnp.linalg.solve(prediction.innovation_covariance, innovation)
        measurement = Measurement(reading, jnp.zeros(5), command)
        estimate, state = filter.update(state, measurement, t)
        return state, (estimate, square)

    samples = PERIOD * jnp.arange(len(readings)), commands, readings
    return jax.lax.scan(update, filter.initial_state(), samples)


def oracle(case, samples, delay=0.0, loaded=True):
    """Transitions and rows (C, D) of the readings at the samples, by the oracle."""
    span, loads, actuators, sensors = parts_of(case)
    plant = SampledPlant(span, loads if loaded else [], actuators, sensors)
    intensity = np.diag([0.0, 0.0, *FORCES, 0.0, *([0.0] * loaded)])
    times = PERIOD * np.arange(samples if loaded else 1)
    steps = [plant.step(t, PERIOD, delay, intensity) for t in times]
    rows = [plant.matrices(t)[2:] for t in times]
    return (steps, rows) if loaded else (steps * samples, rows * samples)


def signals(samples):
    """Random commands and readings."""
    random = np.random.default_rng(1)
    return random.normal(size=(samples, 1)), NOISE * random.normal(size=(samples, 4)) * 10


@pytest.mark.parametrize(
    ("kalman", "delay", "samples"),
    [
        (Kalman(FORCES), 0.0022, 240),
        (Kalman(FORCES, loads="known"), None, 8),
        (ESTIMATED, 0.0013, 8),
    ],
    ids=lambda x: getattr(x, "loads", None),
)
def test_estimates_by_gaussian_conditioning(kalman, delay, samples):
    """The time-invariant filter has forgotten its initial state by the last sample."""
    loaded = kalman.loads != "ignored"
    commands, readings = signals(samples)
    filter_state, (estimate, _) = filter_readings(
        kalman, with_delay(CASE, delay), commands, readings
    )
    remainder = 0.0 if delay is None else delay % PERIOD
    steps, rows = oracle(CASE, samples, remainder, loaded)
    size = steps[0].transition.shape[0]
    mean, covariance = np.zeros(size), np.zeros((size, size))
    if loaded:
        mean[-1] = 0.4 * 9.81
        covariance[-1, -1] = DEVIATION**2 if kalman.loads == "estimated" else 0.0
    state, covariance = conditioned(
        (mean, covariance), steps, rows, np.diag(NOISE**2), commands, readings - OFFSET
    )
    scale = np.sqrt(np.diag(covariance)) + 1e-6 * np.abs(state)
    assert_allclose(filter_state[0] / scale, state / scale, rtol=0, atol=1e-4)
    if loaded:
        outer = scale * scale[:, None]
        assert_allclose(filter_state.covariance / outer, covariance / outer, rtol=0, atol=1e-4)
    if kalman.loads == "estimated":
        assert_allclose(estimate.weights[-1, 0], state[-1], rtol=1e-4)
    else:
        assert estimate.weights is None


def test_innovations_and_errors_have_the_stated_covariance():
    """Squares over their covariances follow chi-square distributions."""
    runs, samples = 200, 8
    random = np.random.default_rng(2)
    steps, rows = oracle(CASE, samples)
    state = np.zeros((runs, 6))
    state[:, -1] = 0.4 * 9.81 + DEVIATION * random.normal(size=runs)
    commands, readings = random.normal(size=(runs, samples, 1)), np.zeros((runs, samples, 4))
    previous = np.zeros((runs, 1))
    for k, (step, (C, D)) in enumerate(zip(steps, rows, strict=True)):
        values, vectors = np.linalg.eigh(step.noise)
        root = vectors * np.sqrt(np.maximum(values, 0))
        command = commands[:, k]
        state = state @ step.transition.T + previous @ step.before.T + command @ step.after.T
        state, previous = state + random.normal(size=(runs, 6)) @ root.T, command
        noise = NOISE * random.normal(size=(runs, 4))
        readings[:, k] = state @ C.T + command @ D.T + OFFSET + noise
    for_runs = jax.vmap(filter_readings, in_axes=(None, None, 0, 0))
    filter_state, (estimate, squares) = for_runs(ESTIMATED, CASE, commands, readings)
    low, high = chi2.interval(0.999, 4 * runs * samples)
    assert low < np.sum(squares) < high
    # The state of the shaker has no noise.
    kept = np.array([0, 1, 2, 3, 5])
    error = (np.asarray(filter_state.x) - state)[:, kept]
    covariance = np.asarray(filter_state.covariance)[:, kept[:, None], kept]
    squares = np.einsum("ri,ri->r", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    low, high = chi2.interval(0.999, 5 * runs)
    assert low < np.sum(squares) < high
    assert np.all(np.sqrt(covariance[:, 4, 4]) < 0.6 * DEVIATION)  # the readings reduce it
    assert_allclose(estimate.weights[:, -1, 0], filter_state.x[:, -1])


def test_gradients():
    commands, readings = signals(8)

    @jax.jit
    @jax.value_and_grad
    def misfit(point):
        case = jb.replace(CASE, {"loads.0.mass": point[0], "sensors.0.noise": 1e-5 * point[1]})
        kalman = dataclasses.replace(
            ESTIMATED, process_noise=point[2] * FORCES, weight_deviation=point[3]
        )
        estimate = filter_readings(kalman, case, commands, readings)[1][0]
        return jnp.sum((estimate.state[:, 2:4] * 100) ** 2)

    at = jnp.array([0.4, 1.0, 1.0, 2.0])
    differences = central(lambda point: misfit(point)[0], at, 1e-3)
    assert_allclose(misfit(at)[1], differences, rtol=1e-6)
