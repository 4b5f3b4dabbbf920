"""Schedules: events at their times, buffers long enough, and peaks after the last exit."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integrator import integrate
from jaxbeam.simulation.integrator.time_grid import (
    Transmission,
    controller_schedule,
    sample_schedule,
    stack_schedules,
)

MILLI = 1e-3


@given(
    period=st.integers(1, 40),
    delay=st.integers(0, 90),
    sensor_period=st.integers(1, 40),
    sensor_delay=st.integers(0, 90),
    spacing=st.integers(1, 50),
)
def test_commands_and_readings_come_when_they_are_due(
    period, delay, sensor_period, sensor_delay, spacing
):
    """Against a replay event by event with plain lists, in whole milliseconds."""
    end = 200 // spacing * spacing
    samples = MILLI * np.arange(0, end + 1, spacing)
    control_instants = MILLI * np.arange(0, end + 1, period)
    sensor_instants = MILLI * np.arange(0, end + 1, sensor_period)
    breakpoints = np.array([0.0777])
    sent = sensor_instants - MILLI * sensor_delay
    found = controller_schedule(
        samples,
        Transmission(control_instants, control_instants + MILLI * delay),
        [Transmission(sent, sensor_instants)],
        breakpoints,
    )
    times = np.asarray(found.times)
    assert np.all(np.diff(times) > 0) and times[0] == 0 and times[-1] == samples[-1]
    assert_allclose(times[np.asarray(found.sample_events)], samples, rtol=0, atol=0)
    assert (samples[-1] >= 0.0777) == np.any(np.abs(times - 0.0777) < 1e-12)
    lengths = np.asarray(found.lengths)[np.asarray(found.length_index)]
    assert_allclose(lengths, np.diff(times), rtol=0, atol=1e-10)

    commands, readings = [], [("rest", -1)] * (found.max_age + 1)
    for event, time in enumerate(times):
        now = time / MILLI
        number = int(found.reading[event, 0])
        if number >= 0:
            assert_allclose(number * sensor_period - sensor_delay, now, atol=1e-6)
            readings.insert(0, ("read", number))
        if found.control_sample[event] >= 0:
            assert_allclose(int(found.control_sample[event]) * period, now, atol=1e-6)
            commands.insert(0, int(found.control_sample[event]))
        newest = int(np.floor(now / sensor_period + 1e-6))
        expected = ("read", newest) if newest * sensor_period - sensor_delay >= 0 else ("rest", -1)
        assert found.reading_age[event, 0] <= found.max_age
        assert readings[int(found.reading_age[event, 0])] == expected
        command_age = int(found.command_age[event])
        if command_age >= 0:
            assert command_age <= found.max_waiting
            assert_allclose(commands[command_age] * period + delay, now, atol=1e-6)
    assert np.sum(np.asarray(found.control_sample) >= 0) == control_instants.size
    assert np.sum(np.asarray(found.command_age) >= 0) == np.sum(
        control_instants + MILLI * delay <= end * MILLI + 1e-9
    )


@pytest.mark.parametrize("seed", range(6))
def test_losses_and_random_delays(seed):
    """Against a replay event by event: what has arrived, and what acts; overtaken ones do not."""
    random = np.random.default_rng(seed)
    instants = 5 * MILLI * np.arange(41)
    late = (0.0, 3.0, 17.0)[seed % 3] * MILLI
    lost = random.uniform(size=(2, 41)) < (0.0, 0.4)[seed % 2]
    sent = instants - 2 * MILLI - late * random.uniform(size=41)
    begin = instants + late * random.uniform(size=41)
    commands, readings = (
        Transmission(instants, begin, lost[0]),
        Transmission(sent, instants, lost[1]),
    )
    found = controller_schedule(instants, commands, [readings], np.zeros(0), assumed_age=1)
    assert found.max_waiting >= int(found.assumed_age) == 1
    made, history, acts = [], [-1] * (found.max_age + 1), -1
    for event, time in enumerate(np.asarray(found.times)):
        near = np.abs(np.stack([sent, begin, instants]) - time) < 1e-9
        if np.any(near[0] & ~lost[1]):
            history.insert(0, int(found.reading[event, 0]))
            assert near[0][history[0]] and not lost[1][history[0]]
        else:
            assert found.reading[event, 0] == -1
        if np.any(near[2]):
            made.insert(0, int(np.argmax(near[2])))
        due = np.flatnonzero(instants <= time + 1e-9)
        received = due[~lost[1][due] & (sent[due] >= 0)]
        expected = received[-1] if received.size else -1
        # A reading of a signal before the run is that at rest.
        arrived = due[~lost[1][due]]
        expected = expected if arrived.size and sent[arrived[-1]] >= 0 else -1
        assert history[int(found.reading_age[event, 0])] == expected
        assert bool(found.missing[event, 0]) == lost[1][due[-1]]
        begun = np.flatnonzero((begin <= time + 1e-9) & ~lost[0])
        acts = max(begun, default=-1)
        age = int(found.command_age[event])
        if age >= 0:
            assert made[age] == acts
        elif np.any(near[1] & ~lost[0]):
            assert np.argmax(near[1]) < acts  # overtaken


def test_schedules_of_one_shape_are_stacked():
    schedules = [
        sample_schedule(jnp.linspace(0, end, 5), even) for end, even in ((1.0, True), (2.0, False))
    ]
    stacked = stack_schedules(schedules)
    assert stacked.times.shape == (2, 5) and stacked.lengths.shape == (2, 4)
    with pytest.raises(ValueError, match="differ in the number of events or samples"):
        stack_schedules([schedules[0], sample_schedule(jnp.linspace(0, 1, 4), True)])


# Frequencies have no common period: modes that hardly decay come together long after the exit.
BEAM = jb.Beam(25.0, 30e9, 15e3, damping_ratio=2e-5, modes=4)
CASE = jb.Case(
    BEAM,
    supports=[jb.Support(8.0, stiffness=3e8)],
    sensors=[jb.Sensor(17.0), jb.Sensor(11.0, "acceleration")],
    loads=[jb.MovingMass(mass=2e3, speed=300.0)],
    run=jb.Run(3.0, sample_rate=50.0),
)
RIGIDITIES = [30e9, 33e9]


def test_late_peaks_are_those_of_whole_runs():
    found = jb.sweep(CASE, {"beam.flexural_rigidity": RIGIDITIES}, progress=False)
    for i, rigidity in enumerate(RIGIDITIES):
        record = jb.simulate(jb.replace(CASE, {"beam.flexural_rigidity": rigidity}))
        largest = np.maximum(record.largest, -record.smallest)
        times = np.where(largest > record.largest, record.smallest_time, record.largest_time)
        peaks = found.peak_deflection.values[i, 0], found.peak_acceleration.values[i, 1]
        assert peaks == pytest.approx(largest, rel=1e-7)
        assert found.peak_time.values[i] == pytest.approx(times, abs=1e-6)
        assert (times > 5 * 25.0 / 300.0).any()


def test_steps_end_after_the_exit_where_nothing_can_come(monkeypatch):
    """A slow load has its peak on the beam; free vibration of 500 crossings is not integrated."""
    ends, chunk_of = [], integrate._chunk_function

    def recorded(*arguments, **options):
        chunk, steps = chunk_of(*arguments, **options)

        def one(*state):
            found = chunk(*state)
            ends.append(float(found[3]))
            return found

        return one, steps

    monkeypatch.setattr(integrate, "_chunk_function", recorded)
    slow = jb.MovingMass(mass=2e3, speed=25.0)
    case = dataclasses.replace(
        CASE,
        beam=dataclasses.replace(BEAM, damping_ratio=0.01),
        loads=[slow],
        run=jb.Run(500.0, sample_rate=1.0),
    )
    jb.sweep(case, {"beam.flexural_rigidity": RIGIDITIES}, progress=False)
    assert 1.0 <= max(ends) < 5.0
