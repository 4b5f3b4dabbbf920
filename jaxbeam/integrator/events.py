"""Events known before a run: samples, control samples, breakpoints of commands.

Their times are merged into one schedule, so that steps end there, with the actions at each event.
Events of the loads are added by the time grid (`time_grid`); their times may be traced.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

SAME_TIME_SHARE = 1e-9  # of the duration: closer times are one event
MAX_DISTINCT_GAPS = 64  # with more different intervals, each has a length of its own


class EventSchedule(Module):
    """Times of events (s), lengths of the intervals between them, and the actions at each event.

    `length_index` is the index of each interval among the `lengths` (s); `sample_events` are the
    events at which the run is sampled. With a controller: `control_sample` is the number of the
    control sample at an event and `reading` that of the reading of each sensor, -1 for none.
    `reading_age` is the number of readings made since the one that is available at an event,
    `command_age` the number of commands made since the one that takes effect, -1 for none;
    `max_age` and `max_waiting` are their maxima. A sensor makes at most `max_readings`.
    """

    times: Float[Array, " event"]
    length_index: Int[Array, " interval"]
    lengths: Float[Array, " length"]
    sample_events: Int[Array, " time"]
    control_sample: Int[Array, " event"] | None = None
    command_age: Int[Array, " event"] | None = None
    reading: Int[Array, "event sensor"] | None = None
    reading_age: Int[Array, "event sensor"] | None = None
    max_age: int = eqx.field(static=True, default=0)
    max_waiting: int = eqx.field(static=True, default=0)
    max_readings: int = eqx.field(static=True, default=0)


def sample_schedule(
    times: Float[Array, " time"],
    equally_spaced: bool,
    lead_samples: int = 0,
    end: Float[Array, ""] | None = None,
) -> EventSchedule:
    """Schedule of a run without controller: samples at ascending times (s), which may be traced.

    The first `lead_samples` times are events without a sample, and so is the `end` (s) of the run,
    if it is not the last sample.
    """
    count = times.shape[0]
    sample_events = xp.arange(lead_samples, count)
    if equally_spaced:
        lengths = ((times[-1] - times[0]) / (count - 1))[None]
        length_index = xp.zeros(count - 1, int)
    else:
        lengths, length_index = xp.diff(times), xp.arange(count - 1)
    if end is not None:
        end = xp.maximum(end, times[-1])
        length_index = xp.append(length_index, lengths.shape[0])
        lengths = xp.append(lengths, end - times[-1])
        times = xp.append(times, end)
    return EventSchedule(times, length_index, lengths, sample_events)


def controller_schedule(
    sample_times: Float[np.ndarray, " time"],
    control_times: Float[np.ndarray, " control_sample"],
    delay: float,
    arrival_times: list[Float[np.ndarray, "_"]],
    sensor_delays: list[float],
    breakpoints: Float[np.ndarray, " breakpoint"],
    end: float | None = None,
) -> EventSchedule:
    """Schedule of a run with a controller, from rest at zero to the `end` (s).

    By default it ends with the last sample, before which it never does.

    The controller acts at `control_times` (s), and its commands take effect `delay` (s) later. The
    readings of each sensor are available at its `arrival_times` (s), taken from the signal
    `sensor_delays` (s) before. `breakpoints` (s) are those of prescribed commands.
    """
    end = float(sample_times[-1] if end is None else max(end, sample_times[-1]))
    signal_times = [
        arrivals - lag for arrivals, lag in zip(arrival_times, sensor_delays, strict=True)
    ]
    all_times = np.sort(
        np.concatenate(
            [
                np.array([0.0, end]),
                sample_times,
                control_times,
                control_times + delay,
                breakpoints,
                *signal_times,
            ]
        )
    )
    all_times = all_times[(all_times >= 0) & (all_times <= end * (1 + SAME_TIME_SHARE))]
    times = all_times[np.diff(all_times, prepend=-np.inf) > SAME_TIME_SHARE * end]
    # Events merged with a sample take its exact time.
    nearest_sample = np.clip(
        np.searchsorted(sample_times, times - SAME_TIME_SHARE * end), 0, sample_times.size - 1
    )
    times = np.where(
        np.abs(sample_times[nearest_sample] - times) <= SAME_TIME_SHARE * end,
        sample_times[nearest_sample],
        times,
    )

    def event_indices(wanted_times):
        return np.clip(
            np.searchsorted(times, wanted_times - SAME_TIME_SHARE * end), 0, times.size - 1
        )

    def number_at_events(wanted_times):
        numbers = np.full(times.size, -1)
        in_run = np.flatnonzero(
            (wanted_times >= -SAME_TIME_SHARE * end) & (wanted_times <= end * (1 + SAME_TIME_SHARE))
        )
        numbers[event_indices(wanted_times[in_run])] = in_run
        return numbers

    def latest_number(due):
        return np.maximum.accumulate(due)

    control_sample, command_start = (
        number_at_events(control_times),
        number_at_events(control_times + delay),
    )
    command_lag = np.where(command_start >= 0, latest_number(control_sample) - command_start, -1)
    reading_index = [number_at_events(times) for times in signal_times]
    latest_arrival = [
        np.searchsorted(arrivals, times + SAME_TIME_SHARE * end, side="right") - 1
        for arrivals in arrival_times
    ]
    # Readings of signals before the run are those at rest, which fill the buffer at the start.
    pairs = zip(reading_index, latest_arrival, strict=True)
    reading_lag = [np.maximum(latest_number(made) - here, 0) for made, here in pairs]
    gaps = np.diff(times)
    lengths, length_index = np.unique(
        np.round(gaps / (1e-2 * SAME_TIME_SHARE * end)), return_inverse=True
    )
    if lengths.size > MAX_DISTINCT_GAPS:
        length_index = np.arange(gaps.size)
    mean_lengths = np.bincount(length_index, gaps) / np.bincount(length_index)

    def stack_columns(parts):
        return xp.asarray(np.array(parts).reshape(len(parts), times.size).T, int)

    return EventSchedule(
        xp.asarray(times),
        xp.asarray(length_index),
        xp.asarray(mean_lengths),
        xp.asarray(event_indices(sample_times)),
        control_sample=xp.asarray(control_sample),
        command_age=xp.asarray(command_lag),
        reading=stack_columns(reading_index),
        reading_age=stack_columns(reading_lag),
        max_age=int(max((part.max() for part in reading_lag), default=0)),
        max_waiting=int(command_lag.max(initial=0)),
        max_readings=max((arrivals.size for arrivals in arrival_times), default=0),
    )


def stack_schedules(schedules: list[EventSchedule]) -> EventSchedule:
    """Schedules with the same numbers of events and samples, stacked along a new first axis.

    Raises ValueError if the numbers differ.
    """
    if len({(s.times.shape, s.sample_events.shape) for s in schedules}) > 1:
        raise ValueError("the schedules differ in the number of events or samples")
    max_lengths = max(s.lengths.shape[0] for s in schedules)
    maxima = ("max_age", "max_waiting", "max_readings")
    largest = {name: max(getattr(s, name) for s in schedules) for name in maxima}

    def pad(schedule):
        lengths = xp.append(schedule.lengths, xp.zeros(max_lengths - schedule.lengths.shape[0]))
        return dataclasses.replace(schedule, lengths=lengths, **largest)

    return jax.tree.map(lambda *leaves: xp.stack(leaves), *map(pad, schedules))
