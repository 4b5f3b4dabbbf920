"""Free parameters: found by address, mapped between their bounds, or refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace, unit_at
from tuning import Log
from tuning.fit.dataset import make_dataset
from tuning.parameters import (
    FreeParameter,
    LogPrediction,
    as_prior,
    free_parameters,
    readings_with_slopes,
    with_values,
)

CASE = jb.Case(
    beam=jb.Beam(length=1.0, flexural_rigidity=20.0, mass_per_length=2.0, damping_ratio=[0.01] * 3,
                 modes=3),
    supports=[jb.Support(position=0.4, stiffness=1e4)],
    sensors=[jb.Sensor(position=0.5), jb.Sensor(position=0.5, quantity="acceleration")],
    loads=[jb.MovingMass(mass=0.5, speed=-1.0)],
    run=jb.Run(duration=2.0),
)  # fmt: skip
CASES = [CASE, replace(CASE, {"loads.0.speed": -2.0})]


def free(address, pair=None) -> FreeParameter:
    return free_parameters(CASES, {address: pair}, largest_reading=0.01)[0]


RANGES = [(-1.0, 3.0), (0.5, np.inf), (-np.inf, 2.0), (-np.inf, np.inf)]


@pytest.mark.parametrize("low, high", RANGES)
@pytest.mark.parametrize("value", [0.6, 1.0, 1.9])
def test_mapping_is_inverted_and_within_the_bounds(low, high, value):
    parameter = FreeParameter("x", "m", 1.0, low, high, 1.0)
    np.testing.assert_allclose(
        float(parameter.from_unbounded(jnp.asarray(parameter.to_unbounded(value)))),
        value,
        rtol=1e-12,
    )
    for y in (-30.0, -1.0, 0.0, 2.0, 30.0):
        assert low <= parameter.from_unbounded(jnp.asarray(y)) <= high


@pytest.mark.parametrize("low, high", RANGES[:3])
def test_a_start_on_a_bound_is_moved_inside(low, high):
    parameter = FreeParameter("x", "m", 1.0, low, high, 1.0)
    bound = low if np.isfinite(low) else high
    inner = float(parameter.from_unbounded(jnp.asarray(parameter.to_unbounded(bound))))
    assert inner == pytest.approx(bound, abs=2e-3) and inner != bound
    assert parameter.at_bound(bound) and not parameter.at_bound(1.0)


@pytest.mark.parametrize(
    "address, low, high, size, unit",
    [
        ("beam.flexural_rigidity", 0.0, np.inf, 20.0, "N m^2"),
        ("beam.damping_ratio.1", 0.0, np.inf, 0.01, "1"),
        ("supports.0.stiffness", 0.0, np.inf, 1e4, "N/m"),
        ("logs.1.loads.0.speed", -np.inf, 0.0, 2.0, "m/s"),
        ("loads.0.entry_time", -np.inf, np.inf, 2.0, "s"),
        ("sensors.0.offset", -np.inf, np.inf, 0.01, "m"),
        ("logs.0.sensors.1.offset", -np.inf, np.inf, 0.01, "m/s^2"),
    ],
)
def test_ranges_sizes_and_units_without_bounds(address, low, high, size, unit):
    parameter = free(address)
    assert (parameter.low, parameter.high, parameter.typical_size, parameter.unit) == (
        low,
        high,
        size,
        unit,
    )


def test_bounds_give_the_size():
    parameter = free("beam.mass_per_length", (1.0, 4.0))
    assert (parameter.low, parameter.high, parameter.typical_size, parameter.start) == (
        1.0,
        4.0,
        3.0,
        2.0,
    )


def test_values_of_one_log():
    values = {"loads.0.mass": 0.7, "logs.1.loads.0.speed": -3.0}
    first, second = (with_values(case, i, values) for i, case in enumerate(CASES))
    assert (float(first.loads[0].mass), float(first.loads[0].speed)) == (0.7, -1.0)
    assert (float(second.loads[0].mass), float(second.loads[0].speed)) == (0.7, -3.0)


def test_units_of_all_numbers():
    assert unit_at(CASE, "run.gravity") == "m/s^2"
    assert unit_at(CASE, "beam.damping_ratio") == "1"


@pytest.mark.parametrize(
    "bounds, message",
    [
        ({}, "name at least one address"),
        ({"beam.rigidty": None}, "did you mean"),
        ({"beam.damping_ratio": None}, "is a list; free its entries, beam.damping_ratio.0"),
        ({"beam.length": (2.0, 1.0)}, "beam.length: the lower bound 2 is not below the upper, 1"),
        ({"beam.length": (2.0, 3.0)}, "beam.length starts at 1, outside its bounds 2 to 3: change"),
        ({"loads.0.speed": None}, "loads.0.speed differs between the logs; say which one, as in "),
        ({"logs.2.loads.0.speed": None}, "no such log; the last log is logs.1"),
        ({"logs.0.loads.3.speed": None}, "did you mean 'loads.0.speed'"),
        ({"loads.0.deceleration": None}, "starts at 0, which does not say how large it may be"),
        (
            {"loads.0.mass": None, "logs.1.loads.0.mass": None},
            "loads.0.mass and logs.1.loads.0.mass both give the number loads.0.mass",
        ),
        (
            {"logs.1.loads.0.mass": None, "loads.*.mass": None},
            "logs.1.loads.0.mass and loads.*.mass both give the number loads.0.mass",
        ),
    ],
    ids=lambda value: None if isinstance(value, str) else ",".join(value) or "none",
)
def test_faulty_addresses_and_bounds_are_refused(bounds, message):
    with pytest.raises(ValueError) as refused:
        free_parameters(CASES, bounds, 0.01)
    assert message in str(refused.value)


# Readings of logs and their derivatives by the parameters of a fit, against differences.

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
    first = dataset.prediction(ADDRESSES)
    slower = [jb.replace(case, {"loads.0.speed": 1.9}) for case in dataset.cases]
    other = LogPrediction(
        slower, 1.01 * dataset.times, dataclasses.replace(dataset.plan, error=1e-3), None, ADDRESSES
    )
    ready, _ = first.linearised(VALUES)
    programs = readings_with_slopes.jitted._cache_size()
    changed, _ = other.linearised(VALUES)
    assert readings_with_slopes.jitted._cache_size() == programs and np.any(ready != changed)


def test_memory_of_derivatives_hardly_grows_with_the_log():
    """With the matrices of all steps at once 700 samples took 58 MB, with more modes gigabytes."""
    case = jb.Case(
        jb.Beam(0.6, 12.5, 0.812, 0.03, modes=4),
        actuators=[jb.SpringDamper(0.5, stiffness=3500.0, damping=5.0)],
        sensors=[jb.Sensor(0.15)],
        loads=[jb.MovingMass(0.4, 2.0)],
        run=jb.Run(0.4, 1000.0),
    )
    times = 1e-3 * np.arange(700)
    log = Log(times, np.zeros((700, 1)), ("d1",), ("deflection",), ("m",), sensors=(0,))
    spring = ["actuators.0.stiffness", "actuators.0.damping"]
    prediction = make_dataset(case, [log]).prediction(
        [*spring, "beam.flexural_rigidity", "loads.0.speed"]
    )
    own, plan, samples, values, *addresses = prediction._log(0, prediction.given)
    program = jax.jit(
        lambda *numbers: readings_with_slopes.__wrapped__(*numbers, *addresses)
    ).lower(own, plan, samples, values)
    assert program.compile().memory_analysis().temp_size_in_bytes < 6e6


@pytest.mark.parametrize("bounds", [2.0, (1, 2, 3), ("a", "b")])
def test_bounds_are_two_numbers(bounds):
    """Three were taken for a prior without a deviation."""
    with pytest.raises(ValueError, match=r"bounds are two numbers, \(low, high\), not "):
        as_prior(bounds)
