"""Time grid: panels of equal steps between events and samples.

Events scheduled before a run (samples, control samples, breakpoints of commands) are merged into
one schedule, so that steps end there, with the actions at each event. A load event is a time at
which the motion is not smooth: a load enters, leaves, stops, or passes a support or the end of a
patch; its time may be traced. No step contains one inside. The structure of the case fixes the
number of panels, so the grid can be compiled; a panel of zero length has no effect.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.model.contact import KinkPassages, kink_passages
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    any_jax,
    custom_jvp,
    is_jax,
    put,
    searchsorted,
    set_at,
    stop_gradient,
    take,
    xp,
)

SAME_TIME_FRACTION = 1e-9  # of the duration: closer times are one event
MAX_DISTINCT_GAPS = 64  # with more different intervals, each has a length of its own


class EventSchedule(Module):
    """Times of events (s), lengths of the intervals between them, and the actions at each event.

    `length_index` is the index of each interval among the `lengths` (s); `sample_events` are the
    events at which the run is sampled. With a controller: `control_sample` is the number of the
    control sample at an event and `reading` that of the reading of each sensor, -1 for none.
    `reading_age` is the number of readings made since the one that is available at an event,
    `command_age` the number of commands made since the one that takes effect, -1 for none;
    `max_age` and `max_waiting` are their maxima. A sensor makes at most `max_readings`. Lost
    readings and commands are left out; `missing` is true where the latest due reading was lost, and
    `assumed_age` is the command age that a law assumes if it does not model losses and random
    delays. Both are None without losses and random delays.

    In a schedule that moves with the numbers of the case, each action has its own event, and
    `source` is the index of the event's time in the argument of `moved`, -1 for a fixed time.
    `merging` (s) is added to the time, less than SAME_TIME_FRACTION of the duration, so that times
    equal but for rounding are equal; `source_counts` are the numbers of times of each kind of
    action.
    """

    times: Float[Array, " event"]
    length_index: Int[Array, " interval"]
    lengths: Float[Array, " length"]
    sample_events: Int[Array, " time"]
    control_sample: Int[Array, " event"] | None = None
    command_age: Int[Array, " event"] | None = None
    reading: Int[Array, "event sensor"] | None = None
    reading_age: Int[Array, "event sensor"] | None = None
    missing: Bool[Array, "event sensor"] | None = None
    assumed_age: Int[Array, ""] | None = None
    source: Int[Array, " event"] | None = None
    merging: Float[Array, " event"] | None = None
    max_age: int = eqx.field(static=True, default=0)
    max_waiting: int = eqx.field(static=True, default=0)
    max_readings: int = eqx.field(static=True, default=0)
    source_counts: tuple[int, ...] = eqx.field(static=True, default=())

    def moved(self, times: Float[Array, " time"]) -> "EventSchedule":
        """Schedule with new times (s) of its actions, in the order of `source`."""
        own = take(times, xp.maximum(self.source, 0)) + self.merging
        times = in_order(xp.where(self.source < 0, self.times, own))
        return dataclasses.replace(self, times=times, lengths=xp.diff(times))


@custom_jvp
def in_order(times: Float[Array, " event"]) -> Float[Array, " event"]:
    """Times (s) of events made non-decreasing, as rounding may swap equal times.

    A compiler with fused multiply-add rounds `k * period` differently in each expression.
    Derivatives are those of the given times.
    """
    ordered: Any = jax.lax.cummax(times) if is_jax(times) else np.maximum.accumulate(times)
    return ordered


@in_order.defjvp
def _(primals, tangents):
    return in_order(*primals), *tangents


def moving_with_end(times: Float[Array, " time"], end: Float[Array, ""]) -> Float[Array, " time"]:
    """Times (s), with those within rounding of the `end` (s) of a run replaced by the end.

    Actions at the end of a run do not change its motion. Derivatives of a peak at the end are those
    at a fixed time, or with respect to the end, not to the times of the actions there.
    """
    at_end = stop_gradient(times) >= stop_gradient(end) * (1 - SAME_TIME_FRACTION)
    return xp.where(at_end, end, times)


def sample_schedule(
    times: Float[Array, " time"],
    equally_spaced: bool,
    lead_samples: int = 0,
    end: Float[Array, ""] | None = None,
) -> EventSchedule:
    """Schedule of a run without controller: samples at ascending times (s), which may be traced.

    The first `lead_samples` times, from 0 in equal steps, are events without a sample, and so is
    the `end` (s) of the run, if it is not the last sample.
    """
    count = times.shape[0]
    sample_events = xp.arange(lead_samples, count)
    if equally_spaced:
        first = times[lead_samples]
        both = (times[-1] - first) / (count - 1 - lead_samples), first / max(lead_samples, 1)
        lengths = xp.stack(both[: 2 if lead_samples else 1])
        length_index = xp.asarray(np.arange(count - 1) < lead_samples, int)
    else:
        lengths, length_index = xp.diff(times), xp.arange(count - 1)
    if end is not None:
        if any_jax(times, end):
            times = moving_with_end(times, end)
            length_index = set_at(length_index, -1, lengths.shape[0])
            lengths = xp.append(lengths, times[-1] - times[-2])
        else:
            end = xp.maximum(end, times[-1])
        length_index = xp.append(length_index, lengths.shape[0])
        lengths = xp.append(lengths, end - times[-1])
        times = xp.append(times, end)
    return EventSchedule(times, length_index, lengths, sample_events)


class Transmission(NamedTuple):
    """Times (s) at which readings of a sensor, or commands, are sent and arrive.

    `lost` is true for those that do not arrive; None if all arrive.
    """

    sent: Float[np.ndarray, " number"]
    arrival: Float[np.ndarray, " number"]
    lost: Bool[np.ndarray, " number"] | None = None

    @property
    def is_lost(self) -> Bool[np.ndarray, " number"]:
        """Whether each reading or command is lost."""
        return np.zeros(self.sent.size, bool) if self.lost is None else self.lost

    @property
    def received(self) -> Int[np.ndarray, " received"]:
        """Indices of the readings or commands that arrive."""
        return np.flatnonzero(~self.is_lost)


def controller_schedule(
    sample_times: Float[np.ndarray, " time"],
    commands: Transmission,
    readings: list[Transmission],
    breakpoints: Float[np.ndarray, " breakpoint"],
    end: float | None = None,
    assumed_age: int | None = None,
    moving: bool = False,
) -> EventSchedule:
    """Schedule of a run with a controller, from zero to the `end` (s), or to the last sample.

    The schedule never ends before the last sample. The controller acts when its `commands` are
    sent. A command takes effect when it arrives, unless a newer one has arrived. The `readings` of
    each sensor are those of the signal when they are sent; they are available as they arrive, in
    the order of sending. `breakpoints` (s) are those of prescribed commands.

    A `moving` schedule has a separate event for each action; events at one time are in the order
    breakpoints, readings of each sensor, control, commands, samples, end. `EventSchedule.moved`
    takes the times in this order.
    """
    end = float(sample_times[-1] if end is None else max(end, sample_times[-1]))
    control_times, begun = commands.sent, commands.received
    earliest_later = np.minimum.accumulate(np.append(commands.arrival[begun], np.inf)[::-1])[::-1]
    begun = begun[commands.arrival[begun] < earliest_later[1:]]
    all_times = np.sort(
        np.concatenate(
            [
                np.array([0.0, end]),
                sample_times,
                control_times,
                commands.arrival[begun],
                commands.arrival[commands.is_lost],
                breakpoints,
                *[each.sent[each.received] for each in readings],
            ]
        )
    )
    all_times = all_times[(all_times >= 0) & (all_times <= end * (1 + SAME_TIME_FRACTION))]
    times = all_times[np.diff(all_times, prepend=-np.inf) > SAME_TIME_FRACTION * end]
    # Events merged with a sample take its exact time.
    nearest_sample = np.clip(
        np.searchsorted(sample_times, times - SAME_TIME_FRACTION * end), 0, sample_times.size - 1
    )
    times = np.where(
        np.abs(sample_times[nearest_sample] - times) <= SAME_TIME_FRACTION * end,
        sample_times[nearest_sample],
        times,
    )

    def in_run(kind, numbers):
        wanted = kinds[kind][numbers]
        tolerance = SAME_TIME_FRACTION * end
        return numbers[(wanted >= -tolerance) & (wanted <= end + tolerance)]

    merged_times, sensors = times, len(readings)
    kinds = [breakpoints, *(each.sent for each in readings), control_times, commands.arrival]
    kinds += [sample_times, np.array([end])]
    control, command, sample = 1 + sensors, 2 + sensors, 3 + sensors
    used = [np.arange(times.size) for times in kinds]
    used[1:control] = [each.received for each in readings]
    used[command] = np.sort(np.append(begun, np.flatnonzero(commands.is_lost)))
    source = merging = None

    def instants(wanted_times):
        found = np.searchsorted(merged_times, wanted_times - SAME_TIME_FRACTION * end)
        return np.clip(found, 0, merged_times.size - 1)

    if moving:
        # A row of instant and kind for each event; the first event is the start of the run.
        rows = [
            np.stack([at := instants(kinds[i][in_run(i, used[i])]), np.full(at.size, i)], axis=1)
            for i in range(len(kinds))
        ]
        rows = np.unique(np.concatenate([[[0, -1]], *rows]), axis=0)
        times = times[rows[:, 0]]
        source, merging = np.full(len(rows), -1), np.zeros(len(rows))

    def event_indices(kind, numbers):
        found = instants(kinds[kind][numbers])
        if not moving:
            return found
        own = np.flatnonzero(rows[:, 1] == kind)
        return own[np.searchsorted(rows[own, 0], found)]

    def number_at_events(kind, numbers):
        at_events, numbers = np.full(times.size, -1), in_run(kind, numbers)
        at_events[event_indices(kind, numbers)] = numbers
        return at_events

    if moving:
        firsts = np.cumsum([0, *(each.size for each in kinds)])
        for i, numbers in enumerate(used):
            at_events = number_at_events(i, numbers)
            has = np.flatnonzero(at_events >= 0)
            source[has] = firsts[i] + at_events[has]
            merging[has] = times[has] - kinds[i][at_events[has]]

    def newest_at_events(arrivals, numbers):
        arrived = np.searchsorted(arrivals[numbers], times + SAME_TIME_FRACTION * end, side="right")
        return np.append(numbers, -1)[arrived - 1]

    control_sample = number_at_events(control, used[control])
    command_start = number_at_events(command, begun)
    # In place of a lost command the last one begins again.
    is_lost = number_at_events(command, np.flatnonzero(commands.is_lost)) >= 0
    again = newest_at_events(commands.arrival, begun)
    command_start = np.where(is_lost & (command_start < 0), again, command_start)
    newest_sample = np.maximum.accumulate(control_sample)
    command_lag = np.where(command_start >= 0, newest_sample - command_start, -1)
    reading_index, reading_lag = [], []
    for i, each in enumerate(readings, 1):
        number = number_at_events(i, each.received)
        # Readings of signals before the run are those at rest, which fill the buffer at the start.
        made, order = np.cumsum(number >= 0), np.full(each.sent.size + 1, -1)
        made_in_run = in_run(i, each.received)
        order[made_in_run] = made[event_indices(i, made_in_run)] - 1
        newest = newest_at_events(each.arrival, each.received)
        reading_index.append(number)
        reading_lag.append(np.maximum(made - 1 - order[newest], 0))
    missing = None
    if any(each.lost is not None for each in readings):
        missing = [
            np.append(each.is_lost, False)[
                newest_at_events(each.arrival, np.arange(each.sent.size))
            ]
            for each in readings
        ]
    gaps = np.diff(times)
    lengths, length_index = np.unique(
        np.round(gaps / (1e-2 * SAME_TIME_FRACTION * end)), return_inverse=True
    )
    if moving or lengths.size > MAX_DISTINCT_GAPS:
        length_index = np.arange(gaps.size)
    mean_lengths = np.bincount(length_index, gaps) / np.bincount(length_index)

    def stack_columns(parts, kind=int):
        return xp.asarray(np.array(parts).reshape(len(parts), times.size).T, kind)

    return EventSchedule(
        xp.asarray(times),
        xp.asarray(length_index),
        xp.asarray(mean_lengths),
        xp.asarray(event_indices(sample, used[sample])),
        control_sample=xp.asarray(control_sample),
        command_age=xp.asarray(command_lag),
        reading=stack_columns(reading_index),
        reading_age=stack_columns(reading_lag),
        missing=None if missing is None else stack_columns(missing, bool),
        assumed_age=None if assumed_age is None else xp.asarray(assumed_age),
        source=None if source is None else xp.asarray(source),
        merging=None if merging is None else xp.asarray(merging),
        max_age=int(max((part.max() for part in reading_lag), default=0)),
        max_waiting=int(command_lag.max(initial=assumed_age or 0)),
        max_readings=max((each.sent.size for each in readings), default=0),
        source_counts=tuple(each.size for each in kinds) if moving else (),
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


# Entry and exit of each wheel (s), and times of all load events (s).
LoadEvents = tuple[Float[Array, "wheel 2"], Float[Array, " event"]]


class TimeGrid(Module):
    """Panels between `boundaries` (s), each with a number of equal steps.

    `counts` are the numbers of steps of the panels, `cumulative_counts` their sums up to the end of
    each panel. `length_index` is the index of a panel's step length among `lengths` (s); the last
    length is zero, for the steps after the end that fill the last chunk. `event` is the index of
    the scheduled event at which a panel starts, -1 for a load event; `event_panels` is the panel
    that starts at each scheduled event. `on_beam_intervals` are entry and exit of each load (s).
    `passage` is the index in `kinks` of the passage that is the first step of a panel of zero
    length; -1 for other panels.
    """

    boundaries: Float[Array, " boundary"]
    counts: Int[Array, " panel"]
    cumulative_counts: Int[Array, " panel"]
    length_index: Int[Array, " panel"]
    lengths: Float[Array, " length"]
    loads_on_beam: Bool[Array, "panel load"]
    on_beam_intervals: Float[Array, "load 2"]
    event: Int[Array, " panel"] | None = None
    event_panels: Int[Array, " event"] | None = None
    kinks: KinkPassages | None = None
    passage: Int[Array, " panel"] | None = None

    @property
    def last_exit(self) -> Float[Array, ""]:
        """Time (s) after which no load is on the beam."""
        return xp.max(self.on_beam_intervals[:, 1], initial=0.0)

    @property
    def step_count(self) -> Int[Array, ""]:
        """Number of steps."""
        return self.cumulative_counts[-1]

    @property
    def loaded_steps(self) -> Int[Array, ""]:
        """Number of steps until no load is on the beam any more."""
        loaded = xp.any(self.loads_on_beam, axis=1)
        return xp.max(xp.where(loaded, self.cumulative_counts, 0))

    def locate_steps(self, index: Int[Array, " step"]):
        """Panel, start time (s) and index of the length of the steps with these indices."""
        after_end = index >= self.step_count
        if self.event is None:
            panel = searchsorted(self.cumulative_counts, index)
        else:  # all panels of a schedule have the same number of steps
            panel = index // self.counts[0]
        panel = xp.minimum(panel, self.counts.shape[0] - 1)
        length_index = xp.where(
            after_end, self.lengths.shape[0] - 1, take(self.length_index, panel)
        )
        start = take(self.boundaries, panel) + (index - self._first_step(panel)) * take(
            self.lengths, take(self.length_index, panel)
        )
        return panel, xp.where(after_end, self.boundaries[-1], start), length_index

    def event_at(self, index: Int[Array, " step"]) -> Int[Array, " step"]:
        """Index of the scheduled event at which each of some steps starts, -1 for none."""
        panel, _, _ = self.locate_steps(index)
        return xp.where(self.starts_panel(index, panel), take(self.event, panel), -1)

    def starts_panel(self, index: Int[Array, " step"], panel: Int[Array, " step"]):
        """Whether each of some steps is the first one of its panel."""
        return (index == self._first_step(panel)) & (index < self.step_count)

    def with_halves(self, index: Int[np.ndarray, " step"]) -> "TimeGrid":
        """Grid of halved steps, with lengths only for the halves of the steps in `index`."""
        _, _, kinds = self.locate_steps(index)
        own = np.unique(kinds)
        return dataclasses.replace(
            self,
            counts=2 * self.counts,
            cumulative_counts=2 * self.cumulative_counts,
            length_index=np.minimum(np.searchsorted(own, self.length_index), own.size - 1),
            lengths=np.append(0.5 * self.lengths[own], 0.0),
        )

    def _first_step(self, panel):
        """Index of the first step of a panel."""
        return take(self.cumulative_counts, panel) - take(self.counts, panel)


def event_places(
    model: ModalModel, places: Float[Array, " place"] | None
) -> Float[Array, " event_place"]:
    """Places (m) at which a passing wheel is a load event: breaks of the model, and `places`."""
    own = model.load_breaks
    return own if places is None else xp.concatenate([own, model.load_places(places)])


def _events_between(case: Case, model: ModalModel, places, start, end, given=None, loads=None):
    """Load events, computed unless `given`, clipped to start and end, and passages over kinks.

    Returns entry and exit of each wheel (s), times of load events (s), times of the passages (s),
    each repeated as a panel of zero length lies in between, the passages, and the index of each;
    the index is -1 and the time the end for a passage that does not happen.
    """
    if given is None:
        loads = load_set(case, model.modes.layout) if loads is None else loads
        given = loads.events(event_places(model, places))
    windows, events = given
    events, kinks = xp.clip(events, start, end), kink_passages(case, model, loads)
    if kinks is None:
        return windows, events, xp.zeros(0), None, np.zeros(0, int)
    happen = kinks.happen(windows, start, end)
    times = xp.where(happen, kinks.times, end)
    index = xp.where(happen, np.arange(times.shape[0]), -1)
    return windows, events, xp.repeat(times, 2), kinks, index


def _loads_on_beam(positions, panels: int):
    """Whether each wheel is on the beam in each panel, (panel, wheel).

    `positions` are the indices of entry and exit of each wheel among the boundaries. Indices rather
    than times give a panel of zero length, between a sample and an exit at the same time, the
    right derivative.
    """
    entry, leave = positions.reshape(-1, 2).T
    index = np.arange(panels)[:, None]
    return (entry <= index) & (index < leave)


def grid_by_step_length(
    case: Case,
    model: ModalModel,
    max_step: Float[Array, ""],
    extra_steps: int | Int[Array, ""] = 0,
    places: Float[Array, " place"] | None = None,
    refinement: int = 1,
    given_events: LoadEvents | None = None,
) -> TimeGrid:
    """Panels between load events, with steps of at most `max_step` (s).

    With a `refinement` each of these steps is divided into so many. `given_events` of the loads at
    all `event_places` are computed unless they are given.

    `extra_steps` are added to each panel. An error estimate takes one: a smaller `max_step` may
    leave the number of steps of a short panel unchanged. Steps also end where a wheel passes one of
    the `places` (m).
    """
    end = case.run.duration
    found = _events_between(case, model, places, np.zeros(()), end, given_events)
    return _grid_of_steps(found, end, max_step, extra_steps, refinement)


def grid_between_events(
    load_events: LoadEvents,
    duration: Float[Array, ""],
    max_step: Float[Array, ""],
    extra_steps: int | Int[Array, ""] = 0,
) -> TimeGrid:
    """`grid_by_step_length` from given load events, without passages over kinks."""
    windows, events = load_events
    events = xp.clip(events, 0.0, duration)
    found = windows, events, np.zeros(0), None, np.zeros(0, int)
    return _grid_of_steps(found, duration, max_step, extra_steps)


def _grid_of_steps(found, end, max_step, extra_steps, refinement: int = 1) -> TimeGrid:
    """Grid with steps of at most `max_step` (s) between events `found` by `_events_between`."""
    windows, events, twice, kinks, index = found
    times = xp.concatenate([xp.zeros(1), events, twice, end[None]])
    order = xp.argsort(times, stable=True)
    boundaries, positions = times[order], xp.argsort(order)
    panel_lengths = xp.diff(boundaries)
    counts = xp.ceil(stop_gradient(panel_lengths / max_step)).astype(int) + extra_steps * (
        panel_lengths > 0
    )
    passage = None
    if kinks is not None:
        passage = _passage_of_panels(positions[1 + events.shape[0] : -1 : 2], index, counts)
        counts = xp.maximum(counts, xp.where(passage >= 0, 1, 0))
    counts = counts * refinement
    lengths = panel_lengths / xp.maximum(counts, 1)
    length_index = xp.arange(panel_lengths.shape[0])
    lengths = xp.append(lengths, 0.0)
    loads_on_beam = _loads_on_beam(positions[1 : 1 + windows.size], counts.shape[0])
    return TimeGrid(
        boundaries,
        counts,
        xp.cumsum(counts),
        length_index,
        lengths,
        loads_on_beam,
        windows,
        kinks=kinks,
        passage=passage,
    )


def _passage_of_panels(positions, index, panels: Int[Array, " panel"]):
    """Index of the passage that is the first step of each panel, -1 for none.

    `positions` are the panels that start with the passages in `index`, which is -1 for none.
    """
    return put(xp.full_like(panels, -1), xp.where(index < 0, panels.shape[0], positions), index)


def grid_by_schedule(
    case: Case,
    model: ModalModel,
    schedule: EventSchedule,
    substeps: int | Int[Array, ""],
    places: Float[Array, " place"] | None = None,
    given_events: LoadEvents | None = None,
    loads: LoadSet | None = None,
) -> TimeGrid:
    """Panels between the events of a schedule and the load events, of `substeps` steps each.

    Nearly all panels have one of a few step lengths, hence the same propagators. Steps also end
    where a wheel passes one of the `places` (m). The loads, or `given_events` of them at all
    `event_places`, are computed unless they are given.
    """
    times = schedule.times
    between = times[0], times[-1], given_events, loads
    windows, events, twice, kinks, index = _events_between(case, model, places, *between)
    if schedule.control_sample is not None:
        # A step of zero length after the end: the controller acts at the last event too.
        events = xp.append(events, times[-1])
    # Passages over kinks come before an event at the same time.
    boundary_times = xp.concatenate([twice, times, events])
    order = xp.argsort(boundary_times, stable=True)
    boundaries = boundary_times[order]
    panel_lengths = xp.diff(boundaries)
    first = twice.shape[0]
    is_scheduled = (order >= first) & (order < first + times.shape[0])
    positions = xp.argsort(order)
    # The other panels adjoin a load event or a passage: at most two each.
    between_scheduled = is_scheduled[1:] & is_scheduled[:-1]
    length_count = schedule.lengths.shape[0]
    others = 2 * events.shape[0] + first + 1
    lengths = xp.concatenate([schedule.lengths, xp.zeros(others)])
    of_passage = xp.zeros(panel_lengths.shape, bool)
    if first:
        of_passage = put(of_passage, positions[:first:2], xp.ones(first // 2, bool))
    length_index = xp.where(
        between_scheduled,
        take(
            schedule.length_index,
            xp.clip(xp.cumsum(is_scheduled)[:-1] - 1, 0, schedule.length_index.shape[0] - 1),
        ),
        length_count - 1 + xp.cumsum(~between_scheduled & ~of_passage),
    )
    length_index = xp.where(of_passage, lengths.shape[0] - 1, length_index)
    shared = between_scheduled | of_passage
    lengths = put(lengths, xp.where(shared, lengths.shape[0], length_index), panel_lengths)
    counts = xp.full(panel_lengths.shape, substeps)
    passage = None if kinks is None else _passage_of_panels(positions[:first:2], index, counts)
    positions = positions[first:]
    event_positions = positions[times.shape[0] : times.shape[0] + windows.size]
    loads_on_beam = _loads_on_beam(event_positions, panel_lengths.shape[0])
    scheduled_event = xp.where(is_scheduled[:-1], order[:-1] - first, -1)
    cumulative_counts, lengths = xp.cumsum(counts), lengths / substeps
    return TimeGrid(
        boundaries,
        counts,
        cumulative_counts,
        length_index,
        lengths,
        loads_on_beam,
        windows,
        scheduled_event,
        positions,
        kinks,
        passage,
    )
