"""Internal-model control: against scipy's filters and closed forms."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case

LENGTH, RIGIDITY, MODES = 0.6, 13.2, 3
START, END, MOMENT = 0.25, 0.35, 8.3e-4 * 0.3 * 200
READINGS = 1e-3 * np.array([-0.4, -0.1, 0.0, 0.2])
VALUES = [[7.0, 3.0, 0.0, -2.0]]
LAW = jb.InternalModel(READINGS, VALUES, compensation=0.9, period=0.01, delay=0.02)
SMOOTH = jb.Filter(10.0, order=4)


def beam_case(controller=LAW, **sensor):
    patch = jb.Patch(START, END, 8.3e-4, correction=0.3, amplifier_gain=200.0, limits=[-2.5, 7.5])
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, 0.81, 0.03, modes=MODES),
        actuators=[patch],
        sensors=[jb.Sensor(0.3, filter=SMOOTH, **sensor)],
        loads=[jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.05)],
        controller=controller,
        run=jb.Run(duration=0.8, sample_rate=100.0),
    )


def lift():
    """Static deflection at 0.3 m (m/V): sum over sine modes of the moments at the patch ends."""
    k = np.arange(1, MODES + 1) * np.pi / LENGTH
    moments = k * (np.cos(k * START) - np.cos(k * END))
    return np.sum(MOMENT * moments * np.sin(k * 0.3) * 2 / (LENGTH * RIGIDITY * k**4))


def test_commands_by_the_table_for_readings_without_the_lift():
    """Computed from the record of a run, with scipy's filter of the lift."""
    record = jb.simulate(beam_case(noise=np.asarray(4e-6)))
    commands = np.asarray(record.command)[:, 0]
    sections = scipy.signal.butter(4, 10.0, fs=100.0, output="sos")
    previous = np.append(0.0, commands[:-1])  # until the sample
    filtered_lift = scipy.signal.sosfilt(sections, lift() * previous)
    load_deflection = record.measured[:, 0] - 0.9 * filtered_lift
    expected = np.interp(load_deflection, READINGS, VALUES[0])
    assert commands.max() > 6.0
    # The command of a sample begins two samples later; limits are not reached.
    assert_allclose(commands[2:], expected[:-2], atol=1e-6)


def test_frequency_responses_of_notches():
    controller = dataclasses.replace(LAW, notches=[16.0, 27.0], notch_damping=0.4)
    made = controller.law(jb.state_space(beam_case(controller))).notch_sections
    # 1 at rest, 0 at its frequency; between, that of the analogue notch at the warped frequency.
    for hertz, section in zip([16.0, 27.0], np.asarray(made), strict=True):
        angular_frequency, at = (
            2 * 100.0 * np.tan(np.pi * hertz / 100.0),
            np.array([0.0, 9.0, hertz]),
        )
        analogue = (
            [1.0, 0.0, angular_frequency**2],
            [1.0, 0.8 * angular_frequency, angular_frequency**2],
        )
        warped = 2 * 100.0 * np.tan(np.pi * at / 100.0)
        _, expected = scipy.signal.freqs(*analogue, worN=warped)
        _, found = scipy.signal.freqz(section[:3], section[3:], worN=at, fs=100.0)
        assert_allclose(found, expected, atol=1e-12)
    with pytest.raises(
        ValueError, match="notches must be below half the sampling frequency, 50 Hz"
    ):
        jb.simulate(beam_case(dataclasses.replace(LAW, notches=[16.0, 60.0])))


def test_stable_where_plain_feedback_of_the_same_slope_is_unstable():
    steep, times = 3e4, np.zeros(1)  # V/m; the load is not on the beam yet
    readings, values = [-2e-4, 2e-4], [[6.0, -6.0]]
    internal_model = jb.InternalModel(readings, values, period=0.01, delay=0.02)
    feedback = jb.Feedback([steep], period=0.01, delay=0.02)
    low_pass = jb.Filter(10.0, order=10)
    rates = [
        frozen_poles(
            dataclasses.replace(beam_case(law), sensors=(jb.Sensor(0.3, filter=low_pass),)), times
        ).largest_real_part[0]
        for law in (internal_model, feedback)
    ]
    assert rates[0] < -1.0 and rates[1] > 1.0


ERRORS = [
    ({"period": None, "delay": None}, {}, "period must be given: kind 'internal-model' acts"),
    ({"values": np.ones((1, 3))}, {}, "as many entries as readings has, 4"),
    ({}, {"quantity": "velocity"}, "needs a sensor of deflection for each of 1 actuators"),
]


@pytest.mark.parametrize(
    ("changes", "sensor", "message"), ERRORS, ids=["period", "values", "sensor"]
)
def test_errors_of_settings(changes, sensor, message):
    with pytest.raises(ValueError, match=message):
        jb.simulate(beam_case(dataclasses.replace(LAW, **changes), **sensor))


# Internal-model control that follows its plant: scipy's filters, other rigs, the bound.

PERIOD = 0.01
SCHEDULED = jb.ScheduledInternalModel(period=PERIOD, delay=0.02)


def rig(controller=SCHEDULED, cutoff: float | None = 5.0, rigidity=13.2, order=10, **sensor):
    """One span with a patch and a midspan sensor, and a load that crosses in 0.75 s."""
    digital = None if cutoff is None else jb.Filter(cutoff, order)
    patch = jb.Patch(
        0.2575, 0.3425, 8.3e-4, correction=0.32, amplifier_gain=200.0, limits=[-2.5, 7.5]
    )
    return jb.Case(
        jb.Beam(0.6, rigidity, 0.81, 0.03, modes=2),
        actuators=[patch],
        sensors=[jb.Sensor(0.3, filter=digital, **sensor)],
        loads=[jb.MovingMass(mass=0.42, speed=0.8, entry_time=0.054)],
        controller=controller,
        run=jb.Run(duration=0.9, sample_rate=100.0),
    )


def modal_lift():
    """Static midspan deflection (m/V): sum over two sine modes of the moments at the patch ends."""
    k = np.arange(1, 3) * np.pi / 0.6
    moments = k * (np.cos(k * 0.2575) - np.cos(k * 0.3425))
    moment = 8.3e-4 * 0.32 * 200
    return np.sum(moment * moments * np.sin(k * 0.3) * 2 / (0.6 * 13.2 * k**4))


def butterworth(order, cutoff) -> Any:
    """Zeros, poles and gain of a filter at the sampling period."""
    return scipy.signal.butter(order, cutoff, fs=1 / PERIOD, output="zpk")


@pytest.mark.parametrize(("cutoff", "order", "late"), [(5.0, 10, 0), (8.0, 3, 1), (None, 2, 0)])
def test_commands_by_the_table_behind_the_reference_filter(cutoff, order, late):
    """Computed from the record of a run, with scipy's filters and the lift in closed form."""
    delay = late * PERIOD if late else None
    record = jb.simulate(rig(cutoff=cutoff, order=order, noise=4e-6, offset=1e-4, delay=delay))
    commands, readings = np.asarray(record.command)[:, 0], np.asarray(record.measured)[:, 0]
    acting = np.concatenate([np.zeros(1 + late), commands])[: len(commands)]
    frequency = np.pi**2 / 0.6**2 * np.sqrt(13.2 / 0.81) / (2 * np.pi)
    zeros, poles, gain = butterworth(SCHEDULED.order, float(SCHEDULED.reference) * frequency)
    more = max(0, 2 * -(-order // 2) - SCHEDULED.order) if cutoff else 0
    if more:
        fast = butterworth(more, 0.4 / PERIOD)
        zeros, poles, gain = np.append(zeros, fast[0]), np.append(poles, fast[1]), gain * fast[2]
    reference = scipy.signal.zpk2sos(zeros, poles, gain)
    if cutoff:  # zeros at half the sampling frequency cancel
        _, filter_poles, filter_gain = butterworth(order, cutoff)
        zeros = np.append(filter_poles, zeros[order:])
        gain = gain / filter_gain
    equaliser = scipy.signal.zpk2sos(zeros, poles, gain)
    shares = scipy.signal.sosfilt(reference, modal_lift() * acting)
    shares = (shares - scipy.signal.sosfilt(equaliser, readings - 1e-4)) / (7.5 * modal_lift())
    values = np.interp(shares, SCHEDULED.shares, SCHEDULED.values)
    expected = np.where(values > 0, 7.5 * values, 2.5 * values)
    assert commands.max() > 7.0
    # The command of a sample begins two samples later.
    assert_allclose(commands[2:], expected[:-2], atol=1e-6)


def test_the_loop_is_the_same_behind_any_filter():
    """Commands behind filters of tenth order at 5 and 40 Hz differ by rounding alone."""
    found = [np.asarray(jb.simulate(rig(cutoff=cutoff)).command) for cutoff in (5.0, 40.0)]
    assert np.max(found[0]) > 7.0
    assert_allclose(found[0], found[1], atol=1e-6)


@pytest.mark.parametrize(("cutoff", "delay", "rigidity"), [(5.0, 0.04, 0.8), (40.0, 0.0, 1.2)])
def test_share_of_the_attainable_on_one_span(cutoff, delay, rigidity):
    """At least 85 % where the published cubic law attains a fifth, and below the bound."""
    law = dataclasses.replace(SCHEDULED, delay=delay)
    case = rig(law, cutoff, 13.2 * rigidity, noise=4e-6)
    assert 0.85 < jb.bound(case).share(jb.simulate(case)) < 1.0


def test_a_patch_that_presses_down_is_commanded_the_other_way():
    upright = rig()
    (patch,) = upright.actuators
    turned = dataclasses.replace(
        patch, correction=-patch.correction, limits=[-7.5, 2.5], depolarisation=[-1500.0, 500.0]
    )
    mirrored = dataclasses.replace(upright, actuators=(turned,))
    found = [np.asarray(jb.simulate(case).command) for case in (upright, mirrored)]
    assert_allclose(found[1], -found[0], atol=1e-9)


SCHEDULED_ERRORS = [
    ({"period": None, "delay": None}, {}, "period must be given"),
    ({"values": np.ones(3)}, {}, "values must have as many entries as shares, 11, not 3"),
    ({"order": 3}, {}, "order must be even"),
    ({}, {"quantity": "velocity"}, "kind needs a sensor of deflection for each of 1 actuators"),
    ({}, {"sampling_period": 0.02}, "kind samples all sensors itself"),
]


@pytest.mark.parametrize(("changes", "sensor", "message"), SCHEDULED_ERRORS)
def test_errors_of_scheduled_settings(changes, sensor, message):
    with pytest.raises(ValueError, match=message):
        check_case(rig(dataclasses.replace(SCHEDULED, **changes), cutoff=None, **sensor))


def test_errors_of_filters_and_limits():
    analogue = jb.Sensor(0.3, filter=jb.Filter(5.0, realisation="analogue"))
    with pytest.raises(ValueError, match=r"digital filters, .* sensors.0.filter is analogue"):
        check_case(dataclasses.replace(rig(), sensors=(analogue,)))
    with pytest.raises(ValueError, match=r"kind needs limits.* give actuators.0.limits"):
        check_case(dataclasses.replace(rig(), actuators=(jb.PointForce(0.3),)))


# Position-scheduled feedforward: commands against numpy and against prescribed ones.

SHARES = [0.0, 0.2, 0.7, 1.0]
FEEDFORWARD_VALUES = [[0.5, 6.0, 4.0, 1.0]]
FEEDFORWARD_LAW = jb.Feedforward(
    gates=[-0.2, -0.1], shares=SHARES, values=FEEDFORWARD_VALUES, period=0.01, lead=0.02
)


ONE = (jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.3),)


def feedforward_beam_case(controller=FEEDFORWARD_LAW, loads=ONE):
    return jb.Case(
        jb.Beam(0.6, 13.2, 0.81, 0.03, modes=1),
        actuators=[jb.Patch(0.25, 0.35, 8.3e-4, correction=0.3, amplifier_gain=200.0)],
        sensors=[jb.Sensor(0.3)],
        loads=list(loads),
        controller=controller,
        run=jb.Run(duration=1.2, sample_rate=100.0),
    )


def commands(case, times):
    plant = jb.state_space(case)
    measurement = Measurement(jnp.zeros(1), jnp.zeros(2), jnp.zeros(1))

    @eqx.filter_jit
    def commands_at_times(controller, plant):
        law = controller.law(plant)
        return jax.vmap(lambda t: law.step((), measurement, t).command)(times)[:, 0]

    return commands_at_times(case.controller, plant)


def test_table_is_read_ahead_of_the_load_after_the_second_gate():
    times = np.linspace(0.0, 1.2, 301)
    share = np.round((times + 0.02 - 0.3) * 1.0 / 0.6, 12)  # 0 and 1 are of the table
    expected = np.interp(share, SHARES, FEEDFORWARD_VALUES[0], left=0.0, right=0.0)
    assert_allclose(commands(feedforward_beam_case(), times), expected, atol=1e-12)
    late = dataclasses.replace(FEEDFORWARD_LAW, gates=np.array([0.1, 0.2]))
    assert_allclose(
        commands(feedforward_beam_case(late), times),
        np.where(times < 0.5, 0.0, expected),
        atol=1e-12,
    )


def test_run_equals_that_with_prescribed_commands():
    record = jb.simulate(feedforward_beam_case())
    table = np.asarray(commands(feedforward_beam_case(), record.times))
    prescribed = jb.Prescribed(offsets=[0.0], times=record.times, values=table[None], period=0.01)
    assert_allclose(record.command[:, 0], table, atol=1e-9)
    assert_allclose(
        record.deflection, jb.simulate(feedforward_beam_case(prescribed)).deflection, atol=1e-12
    )


def test_load_from_the_right_and_several_loads():
    times = np.linspace(0.003, 1.203, 61)  # not at the jumps of the table
    right = (jb.MovingMass(mass=0.4, speed=-1.0, entry_time=0.3),)
    mirrored = dataclasses.replace(FEEDFORWARD_LAW, gates=np.array([0.8, 0.7]))
    first = commands(feedforward_beam_case(), times)
    assert_allclose(commands(feedforward_beam_case(mirrored, right), times), first, atol=1e-12)
    both = (*ONE, jb.MovingMass(mass=0.2, speed=1.0, entry_time=0.5))
    later = commands(feedforward_beam_case(loads=both[1:]), times)
    assert_allclose(commands(feedforward_beam_case(loads=both), times), first + later, atol=1e-12)


CONFIRMED = dataclasses.replace(FEEDFORWARD_LAW, confirmation=np.asarray(2e-5))


def test_gates_that_fire_without_a_load_leave_the_beam_alone():
    """A load without weight passes the gates: the table alone lifts the beam by 0.2 mm."""
    nothing = (jb.MovingMass(mass=1e-9, speed=1.0, entry_time=0.3),)
    lifted = jb.simulate(feedforward_beam_case(loads=nothing))
    assert float(np.max(lifted.deflection)) > 2e-4
    at_rest = jb.simulate(feedforward_beam_case(CONFIRMED, nothing))
    assert not np.any(at_rest.command) and float(np.max(np.abs(at_rest.deflection))) < 1e-9


def test_a_load_that_a_sensor_shows_is_answered_by_the_table():
    """Commands are those of the table from the first sample at which the beam has gone down."""
    record = jb.simulate(feedforward_beam_case(CONFIRMED))
    table = np.asarray(commands(feedforward_beam_case(), record.times))
    shown = np.asarray(record.deflection)[:, 0] <= -2e-5
    first = int(np.argmax(shown))
    assert 0.3 < record.times[first] < 0.35
    expected = np.where(np.arange(table.size) < first, 0.0, table)
    assert_allclose(record.command[:, 0], expected, atol=1e-9)


def test_a_load_that_shows_too_late_is_not_confirmed():
    """The first passage is without a load; the second load shows after its time is out."""
    loads = (
        jb.MovingMass(mass=1e-9, speed=1.0, entry_time=0.2),
        jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.5),
    )
    run = jb.simulate(feedforward_beam_case(CONFIRMED, loads))
    alone = jb.simulate(feedforward_beam_case(CONFIRMED, loads[1:]))
    assert_allclose(run.command, alone.command, atol=1e-9)
    none = dataclasses.replace(feedforward_beam_case(CONFIRMED), sensors=())
    with pytest.raises(ValueError, match="confirmation needs a sensor of the deflection"):
        jb.simulate(none)


def test_errors_of_settings_of_feedforward():
    case = feedforward_beam_case()
    slow = (jb.MovingMass(mass=0.4, speed=0.1, deceleration=0.1),)
    for changes, loads, message in (
        ({"period": None}, case.loads, "period must be given"),
        ({"values": np.ones((1, 3))}, case.loads, "values must have for each of 1 actuators"),
        ({"gates": np.array([0.2, 0.1])}, case.loads, "gates must be two positions"),
        ({"gates": np.array([0.1, 0.4])}, slow, "gates must be two positions"),
        ({}, (), "kind needs loads"),
    ):
        with pytest.raises(ValueError, match=message):
            jb.simulate(
                feedforward_beam_case(dataclasses.replace(FEEDFORWARD_LAW, **changes), loads)
            )
