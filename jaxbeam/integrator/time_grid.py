"""Time grid: panels of equal steps between events and samples.

A load event is a time at which the motion is not smooth: a load enters, leaves, stops, or passes
a support or the end of a patch. No step contains one inside. The structure of the case fixes the
number of panels, so the grid can be compiled; a panel of zero length has no effect.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.integrator.events import EventSchedule
from jaxbeam.integrator.kinks.passages import KinkPassages, kink_passages
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, put, searchsorted, stop_gradient, take, xp
from jaxbeam.runtime.module import Module

# Entry and exit of each wheel (s), and times of all load events (s).
LoadEvents = tuple[Float[Array, "wheel 2"], Float[Array, " event"]]


class TimeGrid(Module):
    """Panels between `boundaries` (s), each with a number of equal steps.

    `counts` are the numbers of steps of the panels, `cumulative_counts` those up to the end of
    each. `length_index` is the index of a panel's step length among `lengths` (s), whose last is
    zero: that of the steps after the end, which fill the last chunk. `event` is the index of the
    scheduled event at which a panel starts, -1 for a load event; `event_panels` is the panel that
    starts at each scheduled event. `on_beam_intervals` are entry and exit of each load (s).
    `passage` is the index of the passage over a kink, among the `kinks`, that is the first step of
    a panel of no length; -1 for none.
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

    def _first_step(self, panel):
        """Index of the first step of a panel."""
        return take(self.cumulative_counts, panel) - take(self.counts, panel)


def event_places(
    model: ModalModel, places: Float[Array, " place"] | None
) -> Float[Array, " event_place"]:
    """Places (m) at which a passing wheel is a load event: those of the model, and some more."""
    own = model.modes.nodes[1:-1]
    return own if places is None else xp.concatenate([own, places])


def _events_between(case: Case, model: ModalModel, places, start, end, known=None):
    """Events of the loads, if not `known`, clipped to start and end, and passages over kinks.

    Of these each time twice: a panel of no length lies in between. Then the passages, and the
    index of each, -1 for one that does not happen, whose times are the end.
    """
    loads = None
    if known is None:
        loads = load_set(case, model.modes.layout)
        known = loads.events(event_places(model, places))
    windows, events = known
    events, kinks = xp.clip(events, start, end), kink_passages(case, model, loads)
    if kinks is None:
        return windows, events, xp.zeros(0), None, np.zeros(0, int)
    happen = kinks.happen(windows, start, end)
    times = xp.where(happen, kinks.times, end)
    index = xp.where(happen, np.arange(times.shape[0]), -1)
    return windows, events, xp.repeat(times, 2), kinks, index


def _loads_on_beam(positions, panels: int):
    """Whether each wheel is on the beam in each panel, (panel, wheel).

    From the positions of its entry and exit, one after the other, among the boundaries: so a panel
    of no length between a sample and an exit at the same time has its derivative.
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
    known_events: LoadEvents | None = None,
) -> TimeGrid:
    """Panels between load events, with steps of at most `max_step` (s).

    With a `refinement` each of these steps is divided into so many. The events of the loads at
    all `event_places` can be given, if they are known.

    `extra_steps` are added to each panel. An error estimate takes one: a smaller `max_step` may
    leave the number of steps of a short panel unchanged. Steps also end where a wheel passes one of
    the `places` (m).
    """
    end = case.run.duration
    found = _events_between(case, model, places, np.zeros(()), end, known_events)
    return _grid_of_steps(found, end, max_step, extra_steps, refinement)


def grid_between_events(
    load_events: LoadEvents,
    duration: Float[Array, ""],
    max_step: Float[Array, ""],
    extra_steps: int | Int[Array, ""] = 0,
) -> TimeGrid:
    """`grid_by_step_length` of known load events, where no wheel with mass passes a kink."""
    windows, events = load_events
    events = xp.clip(events, 0.0, duration)
    found = windows, events, np.zeros(0), None, np.zeros(0, int)
    return _grid_of_steps(found, duration, max_step, extra_steps)


def _grid_of_steps(found, end, max_step, extra_steps, refinement: int = 1) -> TimeGrid:
    """Grid with steps of at most a length between the events that `_events_between` has found."""
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
    """Index of the passage that is the first step of each of the panels, -1 for none.

    From the panels that start with the passages of some indices, which are -1 for none.
    """
    return put(xp.full_like(panels, -1), xp.where(index < 0, panels.shape[0], positions), index)


def grid_by_schedule(
    case: Case,
    model: ModalModel,
    schedule: EventSchedule,
    substeps: int | Int[Array, ""],
    places: Float[Array, " place"] | None = None,
    known_events: LoadEvents | None = None,
) -> TimeGrid:
    """Panels between the events of a schedule and the load events, of `substeps` steps each.

    Nearly all panels share a few step lengths, hence their propagators. Steps also end where a
    wheel passes one of the `places` (m). The events of the loads at all `event_places` can be
    given, if they are known.
    """
    times = schedule.times
    between = times[0], times[-1], known_events
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
