"""Estimates where readings are missing, against filters of the other sensors and by hand."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.estimation.sampled_plant import sample_timing

PERIOD = 4e-3
SENSORS = [jb.Sensor(0.2), jb.Sensor(0.35), jb.Sensor(0.45, offset=1e-4)]


def loop(sensors, estimator) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(0.4)],
        sensors=sensors,
        loads=[jb.MovingMass(mass=0.4, speed=4.0)],
        controller=jb.StateFeedback([[0.0] * 4], period=PERIOD, estimator=estimator),
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
        estimate, state = filter.update(state, measurement, np.asarray(k * PERIOD))
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
    found = replayed(loop(SENSORS, estimator), readings, present)
    expected = replayed(loop(SENSORS[::2], estimator), readings[:, ::2])
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
    case, readings = loop(SENSORS, estimator), random_readings()
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
    case, readings = loop(SENSORS[:2], jb.Inversion()), random_readings(6)[:, :2]
    present = np.ones((6, 2), bool)
    present[2, 0] = present[3, 1] = False
    found, _, _ = replayed(case, readings, present)
    x = np.sin(np.pi * np.outer([0.2, 0.35], [1, 2]) / 0.6) * np.sqrt(2 / (0.535 * 0.6))
    q = np.linalg.solve(x, readings.T).T
    rates = np.diff(q, axis=0) / PERIOD
    assert_allclose(found[1], [*q[1], *rates[0]], rtol=1e-9)
    assert_allclose(found[[2, 3]], np.tile(found[1], (2, 1)), rtol=1e-12)
    assert_allclose(found[4], [*q[4], *(q[4] - q[1]) / (3 * PERIOD)], rtol=1e-9)
    assert_allclose(found[5], [*q[5], *rates[4]], rtol=1e-9)


def test_samples_without_a_deflection_do_not_identify_a_load():
    """The mass is that of the samples that are left, by least squares."""
    settings = jb.LoadIdentification(gates=[-0.1, -0.05])
    case = loop(SENSORS[:2], None)
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
            _, state = identifier.update(state, measurement, np.asarray(k * PERIOD))
        return state

    all_rows = list(range(20))
    complete = [k for k in all_rows if present[k].all()]
    assert 0 < len(complete) < 20
    assert_allclose(sums(all_rows), sums(complete), rtol=1e-12)


def test_identification_pauses_with_missing_readings():
    """Adaptive predictive control: coefficients stay until the past readings are complete again."""
    law = jb.AdaptiveGPC(4, 2, 1e-9, measurement_noise=1e-6, period=PERIOD, more_delay=1)
    case = dataclasses.replace(loop(SENSORS[:1], None), controller=law)
    law = law.law(jb.state_space(case))
    random, state, before = np.random.default_rng(6), law.initial_state(), None
    changed = []
    for k in range(20):
        measurement = Measurement(
            1e-4 * random.normal(size=1), np.zeros(4), random.normal(size=1), np.array([k != 6])
        )
        before, state = state, law.step(state, measurement, np.asarray(k * PERIOD)).state
        changed.append(bool(np.any(before.coefficients != state.coefficients)))
    assert changed == [k > 0 and not 6 <= k <= 6 + law.powers + 1 for k in range(20)]
