"""Readings of logs and their derivatives by the parameters of a fit, against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.runtime.compile_cache import program_name
from jaxbeam.runtime.compiling import _partition, _signature
from tuning import Log
from tuning.fit.dataset import make_dataset
from tuning.parameters.prediction import LogPrediction, readings_with_slopes

ADDRESSES = [
    "beam.flexural_rigidity",
    "logs.1.loads.0.speed",
    "sensors.1.offset",
    "logs.0.sensors.0.offset",
]
VALUES = np.array([12.5, 2.4, 1e-4, -2e-4])


@pytest.fixture(scope="module")
def dataset():
    case = jb.Case(
        beam=jb.Beam(
            length=1.0,
            flexural_rigidity=12.0,
            mass_per_length=0.5,
            damping_ratio=0.02,
            modes=3,
        ),
        sensors=[jb.Sensor(position=0.4), jb.Sensor(position=0.7, offset=3e-4)],
        loads=[jb.MovingMass(mass=0.1, speed=2.0)],
        run=jb.Run(0.5, sample_rate=100.0),
    )
    logs = []
    for speed in (2.0, 2.5):
        record = jb.simulate(jb.replace(case, {"loads.0.speed": speed}))
        columns = ("a", "b"), ("deflection",) * 2, ("m",) * 2, f"{speed} m/s", (0, 1)
        logs.append(Log(record.times, record.measured, *columns, loads=record.case.loads))
    return make_dataset(case, logs)


def test_derivatives_equal_differences(dataset):
    prediction = dataset.prediction(ADDRESSES)
    readings, slopes = prediction.linearised(VALUES)
    predict = jax.jit(prediction.predict)
    np.testing.assert_allclose(readings, predict(VALUES), rtol=0, atol=1e-15)
    for i, step in enumerate([1e-4, 1e-5, 1e-5, 1e-5]):
        change = step * np.eye(len(VALUES))[i]
        differences = (predict(VALUES + change) - predict(VALUES - change)) / (2 * step)
        size = np.abs(differences).max()
        np.testing.assert_allclose(slopes[..., i], differences, rtol=0, atol=1e-6 * size)


def test_log_parameters_and_offsets_change_only_their_own(dataset):
    _, slopes = dataset.prediction(ADDRESSES).linearised(VALUES)
    speed, both_offsets, one_offset = slopes[..., 1], slopes[..., 2], slopes[..., 3]
    assert np.all(speed[0] == 0.0) and np.any(speed[1] != 0.0)
    assert np.all(both_offsets == [0.0, 1.0])
    assert np.all(one_offset[0] == [1.0, 0.0]) and np.all(one_offset[1] == 0.0)


def test_derivatives_along_a_direction_are_those_of_the_program(dataset):
    prediction = dataset.prediction(ADDRESSES)
    _, slopes = prediction.linearised(VALUES)
    direction = np.array([0.3, -0.2, 1e-3, 2e-3])
    _, moved = jax.jvp(prediction.predict, (jnp.asarray(VALUES),), (jnp.asarray(direction),))
    np.testing.assert_allclose(moved, slopes @ direction, rtol=0, atol=1e-14)


def test_fixed_offsets_are_in_the_readings(dataset):
    readings, slopes = dataset.prediction(["sensors.0.offset"]).linearised(np.array([5e-4]))
    before = dataset.measured - np.array([0.0, 3e-4])
    np.testing.assert_allclose(readings, before + np.array([5e-4, 3e-4]), rtol=0, atol=1e-8)
    assert np.all(slopes[..., 0] == [1.0, 0.0])


def test_fits_of_one_structure_share_a_program(dataset):
    """Also other processes: it has a name in the cache of programs."""
    first = dataset.prediction(ADDRESSES)
    slower = [jb.replace(case, {"loads.0.speed": 1.9}) for case in dataset.cases]
    other = LogPrediction(
        slower, 1.01 * dataset.times, dataclasses.replace(dataset.plan, error=1e-3), None, ADDRESSES
    )
    entries = []
    for prediction in (first, other):
        arrays, *rest = _partition((prediction._log(0, prediction.given), {}))
        entries.append(readings_with_slopes._entry(arrays, rest))
    assert entries[0] is entries[1]
    assert program_name(readings_with_slopes, _signature(arrays, rest))
    ready, _ = first.linearised(VALUES)
    changed, _ = other.linearised(VALUES)
    assert entries[0].compiled and np.any(ready != changed)
