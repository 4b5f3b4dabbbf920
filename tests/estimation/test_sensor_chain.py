"""Kalman filters with filters and delays of the sensors: exact, white innovations, consistent."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose
from scipy.stats import chi2, norm

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant

PERIOD, DELAY = 5e-3, 2e-3
FORCES, DEVIATION = np.array([1e-2, 2e-2]), 2.0
NOISE = np.array([1e-5, 2e-4, 1e-5, 0.05])
SENSORS = [
    jb.Sensor(0.15, noise=1e-5, offset=1e-4, filter=jb.Filter(10.0, 4, realisation="analogue")),
    jb.Sensor(0.25, "velocity", noise=2e-4, offset=3e-3, filter=jb.Filter(20.0, 2)),
    jb.Sensor(0.35, noise=1e-5, delay=7e-3, filter=jb.Filter(30.0, 1)),
    jb.Sensor(0.45, "acceleration", noise=0.05, delay=3e-3),
]
OFFSET = np.array([1e-4, 3e-3, 0.0, 0.0])
# Times in a period at which the sensors sample (s), and whole periods of their delays.
SAMPLE_TIMES, WHOLE = np.array([PERIOD, PERIOD, 3e-3, 2e-3]), [0, 0, 1, 0]
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=0.4, speed=0.5, entry_time=-0.4)],
    controller=jb.Prescribed([0.0], period=PERIOD, delay=DELAY),
)
ESTIMATED = Kalman(FORCES, loads="estimated", weight_deviation=DEVIATION, max_delay_periods=2)
LAYOUT, TIMING = mesh_layout(CASE), sample_timing(CASE.controller)
SAMPLES, RUNS = 14, 100


class SimulatedPlant:
    """Plant with analogue filters and random forces, at the sample times of the sensors."""

    def __init__(self):
        span, loads, actuators, sensors = parts_of(CASE)
        self.plant = SampledPlant(span, loads, actuators, sensors)
        self.size = self.plant.size  # q, q', z, filter, weight
        self.intensity = np.diag([0.0, 0.0, *FORCES, *[0.0] * (self.size - 4)])
        # Times in the period: samples of delayed sensors, a new command, the next sample.
        self.part_ends = sorted({*SAMPLE_TIMES.tolist(), DELAY, PERIOD})

    def signals(self, t, state, command):
        _, _, C, D = self.plant.matrices(t)
        outputs = state @ C.T + command @ D.T
        part, _, _, row = self.plant.plant.filters[0]
        outputs[:, 0] = state[:, part] @ row
        return outputs

    def runs(self, random):
        """States and readings (run, sample, ...) at the samples, and commands until then."""
        start = -PERIOD
        state = np.zeros((RUNS, self.size))
        state[:, -1] = 0.4 * 9.81 + DEVIATION * random.normal(size=RUNS)
        commands = random.normal(size=(SAMPLES, RUNS, 1))
        raw = np.zeros((RUNS, SAMPLES + max(WHOLE), 4))
        states, previous = [], np.zeros((RUNS, 1))
        for k in range(SAMPLES):
            last = 0.0
            for part_end in self.part_ends:
                begin, end = start + k * PERIOD + last, start + k * PERIOD + part_end
                command = previous if part_end <= DELAY else commands[k]
                transition, input_matrix, noise = self.plant._integrated(begin, end, self.intensity)
                values, vectors = np.linalg.eigh(noise)
                shocks = random.normal(size=state.shape) * np.sqrt(np.maximum(values, 0))
                state = state @ transition.T + command @ input_matrix.T + shocks @ vectors.T
                outputs = self.signals(end, state, command)
                for i in np.flatnonzero(part_end == SAMPLE_TIMES):
                    raw[:, k + WHOLE[i], i] = outputs[:, i]
                last = part_end
            states.append(state)
            previous = commands[k]
        raw = raw[:, :SAMPLES]
        raw = raw + OFFSET + NOISE * random.normal(size=raw.shape)
        for i, sensor in enumerate(SENSORS):
            if sensor.filter is not None and sensor.filter.realisation == "digital":
                cutoff = float(sensor.filter.cutoff)
                sos = scipy.signal.butter(sensor.filter.order, cutoff, fs=1 / PERIOD, output="sos")
                rest = scipy.signal.sosfilt_zi(sos)[:, None] * np.full((1, RUNS, 1), OFFSET[i])
                raw[..., i], _ = scipy.signal.sosfilt(sos, raw[..., i], axis=1, zi=rest)
        return np.stack(states, axis=1), raw, np.moveaxis(commands, 0, 1)


@jax.jit
def filter_readings(commands, readings):
    """State of the filter after the last sample, and normalised innovations (sample, sensor)."""
    filter = ESTIMATED.sampled_filter(jb.state_space(CASE, layout=LAYOUT), TIMING)

    def update(state, sample):
        t, command, reading = sample
        prediction = filter.predict(state, command, t)
        root = jnp.linalg.cholesky(prediction.innovation_covariance)
        innovation = jnp.linalg.solve(root, reading - prediction.readings)
        _, state = filter.update(state, Measurement(reading, jnp.zeros(5), command), t)
        return state, innovation

    samples = PERIOD * jnp.arange(SAMPLES), commands, readings
    return jax.lax.scan(update, filter.initial_state(), samples)


def test_innovations_are_white_with_the_stated_covariance():
    """With analogue and digital Butterworth filters, delays, and an unknown weight."""
    states, readings, commands = SimulatedPlant().runs(np.random.default_rng(0))
    filter_state, innovations = jax.vmap(filter_readings)(
        jnp.asarray(commands), jnp.asarray(readings)
    )
    innovations = np.asarray(innovations)
    low, high = chi2.interval(0.999, innovations.size)
    assert low < np.sum(innovations**2) < high
    for sensor in range(4):
        low, high = chi2.interval(0.9999, RUNS * SAMPLES)
        assert low < np.sum(innovations[..., sensor] ** 2) < high
    # Products of innovations at different samples have mean 0 and variance 1.
    for lag in (1, 2, 3):
        products = np.einsum("rti,rtj->ij", innovations[:, lag:], innovations[:, :-lag])
        normalised = np.abs(products) / np.sqrt(RUNS * (SAMPLES - lag))
        assert np.max(normalised) < norm.isf(1e-4 / 2)
    # The state of the shaker has no noise; those of the analogue filter precede the weight.
    weight = jb.state_space(CASE, layout=LAYOUT).modal_model.state_count + 4
    kept = np.array([0, 1, 2, 3, weight])
    error = np.asarray(filter_state.x)[:, kept] - states[:, -1, [0, 1, 2, 3, -1]]
    covariance = np.asarray(filter_state.covariance)[:, kept[:, None], kept]
    squares = np.einsum("ri,ri->", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    low, high = chi2.interval(0.999, 5 * RUNS)
    assert low < squares < high
    assert np.all(np.sqrt(covariance[:, 4, 4]) < 0.6 * DEVIATION)  # the readings reduce it


@pytest.fixture(scope="module")
def crossing():
    """Regulator with the true state and sensors without noise: a case and its run."""
    noiseless = tuple(dataclasses.replace(sensor, noise=None) for sensor in SENSORS[:3])
    law = jb.LQR([3e4, 3e4, 1.0, 1.0, 0.0], [0.01], period=2e-3, delay=1e-3)
    loads = (jb.MovingMass(mass=0.4, speed=0.5, entry_time=0.0),)
    run = jb.Run(0.1)
    case = dataclasses.replace(CASE, sensors=noiseless, loads=loads, controller=law, run=run)
    return case, simulated(case)


def simulated(case):
    times = np.arange(51) * 2e-3
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, loop_schedule(case, times))
    return jb.simulate(case, jnp.asarray(times), plan)


def test_estimate_without_noise_is_the_state(crossing):
    """Delayed and filtered readings of a known load equal their predictions."""
    case, truth = crossing
    estimator = Kalman(FORCES, NOISE[:3], loads="known", max_delay_periods=4)
    law = dataclasses.replace(case.controller, estimator=estimator)
    record = simulated(dataclasses.replace(case, controller=law))
    size = np.max(np.abs(truth.command))
    assert size > 1e-3
    assert_allclose(record.command, truth.command, rtol=0, atol=1e-5 * size)


def test_gain_of_the_time_invariant_filter_is_the_limit():
    """Limit of the gain of the crossing filter while no load is on the beam."""
    sensors = (SENSORS[0], SENSORS[1], dataclasses.replace(SENSORS[2], filter=None))
    late_loads = (jb.MovingMass(mass=0.4, speed=0.5, entry_time=99.0),)
    case = dataclasses.replace(CASE, sensors=sensors, loads=late_loads)

    @jax.jit
    def gains():
        plant = jb.state_space(case, layout=LAYOUT)
        steady = Kalman(FORCES, max_delay_periods=2).sampled_filter(plant, TIMING)
        kalman = Kalman(FORCES, loads="known", max_delay_periods=2)
        filter = kalman.sampled_filter(plant, TIMING)
        at_rest = Measurement(jnp.asarray(OFFSET[:3]), jnp.zeros(5), jnp.zeros(1))
        state, _ = jax.lax.scan(
            lambda state, t: (filter.update(state, at_rest, t)[1], None),
            filter.initial_state(),
            PERIOD * jnp.arange(800),
        )
        last = filter.predict(state, jnp.zeros(1), jnp.asarray(4.0))
        gain = last.covariance @ last.C.T @ jnp.linalg.inv(last.innovation_covariance)
        return steady.gain, jnp.delete(gain, filter.sensor_chain.plant_states - 1, axis=0)

    steady, limit = gains()
    size = np.max(np.abs(limit), axis=1, keepdims=True) + np.finfo(float).tiny
    assert_allclose(steady / size, limit / size, rtol=0, atol=1e-5)


def test_delays_beyond_max_delay_periods_are_refused():
    late = (dataclasses.replace(SENSORS[2], delay=jnp.asarray(7e-3)),)
    law = jb.LQR([1.0] * 5, [1.0], period=PERIOD, estimator=Kalman(FORCES))
    case = dataclasses.replace(CASE, sensors=late, controller=law)
    message = "estimator.max_delay_periods must be at least 2, the periods of sensors.0.delay"
    with pytest.raises(ValueError, match=message):
        check_case(case)
