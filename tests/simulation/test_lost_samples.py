"""Readings and commands that are lost or late at random, against the independent closed loop."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from tests.loop_as_oracle import expected

PERIOD = 5e-3
SPAN = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2)


def loop(sensors, run=None, **controller):
    """Two shakers, fed back from two sensors, under a mass."""
    settings = {"dropout": 0.25, "jitter": 2e-3, "period": PERIOD} | controller
    return jb.Case(
        SPAN,
        actuators=[jb.Shaker(0.2, 500.0, 5.0, limits=(-4.0, 4.0)), jb.PointForce(0.45)],
        sensors=sensors,
        loads=[jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02)],
        controller=jb.Feedback([400.0, 200.0], **settings),
        run=run or jb.Run(0.25, 400.0, seed=3),
    )


@pytest.mark.parametrize(
    ("sensors", "controller"),
    [
        ([jb.Sensor(0.2, dropout=0.3), jb.Sensor(0.4, jitter=3e-3)], {}),
        (
            [
                jb.Sensor(0.2, filter=jb.Filter(40.0, 3), dropout=0.4, offset=1e-4),
                jb.Sensor(0.4, delay=7e-3, jitter=12e-3, dropout=0.2),
            ],
            {"delay": 2e-3, "jitter": 11e-3},  # commands overtake each other
        ),
        (
            [
                jb.Sensor(0.2, filter=jb.Filter(30.0), sampling_period=3e-3, dropout=0.3),
                jb.Sensor(0.4, sampling_period=2 * PERIOD, jitter=1e-3, dropout=0.5),
            ],
            {"delay": PERIOD, "jitter": None},
        ),
    ],
)
def test_readings_and_commands_are_those_of_the_oracle(sensors, controller):
    """Of an event list with scipy's solver, losses and delays drawn by `jax.random`."""
    case = loop(sensors, **controller)
    record = jb.simulate(case)
    motion = expected(case, record.times)
    assert 1e-4 < np.max(np.abs(motion.deflection)) < 5e-3
    largest = np.max(np.abs(motion.arrived_readings), axis=0)
    assert_allclose(record.measured / largest, motion.arrived_readings / largest, rtol=0, atol=2e-7)
    scale = np.max(np.abs(motion.command))
    assert_allclose(record.command, motion.command, rtol=0, atol=2e-7 * scale)
    assert_allclose(record.deflection, motion.deflection, rtol=0, atol=1e-9)


def test_seed_and_sensors_have_losses_of_their_own():
    sensors = [jb.Sensor(0.2, dropout=0.5), jb.Sensor(0.2, dropout=0.5)]
    first, again, other = (
        jb.simulate(loop(sensors, jb.Run(0.06, 400.0, seed=seed))) for seed in (3, 3, 4)
    )
    assert_array_equal(first.measured, again.measured)
    assert np.any(first.measured[:, 0] != first.measured[:, 1])
    assert np.any(first.measured != other.measured)


def test_no_loss_and_no_jitter_change_nothing():
    plain = [jb.Sensor(0.2, filter=jb.Filter(40.0, 3)), jb.Sensor(0.4, delay=7e-3)]
    zero = [dataclasses.replace(sensor, dropout=0.0, jitter=0.0) for sensor in plain]
    run = jb.Run(0.06, 400.0)
    for delay in (None, PERIOD, 8e-3):
        ideal = jb.simulate(loop(plain, run, delay=delay, dropout=None, jitter=None))
        record = jb.simulate(loop(zero, run, delay=delay, dropout=0.0, jitter=0.0))
        assert_array_equal(record.peak_deflection, ideal.peak_deflection)
        assert_array_equal(record.measured, ideal.measured)


def uniform(seed, number, kind, count):
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), number + 1), kind)
    return np.asarray(jax.random.uniform(key, count))


def test_readings_without_a_controller():
    """Lost ones repeat the last one, late ones are those of earlier times."""
    rate, seed = 500.0, 7
    case = jb.Case(
        SPAN,
        sensors=[jb.Sensor(0.3), jb.Sensor(0.3, dropout=0.4), jb.Sensor(0.3, jitter=4e-3)],
        loads=[jb.MovingMass(mass=0.4, speed=2.4)],
        run=jb.Run(0.3, rate, seed=seed),
    )
    record = jb.simulate(case)
    ideal, lossy, late = record.measured.T
    lost = uniform(seed, 1, 1, ideal.size) < 0.4
    newest, held = 0.0, []
    for value, is_lost in zip(ideal, lost, strict=True):
        newest = newest if is_lost else value
        held.append(newest)
    assert_array_equal(lossy, held)
    delays = 4e-3 * uniform(seed, 2, 2, ideal.size)
    times = np.maximum(record.times - delays, 0.0)
    fine = jb.simulate(dataclasses.replace(case, run=jb.Run(0.3, 20_000.0)))
    # linear between times of 0.05 ms: an error of 2e-4 of the largest, at most
    exact = np.interp(times, fine.times, fine.measured[:, 0])
    assert_allclose(late, exact, rtol=0, atol=1e-3 * np.max(np.abs(ideal)))
    assert np.max(np.abs(late - ideal)) > 0.02 * np.max(np.abs(ideal))


def test_readings_in_vehicles():
    """Lost ones repeat the last one; random numbers follow those of the sensors on the beam."""
    case = jb.Case(
        SPAN,
        sensors=[jb.Sensor(0.3)],
        loads=[jb.QuarterCar(0.05, 0.02, 60.0, 0.6, 400.0, 0.1, speed=5.0)],
        vehicle_sensors=[
            jb.vehicles.VehicleSensor(),
            jb.vehicles.VehicleSensor(dropout=0.5),
        ],
        run=jb.Run(0.1, 500.0, seed=2),
    )
    ideal, lossy = jb.simulate(case).vehicle_readings.T
    lost = uniform(2, 2, 1, ideal.size) < 0.5
    newest = np.maximum.accumulate(np.where(lost, 0, np.arange(ideal.size)))
    assert_array_equal(lossy[~lost], ideal[~lost])
    assert_array_equal(lossy, lossy[newest])


@pytest.mark.parametrize("address", ["sensors.0.dropout", "sensors.0.jitter", "controller.jitter"])
def test_derivatives_by_what_is_random_are_refused(address):
    run = jb.Run(0.02, 400.0)
    case = loop([jb.Sensor(0.2, dropout=0.1, jitter=1e-3), jb.Sensor(0.4)], run)

    def peak(value):
        return jb.simulate(jb.replace(case, {address: value})).peak_deflection[0]

    with pytest.raises(ValueError, match="drawn by a seed and jumps with the"):
        jax.grad(peak)(1e-3)


ERRORS = [
    ({"sensors.0.dropout": 1.0}, "sensors.0.dropout must lie from 0 to below 1; it is 1"),
    ({"controller.dropout": -0.1}, "controller.dropout must lie from 0 to below 1; it is -0.1"),
    ({"sensors.0.jitter": -1e-3}, "sensors.0.jitter must not be negative; it is -0.001 s"),
]


@pytest.mark.parametrize(("values", "message"), ERRORS)
def test_impossible_numbers_are_refused(values, message):
    case = loop([jb.Sensor(0.2, dropout=0.1, jitter=1e-3), jb.Sensor(0.4)])
    with pytest.raises(ValueError, match=re.escape(message)):
        check_case(jb.replace(case, values))


@pytest.mark.parametrize("name", ["dropout", "jitter"])
def test_controllers_in_continuous_time_lose_nothing(name):
    continuous = jb.Feedback([400.0, 200.0])
    case = loop([jb.Sensor(0.2), jb.Sensor(0.4)])
    with_key = dataclasses.replace(continuous, **{name: 1e-3})
    message = f"controller.{name} needs a controller that samples: give controller.period"
    with pytest.raises(ValueError, match=message):
        check_case(dataclasses.replace(case, controller=with_key))
    sensors = dataclasses.replace(case.sensors[0], **{name: 1e-3}), case.sensors[1]
    with pytest.raises(ValueError, match=f"sensors.0.{name} needs a controller that samples"):
        check_case(dataclasses.replace(case, sensors=sensors, controller=continuous))


@pytest.mark.parametrize("address", ["sensors.0.dropout", "controller.jitter"])
def test_sweeps_of_loops_refuse_what_changes_the_schedule(address):
    case = loop([jb.Sensor(0.2, dropout=0.1), jb.Sensor(0.4)])
    with pytest.raises(ValueError, match=f"{address} determines the schedule"):
        jb.sweep(case, {address: [0.0, 1e-3]})


def test_sweeps_over_other_numbers_have_the_same_losses():
    run = jb.Run(0.06, 400.0)
    case = loop([jb.Sensor(0.2, dropout=0.3), jb.Sensor(0.4, jitter=2e-3)], run)
    masses = [0.3, 0.4]
    runs = jb.sweep(case, {"loads.0.mass": masses})
    for mass, peak in zip(masses, np.asarray(runs.peak_deflection), strict=True):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}))
        assert_allclose(peak, record.peak_deflection, rtol=1e-6)
