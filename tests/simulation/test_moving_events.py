"""Derivatives by periods, delays and times of samples, against differences in double precision."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import value_at
from jaxbeam.integrator.time_grid import Transmission, controller_schedule
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import ContactLossWarning

pytestmark = pytest.mark.filterwarnings(
    f"ignore::{ContactLossWarning.__module__}.{ContactLossWarning.__name__}"
)

LOOP = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
    actuators=[jb.SpringDamper(0.4, stiffness=50.0), jb.PointForce(0.2, limits=(-3.0, 3.0))],
    sensors=[jb.Sensor(0.3, delay=0.0012, filter=jb.Filter(40.0, 3)), jb.Sensor(0.25, "velocity")],
    loads=[jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.0213)],
    controller=jb.Feedback([2e3], period=0.007, delay=0.003),
    run=jb.Run(0.3, sample_rate=300.0),
)
LQR = dataclasses.replace(
    LOOP,
    controller=jb.LQR(
        [1e3, 1e2, 1.0, 0.1], [1e-2], period=0.0052, delay=0.003, estimator=jb.Kalman(0.02, 1e-5)
    ),
)
SLOW_SENSOR = dataclasses.replace(
    LOOP, sensors=[jb.Sensor(0.3, sampling_period=0.0153), jb.Sensor(0.25)]
)
TABLE = dataclasses.replace(
    LOOP,
    controller=jb.Prescribed([0.5], times=[0.05, 0.1, 0.2], values=[[1.0, 3.0, -2.0]]),
)
TIMES = ["controller.period", "controller.delay", "sensors.0.delay", "run.sample_rate"]
CASES = {
    "feedback": (LOOP, [*TIMES, "run.duration", "loads.0.mass"]),
    "estimated state": (LQR, TIMES),
    "sensor with its own period": (SLOW_SENSOR, ["controller.delay", "sensors.0.sampling_period"]),
    "table": (TABLE, [f"controller.times.{i}" for i in range(3)] + ["run.sample_rate"]),
}


def outputs(case: jb.Case, addresses, values):
    """Peaks, deflections, readings and commands of a run: what a derivative may be taken of."""
    record = jb.simulate(
        jb.replace(case, dict(zip(addresses, values, strict=True))), tolerance=1e-9
    )
    parts = [
        1e3 * record.peak_deflection,
        1e3 * record.deflection[20],
        1e3 * record.measured[37],
        record.command[50],
    ]
    traced = any(isinstance(part, jax.Array) for part in parts)
    return (jnp if traced else np).concatenate(parts)


@pytest.mark.parametrize("name", CASES)
def test_derivatives_by_times_equal_differences(name):
    case, addresses = CASES[name]
    point = np.array([float(value_at(case, address)) for address in addresses])
    found = np.asarray(jax.jacfwd(lambda x: outputs(case, addresses, x))(point))
    for i, address in enumerate(addresses):
        # Designs solve Riccati equations, whose rounding shows in differences over shorter steps.
        step = (1e-5 if case is LQR else 1e-6) * point[i]
        change = step * np.eye(point.size)[i]
        after, before = (outputs(case, addresses, point + sign * change) for sign in (1, -1))
        expected = (after - before) / (2 * step)
        size = np.abs(after).max() / point[i]
        assert_allclose(found[:, i], expected, rtol=2e-5, atol=1e-6 * size, err_msg=address)
    assert np.any(np.abs(found[:, 0]) > 0)


def test_derivatives_in_reverse():
    """Of the specimen of the issue: the peak by the delay."""
    addresses, point = ["controller.delay"], np.array([0.003])

    def peak(values):
        return outputs(LOOP, addresses, values)[0]

    step = 3e-9
    expected = (peak(point + step) - peak(point - step)) / (2 * step)
    assert_allclose(jax.grad(peak)(point), [expected], rtol=2e-5)


def derivative_of_peak(case: jb.Case, address: str, plan=None):
    """Forward derivative of the peak by the number at an address."""

    def peak(value):
        return jb.simulate(jb.replace(case, {address: value}), plan=plan).peak_deflection[0]

    return jax.jvp(peak, (float(value_at(case, address)),), (1.0,))


@pytest.mark.parametrize("address", TIMES[:3])
def test_a_plan_for_fixed_times_refuses_their_derivatives(address):
    plan = integration_plan(LOOP)
    with pytest.raises(ValueError, match="are fixed by a plan made without tracing them"):
        derivative_of_peak(LOOP, address, plan)


@pytest.mark.parametrize(
    ("address", "change"),
    [("controller.period", -1e-4), ("controller.delay", -0.01), ("sensors.0.delay", 0.01)],
)
def test_a_moving_plan_holds_for_other_times_in_the_same_order(address, change):
    plan, point = integration_plan(LOOP, moving=True), float(value_at(LOOP, address))
    case = jb.replace(LOOP, {address: point * (1 + change)})
    record, expected = (jb.simulate(case, plan=each) for each in (plan, None))
    size = expected.peak_deflection[0]
    assert_allclose(record.deflection, expected.deflection, rtol=0, atol=1e-7 * size)
    assert np.isnan(record.error_estimate)
    with pytest.raises(ValueError, match="in another order or number"):
        jb.simulate(jb.replace(LOOP, {address: 2.1 * point}), plan=plan)


@pytest.mark.parametrize("address", ["controller.resolution", "sensors.0.resolution"])
def test_rounding_refuses_derivatives_by_the_resolution(address):
    rounded = dataclasses.replace(
        LOOP,
        sensors=[jb.Sensor(0.3, resolution=1e-6)],
        controller=jb.Feedback([2e3], period=0.007, resolution=0.01),
    )
    with pytest.raises(ValueError, match="so that it has no derivative"):
        derivative_of_peak(rounded, address)


def test_actions_at_one_time_are_separate_events_in_their_order():
    """A reading, control, a command without delay, and a sample at 0, 0.1, 0.2 s."""
    times = np.arange(3) * 0.1
    at_once = Transmission(times, times)
    merged = controller_schedule(times, at_once, [at_once], np.zeros(0))
    schedule = controller_schedule(times, at_once, [at_once], np.zeros(0), moving=True)
    assert merged.times.size == 3 and merged.source is None
    np.testing.assert_allclose(schedule.times, [0.0, *np.repeat(times, 4), 0.2])
    nothing = [-1, -1, -1, -1]
    assert schedule.reading[:, 0].tolist() == [-1, 0, -1, -1, -1, 1, -1, -1, -1, 2, *nothing]
    assert schedule.control_sample.tolist() == [-1, -1, 0, -1, -1, -1, 1, -1, -1, -1, 2, -1, -1, -1]
    assert np.flatnonzero(schedule.command_age == 0).tolist() == [3, 7, 11]
    assert schedule.sample_events.tolist() == [4, 8, 12]
    later = schedule.moved(np.concatenate([times, 1.01 * times, 1.01 * times + 1e-3, times, [0.2]]))
    assert later.times[6] == pytest.approx(0.101) and later.times[7] == pytest.approx(0.102)
    np.testing.assert_allclose(later.lengths, np.diff(later.times))


def test_rounding_keeps_the_order_of_actions_at_one_time():
    """A command after one period and the next control: products and sums that are equal."""
    period, count = 0.0052, 40
    numbers = np.arange(count)
    sent = Transmission(numbers * period, (numbers + 1) * period)
    schedule = controller_schedule(np.array([0.2]), sent, [], np.zeros(0), moving=True)

    def times(period, share=0.0):
        """Times of commands are too early by a share of themselves."""
        late = (numbers * period + period) * (1 - share)
        return schedule.moved(jnp.concatenate([numbers * period, late, jnp.full(2, 0.2)])).times

    for share in (0.0, 1e-15):
        moved, derivative = jax.jvp(jax.jit(lambda p, s=share: times(p, s)), (period,), (1.0,))
        assert np.diff(moved).min() >= 0
        assert_allclose(derivative[1:-2], moved[1:-2] / period, rtol=1e-12, atol=1e-12)


GROWING = jb.Case(
    LOOP.beam,
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.4, speed=2.4)],
    run=jb.Run(0.1, sample_rate=200.0),
)
GROWING_LOOP = dataclasses.replace(
    GROWING, actuators=(jb.PointForce(0.3),), controller=jb.Feedback([2e2], period=0.005)
)


@pytest.mark.parametrize(
    ("case", "address"),
    [
        (GROWING, "run.duration"),
        (GROWING, "run.sample_rate"),
        (GROWING_LOOP, "run.duration"),
        (GROWING_LOOP, "controller.period"),
    ],
)
def test_a_peak_at_the_end_moves_with_the_end_alone(case, address):
    """A sample and an action of the controller are at the end, too, 0.1 s."""
    value, slope = derivative_of_peak(case, address)
    point = float(value_at(case, address))

    def peak(share):
        changed = jb.replace(case, {address: point * (1 + share)})
        return jb.simulate(changed, tolerance=1e-9).peak_deflection[0]

    expected = (peak(1e-6) - peak(-1e-6)) / (2e-6 * point)
    assert_allclose(slope, expected, rtol=1e-4, atol=1e-6 * float(value) / point)
