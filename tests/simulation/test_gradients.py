"""Derivatives of peaks and readings by every number and every time, against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import value_at
from jaxbeam.runtime.arrays import xp
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.integrator.time_grid import Transmission, controller_schedule
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.differences import central

# A load loses contact on entry at the free end; the bilateral model is smooth there.
pytestmark = pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")

TIMES = np.linspace(0.0, 0.4, 44)  # s; loads enter, leave and speed up between two of them

ONE_SPAN = jb.Case(
    jb.Beam(
        length=0.6,
        ends="pinned-clamped",
        modes=3,
        damping_ratio=[0.03, 0.02, 0.01],
        width=0.04,
        height=0.005,
        youngs_modulus=2.8e10,
        density=2675.0,
    ),
    sensors=[jb.Sensor(0.25, offset=1e-4), jb.Sensor(0.4, "strain", 2e-6, 0.0025)],
    loads=[
        jb.MovingMass(mass=0.4, speed=2.5, entry_time=0.013, deceleration=1.5),
        jb.MovingForce(force=3.0, times=[0.05, 0.12, 0.2, 0.31], positions=[0.1, 0.2, 0.45, 0.7]),
    ],
    run=jb.Run(0.5),
)
TWO_SPANS = jb.Case(
    jb.Beam(1.2, 11.68, 0.535, ends="pinned-free", modes=3, rayleigh_damping=[0.8, 2e-4]),
    supports=[
        jb.Support(0.55, rotational_stiffness=3.0),
        jb.Support(1.0, stiffness=6e3, damping=5.0, rotational_stiffness=1.0),
    ],
    actuators=[
        jb.Shaker(0.3, stiffness=500.0, damping=8.0, force_per_volt=4.6, bandwidth=900.0),
        jb.Patch(0.7, 0.85, 8e-4, correction=0.3, added_mass=0.05, added_rigidity=2.0),
    ],
    sensors=[jb.Sensor(0.25, offset=1e-4), jb.Sensor(0.8, "velocity", offset=0.01)],
    loads=[
        jb.MovingMass(mass=0.4, speed=3.5, entry_time=0.013, deceleration=0.6),
        jb.MovingMass(mass=0.3, speed=-1.2, entry_time=0.05, deceleration=5.0),  # stops and stays
    ],
    run=jb.Run(0.5),
)


class Problem:
    """Peaks and a misfit as functions of all numbers of a case, relative to their values."""

    def __init__(self, case):
        found = jb.addresses(case)
        entries = [a for a in found if jnp.ndim(found[a]) == 0]
        values = np.array([found[a] for a in entries])
        self.case, self.addresses, self.sizes = case, entries, np.where(values == 0, 1, values)
        self.point = values / self.sizes
        self.plan = integration_plan(case, TIMES)
        record = jb.simulate(case, TIMES, self.plan)
        self.peaks = record.peak_deflection
        self.scale = np.std(record.measured, axis=0)
        self.data = record.measured + self.scale * np.cos(np.arange(TIMES.size))[:, None]

    def outputs(self, point):
        """Relative peaks, and the mean square of normalised residuals of the readings."""
        case = jb.replace(self.case, dict(zip(self.addresses, point * self.sizes, strict=True)))
        record = jb.simulate(case, TIMES, self.plan)
        misfit = xp.mean(((record.measured - self.data) / self.scale) ** 2)
        return xp.concatenate([record.peak_deflection / self.peaks, misfit[None]])


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
@pytest.mark.parametrize("case", [ONE_SPAN, TWO_SPANS], ids=["one span", "two spans"])
def test_gradients_agree_with_differences(case, mode):
    problem = Problem(case)
    # Runs of known numbers, which no program computes.
    differences = central(problem.outputs, problem.point, step=2e-4, order=4)
    found = jax.jit(mode(problem.outputs))(jnp.asarray(problem.point))
    for i, address in enumerate(problem.addresses):
        # The absolute tolerance is the rounding of the outputs.
        assert_allclose(found[:, i], differences[:, i], rtol=1e-6, atol=1e-9, err_msg=address)


def test_a_sensor_moves_under_steps_of_several_lengths():
    """Only the rows of the sensor are traced: steps before and after the exit are known."""
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=5, ends="clamped-clamped"),
        sensors=[jb.Sensor(0.2)],
        loads=[jb.MovingMass(mass=0.3, speed=2.0)],
        run=jb.Run(0.35, 400.0),
    )

    def peak(position):
        return jb.simulate(jb.replace(case, {"sensors.0.position": position})).peak_deflection[0]

    slope = jax.jvp(peak, (0.2,), (1.0,))[1]
    assert_allclose(slope, (peak(0.2 + 1e-5) - peak(0.2 - 1e-5)) / 2e-5, rtol=1e-5)


OUTPUTS = (
    *("reactions", "sensor_values", "deflection", "measured", "truncation_errors"),
    *("peak_command", "effort", "stroke", "absorber_force", "absorber_energy"),
)
WITHOUT_DERIVATIVE = "error_estimate", "step_errors"


def test_all_numbers_of_a_record_have_their_derivative_or_refuse_it():
    case = jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=3),
        sensors=[jb.Sensor(0.25), jb.Sensor(0.2, "moment"), jb.Sensor(0.4, "acceleration")],
        actuators=[jb.PointForce(0.45)],
        controller=jb.Feedback([300.0], period=0.002),
        absorbers=[jb.Absorber(0.3, mass=0.05, stiffness=100.0, damping=0.2)],
        loads=[jb.MovingMass(mass=0.8, speed=6.0)],  # loses contact
        run=jb.Run(0.2, 200.0),
    )

    def outputs(mass):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}))
        envelope = record.envelope("moment", np.array([0.2, 0.3]))
        names = [*(field.name for field in dataclasses.fields(record)), *OUTPUTS]
        found = {name: getattr(record, name) for name in names}
        found |= {f"envelope.{name}": getattr(envelope, name) for name in ("smallest", "largest")}
        floats = (k for k, v in found.items() if getattr(v, "size", 0) and v.dtype.kind == "f")
        return {k: found[k] for k in floats}

    _, tangents = jax.jvp(outputs, (0.8,), (1.0,))
    pairs = {step: (outputs(0.8 + step), outputs(0.8 - step)) for step in (1e-4, 1e-3)}
    assert len(tangents) > 30
    for name, tangent in tangents.items():
        if name in WITHOUT_DERIVATIVE:
            assert np.all(np.isnan(tangent))
            with pytest.raises(ValueError, match=f"{name} of a record has no derivative"):
                jax.grad(lambda mass, name=name: xp.sum(outputs(mass)[name]))(0.8)
        else:
            step = 1e-3 if name.endswith("_time") else 1e-4  # instants are located to 1e-10 s
            above, below = (np.asarray(one[name]) for one in pairs[step])
            slopes = (above - below) / (2 * step)
            scale = np.nanmax(np.abs(slopes), initial=0.0)
            tangent = np.where(np.isnan(slopes), np.nan, tangent)
            assert_allclose(tangent, slopes, rtol=0, atol=1e-5 * scale, err_msg=name)


EVENT = 0.1  # s, a sample
CORNER_TIMES = np.array([0.0, EVENT, 0.15])
STEP = 1e-6
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, ends="free-clamped", damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.05)],
    loads=[jb.MovingForce(force=3.0, speed=2.0, entry_time=EVENT)],
    run=jb.Run(0.2),
)


def derivative(function, at: float) -> float:
    return float(jax.jit(jax.jacfwd(function))(at))


def test_a_sample_at_an_entry_has_the_derivative_of_later_entries():
    """The force enters at the free end, where the velocity has a corner in its entry time."""
    plan = integration_plan(CASE, CORNER_TIMES)

    def velocity(entry):
        case = jb.replace(CASE, {"loads.0.entry_time": entry})
        return jb.simulate(case, CORNER_TIMES, plan).velocity[1, 0]

    at, later, earlier = (float(velocity(EVENT + side * STEP)) for side in (0.0, 1.0, -1.0))
    assert abs(at - earlier) / STEP > 1.0
    assert at == later == derivative(velocity, EVENT) == 0.0


def test_the_time_of_a_loss_has_the_derivative_of_the_crossing():
    case = jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=3),
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=3.0, speed=15.0)],
        run=jb.Run(0.1, 1000.0),
    )
    plan = integration_plan(case)

    def lost(mass):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass}), plan=plan)
        return record.contact_lost_time[0]

    with pytest.warns(ContactLossWarning):
        difference = (float(lost(3.01)) - float(lost(2.99))) / 0.02
    assert abs(difference) > 1e-4
    assert_allclose(derivative(lost, 3.0), difference, rtol=0.02)


EXIT = 0.6 / 3.0  # s
ENTRIES = EXIT, np.nextafter(EXIT, 1.0), np.nextafter(EXIT, 0.0), EXIT + 1e-14, EXIT - 1e-14
TIED = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(0.2)],
    loads=[jb.MovingMass(mass=0.4, speed=3.0), jb.MovingMass(mass=0.3, speed=-2.5)],
    run=jb.Run(0.5, sample_rate=137.3),
)


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_exit_and_an_entry_at_one_time(entry):
    """Differences cross the tie of both events, which the derivatives stand on."""
    addresses = "loads.0.speed", "loads.1.entry_time", "loads.1.mass", "beam.flexural_rigidity"
    at = np.array([3.0, entry, 0.3, 11.68])

    def outputs(shares):
        values = [value * (1 + share) for value, share in zip(at, shares, strict=True)]
        values = dict(zip(addresses, values, strict=True))
        record = jb.simulate(jb.replace(TIED, values), tolerance=1e-10)
        return 1e3 * xp.append(record.deflection[[20, 40, 60], 0], record.peak_deflection)

    found = np.stack([jax.grad(lambda s, i=i: outputs(s)[i])(np.zeros(4)) for i in range(4)])
    assert_allclose(found, central(outputs, np.zeros(4), 1e-4, 4), rtol=1e-5, atol=1e-6)


BATCH_TIMES = np.array([0.0, 0.17, 0.3])  # s; no wheel passes a sensor or an end then
SPEEDS = jnp.array([2.5, 4.0])  # m/s
BATCH = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.25), jb.Sensor(0.25, "moment"), jb.Sensor(0.25, "acceleration")],
    loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    run=jb.Run(0.3),
)
NUMBERS = {"loads.0.mass": 0.4, "beam.flexural_rigidity": 11.68, "sensors.*.position": 0.25}


def test_gradients_of_peaks_of_a_batch():
    """Peaks between samples of deflection, statically corrected moment and acceleration."""
    plan, sizes = integration_plan(BATCH, BATCH_TIMES), np.array(list(NUMBERS.values()))

    def peaks(shares, speed):
        numbers = dict(zip(NUMBERS, shares * sizes, strict=True)) | {"loads.0.speed": speed}
        record = jb.simulate(jb.replace(BATCH, numbers), BATCH_TIMES, plan)
        return xp.maximum(record.largest, -record.smallest)

    def single_runs(shares):
        return np.stack([peaks(shares, speed) for speed in np.asarray(SPEEDS)])

    ones, batch = np.ones(sizes.size), jax.vmap(peaks, in_axes=(None, 0))
    found = jax.jit(jax.jacfwd(batch))(jnp.asarray(ones), jnp.asarray(SPEEDS))
    expected, scale = central(single_runs, ones, step=1e-4), np.abs(single_runs(ones))[..., None]
    assert_allclose(found / scale, expected / scale, rtol=1e-5, atol=1e-7)


# Derivatives by periods, delays and times of samples, against differences in double precision.

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
MOVED_TIMES = ["controller.period", "controller.delay", "sensors.0.delay", "run.sample_rate"]
CASES = {
    "feedback": (LOOP, [*MOVED_TIMES, "run.duration", "loads.0.mass"]),
    "estimated state": (LQR, MOVED_TIMES),
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


@pytest.mark.parametrize("address", MOVED_TIMES[:3])
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


def test_derivatives_of_a_loop_that_bounces_between_its_limits_by_the_tangent():
    """Motion is piecewise linear in a force; differences over 1e-4 of it leave the narrow pieces.

    The motion is chaotic: its derivative grows to 2500 times that of a linear one in 0.4 s.
    """
    period, limit, force = 0.004, 3.0, 4.0
    law = jb.LQR(state_weight=[1e6] * 2 + [1.0] * 2, command_weight=[1e-5], period=period)
    case = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
        actuators=[jb.PointForce(0.25, limits=[-limit, limit])],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.VaryingForce(force=force, position=0.2)],
        controller=law,
        run=jb.Run(0.4, sample_rate=1 / period),
    )
    plant = jb.state_space(case)
    system, gain = plant.at(0.0), law.law(plant).law.gain
    held = scipy.signal.cont2discrete((system.A, system.B, system.C, 0 * system.D), period)
    A, B, C = held[:3]
    x, tangent, saturated, found = np.zeros(4), np.zeros(4), 0, []
    for _ in range(101):
        found.append((C[0] @ x, C[0] @ tangent))
        wanted = -gain @ x
        within = np.abs(wanted) < limit
        saturated += int(not within.all())
        command, slope = np.clip(wanted, -limit, limit), np.where(within, -gain @ tangent, 0.0)
        x = A @ x + B @ np.append(command, force)
        tangent = A @ tangent + B @ np.append(slope, 1.0)
    largest, steepest = np.abs(found).max(axis=0)
    assert saturated > 80 and force * steepest > 2000 * largest

    def deflection(value):
        changed = jb.replace(case, {"loads.0.force": value})
        return jb.simulate(changed, tolerance=1e-8).deflection[:, 0]

    motion, derivative = jax.jvp(deflection, (force,), (1.0,))
    for ours, expected in zip((motion, derivative), np.transpose(found), strict=True):
        assert_allclose(ours, expected, atol=1e-9 * np.abs(expected).max())
    for step, near in ((1e-3, False), (1e-4, False), (1e-6, True)):
        pair = deflection(force * (1 + step)), deflection(force * (1 - step))
        difference = (pair[0] - pair[1]) / (2 * force * step)
        off = np.abs(difference - derivative).max() / np.abs(derivative).max()
        assert (off < 1e-4) if near else (off > 0.5)
