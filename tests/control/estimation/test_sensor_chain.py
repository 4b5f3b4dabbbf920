"""Kalman filters with filters and delays of the sensors: exact, white innovations, consistent."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, norm

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.control.estimation.test_kalman import (
    CASE as STREAM_CASE,
    FORCES as STREAM_FORCES,
    NOISE as STREAM_NOISE,
    OFFSET as STREAM_OFFSET,
    PERIOD as STREAM_PERIOD,
    filter_readings as stream_filter_readings,
    signals,
)
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant, conditioned

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


@pytest.mark.parametrize("lag", [1.5e-3, 5e-4])
def test_delayed_accelerations_have_the_command_of_their_time(lag):
    """Sampled before and after the command changes, 1 ms into each period of 2 ms."""
    sensors = jb.Sensor(0.15), jb.Sensor(0.45, "acceleration", delay=lag)
    law = jb.LQR([3e4, 3e4, 1.0, 1.0], [0.01], period=2e-3, delay=1e-3)
    case = dataclasses.replace(
        CASE, actuators=(jb.PointForce(0.4),), sensors=sensors, controller=law, run=jb.Run(0.1)
    )
    loads = (jb.MovingMass(mass=0.4, speed=0.5, entry_time=0.0),)
    estimator = Kalman(FORCES, np.array([1e-5, 1e-3]), loads="known")
    truth = simulated(dataclasses.replace(case, loads=loads))
    law = dataclasses.replace(law, estimator=estimator)
    record = simulated(dataclasses.replace(case, loads=loads, controller=law))
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


# Estimates where readings are missing, against filters of the other sensors and by hand.

MISSING_PERIOD = 4e-3
MISSING_SENSORS = [jb.Sensor(0.2), jb.Sensor(0.35), jb.Sensor(0.45, offset=1e-4)]


def loop(sensors, estimator) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(0.4)],
        sensors=sensors,
        loads=[jb.MovingMass(mass=0.4, speed=4.0)],
        controller=jb.StateFeedback([[0.0] * 4], period=MISSING_PERIOD, estimator=estimator),
        run=jb.Run(0.12),
    )


def replayed(case, readings, present=None):
    """Estimates of the state and the weights, and the last state of the filter."""
    controller = case.controller
    filter = controller.estimator.sampled_filter(jb.state_space(case), sample_timing(controller))
    state, states, weights = filter.initial_state(), [], []
    for k, reading in enumerate(readings):
        known = None if present is None else present[k]
        measurement = Measurement(reading, np.zeros(4), np.array([0.1 * k]), known)
        estimate, state = filter.update(state, measurement, np.asarray(k * MISSING_PERIOD))
        states.append(estimate.state)
        weights.append(estimate.weights)
    return np.array(states), weights, state


def random_readings(samples=16):
    return np.cumsum(np.random.default_rng(2).normal(size=(samples, 3)), axis=0) * 1e-5


def test_extended_filter_without_a_sensor_is_that_of_the_others():
    """A sensor whose readings are all missing changes neither estimate nor covariance.

    With less process noise the covariance is so nearly singular that another order of the same
    sensors changes the estimate by 1e-9, too.
    """
    estimator = jb.ExtendedKalman(1.0, 1e-5, mass_deviation=0.1, speed_deviation=0.2)
    readings, present = random_readings(8), np.tile([True, False, True], (8, 1))
    found = replayed(loop(MISSING_SENSORS, estimator), readings, present)
    expected = replayed(loop(MISSING_SENSORS[::2], estimator), readings[:, ::2])
    assert_allclose(found[0], expected[0], rtol=1e-9, atol=1e-12)
    assert_allclose(found[2].covariance, expected[2].covariance, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    "estimator",
    [
        jb.Observer(speed=2.0),
        jb.Kalman(0.02, 1e-5),
        jb.Kalman(0.02, 1e-5, loads="estimated", weight_deviation=1.0),
        jb.MovingHorizon(0.02, 1e-5, weight_deviation=1.0),
    ],
    ids=["observer", "kalman", "kalman-estimated", "moving-horizon"],
)
def test_missing_readings_correct_nothing(estimator):
    """As if they were what the filter expects, by which innovations are zero."""
    case, readings = loop(MISSING_SENSORS, estimator), random_readings()
    present = np.random.default_rng(3).uniform(size=readings.shape) < 0.6
    found, weights, _ = replayed(case, readings, present)
    changed = np.where(present, readings, np.nan_to_num(readings) + 1.0)
    assert_array_equal(found, replayed(case, changed, present)[0])
    complete = np.ones_like(present)
    assert_allclose(replayed(case, readings, complete)[0], replayed(case, readings)[0], rtol=1e-12)
    # One by one: the correction is linear in the innovations, to which a missing one adds nothing.
    full = replayed(case, readings)[0]
    first = np.flatnonzero(~present.all(axis=1))[0]
    assert_allclose(found[:first], full[:first], rtol=1e-12)
    assert np.any(found[first] != full[first]) and np.all(np.isfinite(found))


def test_inversion_keeps_its_estimate_until_all_deflections_come():
    """Then its rates are the difference over the whole time; without a lag, by hand."""
    case, readings = loop(MISSING_SENSORS[:2], jb.Inversion()), random_readings(6)[:, :2]
    present = np.ones((6, 2), bool)
    present[2, 0] = present[3, 1] = False
    found, _, _ = replayed(case, readings, present)
    x = np.sin(np.pi * np.outer([0.2, 0.35], [1, 2]) / 0.6) * np.sqrt(2 / (0.535 * 0.6))
    q = np.linalg.solve(x, readings.T).T
    rates = np.diff(q, axis=0) / MISSING_PERIOD
    assert_allclose(found[1], [*q[1], *rates[0]], rtol=1e-9)
    assert_allclose(found[[2, 3]], np.tile(found[1], (2, 1)), rtol=1e-12)
    assert_allclose(found[4], [*q[4], *(q[4] - q[1]) / (3 * MISSING_PERIOD)], rtol=1e-9)
    assert_allclose(found[5], [*q[5], *rates[4]], rtol=1e-9)


def test_samples_without_a_deflection_do_not_identify_a_load():
    """The mass is that of the samples that are left, by least squares."""
    settings = jb.LoadIdentification(gates=[-0.1, -0.05])
    case = loop(MISSING_SENSORS[:2], None)
    plant = jb.state_space(case)
    identifier = settings.identifier(plant, plant)
    readings = -1e-3 * np.random.default_rng(4).uniform(size=(20, 2))
    present = np.random.default_rng(5).uniform(size=(20, 2)) < 0.7
    no_state, command = np.zeros(4), np.zeros(1)

    def sums(rows):
        state = identifier.initial_state()
        for k in rows:
            measurement = Measurement(
                readings[k], no_state, command, present[k] | (rows != all_rows)
            )
            _, state = identifier.update(state, measurement, np.asarray(k * MISSING_PERIOD))
        return state

    all_rows = list(range(20))
    complete = [k for k in all_rows if present[k].all()]
    assert 0 < len(complete) < 20
    assert_allclose(sums(all_rows), sums(complete), rtol=1e-12)


def test_identification_pauses_with_missing_readings():
    """Adaptive predictive control: coefficients stay until the past readings are complete again."""
    law = jb.AdaptiveGPC(4, 2, 1e-9, measurement_noise=1e-6, period=MISSING_PERIOD, more_delay=1)
    case = dataclasses.replace(loop(MISSING_SENSORS[:1], None), controller=law)
    law = law.law(jb.state_space(case))
    random, state, before = np.random.default_rng(6), law.initial_state(), None
    changed = []
    for k in range(20):
        measurement = Measurement(
            1e-4 * random.normal(size=1), np.zeros(4), random.normal(size=1), np.array([k != 6])
        )
        before, state = state, law.step(state, measurement, np.asarray(k * MISSING_PERIOD)).state
        changed.append(bool(np.any(before.coefficients != state.coefficients)))
    assert changed == [k > 0 and not 6 <= k <= 6 + law.powers + 1 for k in range(20)]


# Kalman filters under several overlapping loads, against Gaussian conditioning.

STREAM_SAMPLES, MASSES, STREAM_DEVIATION = 8, np.array([0.4, 0.3, 0.2]), np.array([2.0, 1.0, 0.5])
# Two on the beam from the start, and one that enters at the fifth sample.
LOADS = [
    jb.MovingMass(mass=MASSES[0], speed=0.5, entry_time=-0.8),
    jb.MovingForce(mass=MASSES[1], speed=0.8, entry_time=-0.4),
    jb.MovingMass(mass=MASSES[2], speed=0.5, entry_time=4 * STREAM_PERIOD),
]
STREAM = dataclasses.replace(STREAM_CASE, loads=tuple(LOADS))


class StreamPlant(SampledPlant):
    """Plant under several loads: a column for each weight, by the mass matrix."""

    def matrices(self, t):
        A, B, C, D = super().matrices(t)
        span, n = self.plant.span, self.plant.span.modes
        on = [x.entry_time <= t < x.time_at(span.length) for x in self.loads]
        shapes = [span.shapes(x.motion(t, span.length, False)[0]) for x in self.loads]
        massive = [
            x.kind == "mass" and is_on_beam for x, is_on_beam in zip(self.loads, on, strict=True)
        ]
        masses = [x.mass * has_mass for x, has_mass in zip(self.loads, massive, strict=True)]
        mass = np.eye(n) + sum(m * np.outer(s, s) for m, s in zip(masses, shapes, strict=True))
        for i, (shape, is_on_beam) in enumerate(zip(shapes, on, strict=True), self.inner):
            A[:, i], C[:, i] = 0.0, 0.0
            A[n : 2 * n, i] = -np.linalg.solve(mass, shape) * is_on_beam
            C[2, i] = self.plant.rows[2] @ A[n : 2 * n, i]  # the accelerometer
        return A, B, C, D


@pytest.mark.parametrize("loads", ["known", "estimated"])
def test_estimates_by_gaussian_conditioning(loads):
    """The weight of a load before its entry keeps its prior."""
    deviation = STREAM_DEVIATION if loads == "estimated" else None
    commands, readings = signals(STREAM_SAMPLES)
    kalman = Kalman(STREAM_FORCES, loads=loads, weight_deviation=deviation)
    filter_state, (estimate, _) = stream_filter_readings(kalman, STREAM, commands, readings)
    span, oracle_loads, actuators, sensors = parts_of(STREAM)
    plant = StreamPlant(span, oracle_loads, actuators, sensors)
    intensity = np.diag([0.0, 0.0, *STREAM_FORCES, *[0.0] * 4])
    times = STREAM_PERIOD * np.arange(STREAM_SAMPLES)
    steps = [plant.step(t, STREAM_PERIOD, 0.0, intensity) for t in times]
    rows = [plant.matrices(t)[2:] for t in times]
    mean, covariance = np.zeros(8), np.zeros((8, 8))
    mean[5:] = MASSES * 9.81
    if loads == "estimated":
        covariance[5:, 5:] = np.diag(STREAM_DEVIATION**2)
    state, covariance = conditioned(
        (mean, covariance),
        steps,
        rows,
        np.diag(STREAM_NOISE**2),
        commands,
        readings - STREAM_OFFSET,
    )
    scale = np.sqrt(np.diag(covariance)) + 1e-6 * np.abs(state)
    assert_allclose(filter_state.x / scale, state / scale, rtol=0, atol=1e-3)
    if loads == "estimated":
        outer = scale * scale[:, None]
        assert_allclose(filter_state.covariance / outer, covariance / outer, rtol=0, atol=1e-3)
        assert_allclose(estimate.weights[-1], state[5:], rtol=1e-3)
        assert estimate.weights[3, 2] == 0  # off the beam
        assert_allclose(filter_state.x[5:8], state[5:], rtol=1e-3)
