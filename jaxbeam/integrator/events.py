"""When things happen that are known before a run: samples, ticks of a controller, knots of a table.

The times are merged into one list of edges, so that steps end there; what is due at each edge is
noted beside it. Loads add edges of their own, whose times are numbers like any other (`grid`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

SAME_TIME_SHARE = 1e-9  # of the run: closer times are one
MAX_DISTINCT_GAPS = 64  # more different gaps than these are no longer told apart one by one


class EventSchedule(eqx.Module):
    """Edges in time, the gaps between them, and what is due at each.

    `length_index` says which of the `lengths` (s) each gap has; `sample_events` are the edges at which the run
    is sampled. For a run with a controller: `control_sample` numbers the edges at which it acts, `reading`
    those at which each sensor is read, -1 elsewhere. `reading_age` counts the readings of a sensor made
    since the one that has arrived by a tick, `command_age` the commands made since the one that begins
    to act at an edge, -1 where none does. `max_age` and `max_waiting` are their largest values.
    """

    times: Float[Array, " edge"]
    length_index: Int[Array, " gap"]
    lengths: Float[Array, " length"]
    sample_events: Int[Array, " time"]
    control_sample: Int[Array, " edge"] | None = None
    command_age: Int[Array, " edge"] | None = None
    reading: Int[Array, "edge sensor"] | None = None
    reading_age: Int[Array, "edge sensor"] | None = None
    max_age: int = eqx.field(static=True, default=0)
    max_waiting: int = eqx.field(static=True, default=0)
    max_readings: int = eqx.field(static=True, default=0)


def sample_schedule(
    times: Float[Array, " time"], equally_spaced: bool, lead_samples: int = 0
) -> EventSchedule:
    """The schedule of nothing but samples at ascending times (s); `equally_spaced` if equally spaced.

    The first `lead_samples` times are no samples. Also for times that are being traced.
    """
    count = times.shape[0]
    sample_events = jnp.arange(lead_samples, count)
    if equally_spaced:
        spacing = (times[-1] - times[0]) / (count - 1)
        return EventSchedule(times, jnp.zeros(count - 1, int), spacing[None], sample_events)
    return EventSchedule(times, jnp.arange(count - 1), jnp.diff(times), sample_events)


def controller_schedule(
    sample_times: Float[np.ndarray, " time"],
    control_times: Float[np.ndarray, " tick"],
    delay: float,
    arrival_times: list[Float[np.ndarray, "_"]],
    sensor_delays: list[float],
    breakpoints: Float[np.ndarray, " knot"],
) -> EventSchedule:
    """The schedule of a run with a controller, from rest at zero to the last sample.

    `control_times` (s) are when the controller acts, its commands begin `delay` (s) later; `arrival_times` (s)
    are when readings of each sensor arrive, of what it saw `sensor_delays` (s) before; `breakpoints` (s) are
    where a prescribed command bends.
    """
    end = float(sample_times[-1])
    signal_times = [clock - lag for clock, lag in zip(arrival_times, sensor_delays, strict=True)]
    all_times = np.sort(
        np.concatenate(
            [
                np.zeros(1),
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
    # Samples are where they were asked for, to the last bit; others give way to them.
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
        np.searchsorted(clock, times + SAME_TIME_SHARE * end, side="right") - 1
        for clock in arrival_times
    ]
    # What was seen before the run is what is seen at rest: the buffer holds nothing else then.
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
        return jnp.asarray(np.array(parts).reshape(len(parts), times.size).T, int)

    return EventSchedule(
        jnp.asarray(times),
        jnp.asarray(length_index),
        jnp.asarray(mean_lengths),
        jnp.asarray(event_indices(sample_times)),
        control_sample=jnp.asarray(control_sample),
        command_age=jnp.asarray(command_lag),
        reading=stack_columns(reading_index),
        reading_age=stack_columns(reading_lag),
        max_age=int(max((part.max() for part in reading_lag), default=0)),
        max_waiting=int(command_lag.max(initial=0)),
        max_readings=max((clock.size for clock in arrival_times), default=0),
    )


def stack_schedules(schedules: list[EventSchedule]) -> EventSchedule:
    """Schedules of equally many edges and samples, along a new first axis.

    Raises ValueError if their numbers differ.
    """
    if len({(s.times.shape, s.sample_events.shape) for s in schedules}) > 1:
        raise ValueError("the schedules differ in the number of their edges or samples")
    max_lengths = max(s.lengths.shape[0] for s in schedules)
    maxima = ("newest", "waiting", "most_reads")
    largest = {name: max(getattr(s, name) for s in schedules) for name in maxima}

    def pad(schedule):
        lengths = jnp.append(schedule.lengths, jnp.zeros(max_lengths - schedule.lengths.shape[0]))
        return dataclasses.replace(schedule, lengths=lengths, **largest)

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(pad, schedules))
