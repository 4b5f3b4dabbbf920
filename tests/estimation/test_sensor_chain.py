"""Kalman filters that know of the filters and delays of their sensors: exact, white, consistent."""

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
# When in a period the sensors look, and for how many ticks what they see is under way.
LOOKS, WHOLE = np.array([PERIOD, PERIOD, 3e-3, 2e-3]), [0, 0, 1, 0]
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
    sensors=SENSORS,
    loads=[jb.MovingMass(mass=0.4, speed=0.5, entry_time=-0.4)],
    controller=jb.Prescribed([0.0], period=PERIOD, delay=DELAY),
)
ESTIMATED = Kalman(FORCES, loads="estimated", weight_deviation=DEVIATION, reach=2)
LAYOUT = mesh_layout(CASE)
TICKS, RUNS = 14, 100


class Truth:
    """The plant with analogue filters and random forces, sampled where the sensors look."""

    def __init__(self):
        span, loads, actuators, sensors = parts_of(CASE)
        self.plant = SampledPlant(span, loads, actuators, sensors)
        self.size = self.plant.size  # q, q', z, filter, weight
        self.intensity = np.diag([0.0, 0.0, *FORCES, *[0.0] * (self.size - 4)])
        # Into the period: looks of the sensors that are late, a new command, the tick.
        self.stops = sorted({*LOOKS.tolist(), DELAY, PERIOD})

    def signals(self, t, state, command):
        _, _, C, D = self.plant.matrices(t)
        seen = state @ C.T + command @ D.T
        part, _, _, row = self.plant.plant.filters[0]
        seen[:, 0] = state[:, part] @ row
        return seen

    def runs(self, random):
        """States at the ticks and readings (run, tick, ...), and commands that acted until then."""
        start = -PERIOD
        state = np.zeros((RUNS, self.size))
        state[:, -1] = 0.4 * 9.81 + DEVIATION * random.normal(size=RUNS)
        commands = random.normal(size=(TICKS, RUNS, 1))
        raw = np.zeros((RUNS, TICKS + max(WHOLE), 4))
        states, before = [], np.zeros((RUNS, 1))
        for k in range(TICKS):
            last = 0.0
            for stop in self.stops:
                begin, end = start + k * PERIOD + last, start + k * PERIOD + stop
                acting = before if stop <= DELAY else commands[k]
                drift, push, noise = self.plant._integrated(begin, end, self.intensity)
                values, vectors = np.linalg.eigh(noise)
                shocks = random.normal(size=state.shape) * np.sqrt(np.maximum(values, 0))
                state = state @ drift.T + acting @ push.T + shocks @ vectors.T
                seen = self.signals(end, state, acting)
                for i in np.flatnonzero(stop == LOOKS):
                    raw[:, k + WHOLE[i], i] = seen[:, i]
                last = stop
            states.append(state)
            before = commands[k]
        raw = raw[:, :TICKS]
        raw = raw + OFFSET + NOISE * random.normal(size=raw.shape)
        for i, sensor in enumerate(SENSORS):
            if sensor.filter is not None and sensor.filter.realisation == "digital":
                cutoff = float(sensor.filter.cutoff)
                sos = scipy.signal.butter(sensor.filter.order, cutoff, fs=1 / PERIOD, output="sos")
                rest = scipy.signal.sosfilt_zi(sos)[:, None] * np.full((1, RUNS, 1), OFFSET[i])
                raw[..., i], _ = scipy.signal.sosfilt(sos, raw[..., i], axis=1, zi=rest)
        return np.stack(states, axis=1), raw, np.moveaxis(commands, 0, 1)


@jax.jit
def filtered(commands, readings):
    """The memory after the last tick, and normalised surprises (tick, sensor)."""

    def tick(memory, at):
        t, command, reading = at
        expected = memory.predicted(command, t)
        root = jnp.linalg.cholesky(expected.spread)
        surprise = jnp.linalg.solve(root, reading - expected.readings)
        _, memory = ESTIMATED.step(memory, Measurement(reading, jnp.zeros(5), command), t)
        return memory, surprise

    start = ESTIMATED.init(jb.state_space(CASE, layout=LAYOUT))
    return jax.lax.scan(tick, start, (PERIOD * jnp.arange(TICKS), commands, readings))


@pytest.mark.slow
def test_surprises_are_white_and_as_large_as_stated():
    """With Butterworth filters of both kinds, delays, a late command, and the weight unknown."""
    states, readings, commands = Truth().runs(np.random.default_rng(0))
    memory, surprises = jax.vmap(filtered)(jnp.asarray(commands), jnp.asarray(readings))
    surprises = np.asarray(surprises)
    low, high = chi2.interval(0.999, surprises.size)
    assert low < np.sum(surprises**2) < high
    for sensor in range(4):
        low, high = chi2.interval(0.9999, RUNS * TICKS)
        assert low < np.sum(surprises[..., sensor] ** 2) < high
    # Of neighbouring ticks they have nothing in common: products have mean 0 and variance 1.
    for lag in (1, 2, 3):
        products = np.einsum("rti,rtj->ij", surprises[:, lag:], surprises[:, :-lag])
        far = np.abs(products) / np.sqrt(RUNS * (TICKS - lag))
        assert np.max(far) < norm.isf(1e-4 / 2)
    # The state of the shaker is known for certain; those of the filter lie before the weight.
    kept = np.array([0, 1, 2, 3, memory.behind.plant - 1])
    error = np.asarray(memory.state)[:, kept] - states[:, -1, [0, 1, 2, 3, -1]]
    covariance = np.asarray(memory.covariance)[:, kept[:, None], kept]
    squares = np.einsum("ri,ri->", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    low, high = chi2.interval(0.999, 5 * RUNS)
    assert low < squares < high
    assert np.all(np.sqrt(covariance[:, 4, 4]) < 0.6 * DEVIATION)  # it has learnt something


@pytest.fixture(scope="module")
def crossing():
    """A regulator fed the true state, through noiseless sensors: a case and its run."""
    quiet = tuple(dataclasses.replace(sensor, noise=None) for sensor in SENSORS[:3])
    law = jb.LQR([3e4, 3e4, 1.0, 1.0, 0.0], [0.01], period=2e-3, delay=1e-3)
    loads = (jb.MovingMass(mass=0.4, speed=0.5, entry_time=0.0),)
    run = jb.Run(0.1)
    case = dataclasses.replace(CASE, sensors=quiet, loads=loads, controller=law, run=run)
    return case, simulated(case)


def simulated(case):
    times = np.arange(51) * 2e-3
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, loop_schedule(case, times))
    return jb.simulate(case, jnp.asarray(times), plan)


@pytest.mark.slow
def test_without_noise_the_estimate_is_the_state(crossing):
    """Late and filtered readings of a known load move nothing: all of them are expected."""
    case, truth = crossing
    estimator = Kalman(FORCES, NOISE[:3], loads="known", reach=4)
    law = dataclasses.replace(case.controller, estimator=estimator)
    record = simulated(dataclasses.replace(case, controller=law))
    size = np.max(np.abs(truth.command))
    assert size > 1e-3
    assert_allclose(record.command, truth.command, rtol=0, atol=1e-5 * size)


def test_the_steady_filter_is_what_a_long_run_comes_to():
    """Its gain is the limit of the filter along a crossing, with nothing on the beam."""
    sensors = (SENSORS[0], SENSORS[1], dataclasses.replace(SENSORS[2], filter=None))
    far = (jb.MovingMass(mass=0.4, speed=0.5, entry_time=99.0),)
    case = dataclasses.replace(CASE, sensors=sensors, loads=far)

    @jax.jit
    def found():
        model = jb.state_space(case, layout=LAYOUT)
        steady = Kalman(FORCES, reach=2).init(model)
        start = Kalman(FORCES, loads="known", reach=2).init(model)
        nothing = Measurement(jnp.asarray(OFFSET[:3]), jnp.zeros(5), jnp.zeros(1))
        later, _ = jax.lax.scan(
            lambda memory, t: (memory.update(nothing, t), None),
            start,
            PERIOD * jnp.arange(800),
        )
        expected = later.predict(jnp.zeros(1), jnp.asarray(4.0))
        gain = expected.covariance @ expected.C.T @ jnp.linalg.inv(expected.innovation_covariance)
        return steady.gain, jnp.delete(gain, later.sensor_chain.plant_states - 1, axis=0)

    steady, limit = found()
    size = np.max(np.abs(limit), axis=1, keepdims=True) + np.finfo(float).tiny
    assert_allclose(steady / size, limit / size, rtol=0, atol=1e-5)


def test_longer_delays_than_are_modelled_are_refused():
    late = (dataclasses.replace(SENSORS[2], delay=jnp.asarray(7e-3)),)
    law = jb.LQR([1.0] * 5, [1.0], period=PERIOD, estimator=Kalman(FORCES))
    case = dataclasses.replace(CASE, sensors=late, controller=law)
    message = "estimator.reach must be at least 2, the periods of sensors.0.delay"
    with pytest.raises(ValueError, match=message):
        check_case(case)
