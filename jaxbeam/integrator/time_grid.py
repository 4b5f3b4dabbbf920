"""Where the time steps lie: panels of equal steps between events and saved samples.

An event is a time at which the motion is not smooth: a load enters, leaves, stops, or passes a
support or the edge of a patch. Steps never straddle one. The number of panels is fixed by the
case's structure, so it can be compiled; their edges are numbers like any other, and a panel of
no length does no harm.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.loads import trajectory
from jaxbeam.integrator.events import EventSchedule
from jaxbeam.model.modal_model import ModalModel


class TimeGrid(eqx.Module):
    """Panels, each with a number of equal steps; step lengths are shared among panels.

    `counts` are the numbers of steps in the panels, `cumulative_counts` those up to the end of each: added up
    once, because a loop over many panels must not add them up in every turn. `length_index` says which of
    `lengths` (s) the steps of a panel have. The last of the lengths is zero: it belongs to the
    steps after the end, which fill up a chunk. `event` is the edge of the schedule at which a panel
    starts, -1 for an event; `event_panels` is where edges of the schedule are.
    """

    boundaries: Float[Array, " event_at"]
    counts: Int[Array, " panel"]
    cumulative_counts: Int[Array, " panel"]
    length_index: Int[Array, " panel"]
    lengths: Float[Array, " length"]
    loads_on_beam: Bool[Array, "panel load"]
    on_beam_intervals: Float[Array, "load 2"]
    event: Int[Array, " panel"] | None = None
    event_panels: Int[Array, " planned"] | None = None

    @property
    def last_exit(self) -> Float[Array, ""]:
        """Time (s) after which no load is on the beam."""
        return jnp.max(self.on_beam_intervals[:, 1], initial=0.0)

    @property
    def step_count(self) -> Int[Array, ""]:
        """Number of steps."""
        return self.cumulative_counts[-1]

    def locate_steps(self, index: Int[Array, " step"]):
        """Panel, start time (s) and kind of length of the steps with these indices."""
        after_end = index >= self.step_count
        if self.event is None:
            panel = jnp.searchsorted(
                self.cumulative_counts, index, side="right", method="compare_all"
            )
        else:  # there may be many, all alike
            panel = index // self.counts[0]
        panel = jnp.minimum(panel, self.counts.shape[0] - 1)
        length_index = jnp.where(after_end, self.lengths.shape[0] - 1, self.length_index[panel])
        start = (
            self.boundaries[panel]
            + (index - self._first_step(panel)) * self.lengths[self.length_index[panel]]
        )
        return panel, jnp.where(after_end, self.boundaries[-1], start), length_index

    def event_at(self, index: Int[Array, " step"]) -> Int[Array, " step"]:
        """Edge of the schedule at which each of some steps starts, -1 for none."""
        panel, _, _ = self.locate_steps(index)
        starts = (index == self._first_step(panel)) & (index < self.step_count)
        return jnp.where(starts, self.event[panel], -1)

    def _first_step(self, panel):
        """The first step of a panel."""
        return self.cumulative_counts[panel] - self.counts[panel]


def _load_events(case: Case, model: ModalModel):
    """Entry and exit of every load (load, 2), and all events (event,), in s."""
    inner_nodes = model.modes.nodes[1:-1]
    trajectories = [trajectory(load, case.beam.length) for load in case.loads]
    if not trajectories:
        return jnp.zeros((0, 2)), jnp.zeros(0)
    windows = jnp.stack([jnp.stack(path.entry_exit_times()) for path in trajectories])
    nonsmooth_times = [path.passage_times(inner_nodes) for path in trajectories]
    return windows, jnp.concatenate([windows.ravel(), *nonsmooth_times])


def _loads_on_beam(windows, boundaries):
    """Which loads are on the beam in each panel (panel, load)."""
    middle = (boundaries[1:] + boundaries[:-1]) / 2
    return (windows[:, 0] < middle[:, None]) & (middle[:, None] < windows[:, 1])


def grid_by_step_length(
    case: Case, model: ModalModel, max_step: Float[Array, ""], extra_steps: int | Int[Array, ""] = 0
) -> TimeGrid:
    """Panels from event to event, with as many steps as keep them below `max_step` (s), and `extra_steps`.

    To see what finer steps change, `extra_steps` is one: a short panel has the same whole number of steps
    of many lengths.
    """
    windows, events = _load_events(case, model)
    end = case.run.duration
    boundaries = jnp.concatenate([jnp.zeros(1), jnp.clip(jnp.sort(events), 0.0, end), end[None]])
    panel_lengths = jnp.diff(boundaries)
    counts = jnp.ceil(jax.lax.stop_gradient(panel_lengths / max_step)).astype(int) + extra_steps * (
        panel_lengths > 0
    )
    lengths = panel_lengths / jnp.maximum(counts, 1)
    length_index = jnp.arange(panel_lengths.shape[0])
    lengths = jnp.append(lengths, 0.0)
    loads_on_beam = _loads_on_beam(windows, boundaries)
    return TimeGrid(
        boundaries, counts, jnp.cumsum(counts), length_index, lengths, loads_on_beam, windows
    )


def grid_by_schedule(
    case: Case, model: ModalModel, schedule: EventSchedule, substeps: int | Int[Array, ""]
) -> TimeGrid:
    """Panels from edge to edge of a schedule (or event between), each of `substeps` steps.

    Nearly all panels then share a few step lengths, and with them their propagators.
    """
    times = schedule.times
    windows, events = _load_events(case, model)
    if schedule.control_sample is not None:
        # A step of no length after the end lets the controller act there once more.
        events = jnp.append(events, times[-1])
    boundary_times = jnp.concatenate([times, jnp.clip(events, times[0], times[-1])])
    order = jnp.argsort(boundary_times)
    boundaries = boundary_times[order]
    panel_lengths = jnp.diff(boundaries)
    is_scheduled = order < times.shape[0]
    # The others lie beside an event: at most two for each.
    between_scheduled = is_scheduled[1:] & is_scheduled[:-1]
    length_count = schedule.lengths.shape[0]
    length_index = jnp.where(
        between_scheduled,
        schedule.length_index[
            jnp.clip(jnp.cumsum(is_scheduled)[:-1] - 1, 0, schedule.length_index.shape[0] - 1)
        ],
        length_count - 1 + jnp.cumsum(~between_scheduled),
    )
    lengths = jnp.concatenate([schedule.lengths, jnp.zeros(2 * events.shape[0] + 1)])
    lengths = lengths.at[jnp.where(between_scheduled, lengths.shape[0], length_index)].set(
        panel_lengths, mode="drop"
    )
    counts = jnp.full(panel_lengths.shape, substeps)
    loads_on_beam = _loads_on_beam(windows, boundaries)
    scheduled_event = jnp.where(is_scheduled[:-1], order[:-1], -1)
    cumulative_counts, lengths = jnp.cumsum(counts), lengths / substeps
    event_boundary = jnp.argsort(order)
    return TimeGrid(
        boundaries,
        counts,
        cumulative_counts,
        length_index,
        lengths,
        loads_on_beam,
        windows,
        scheduled_event,
        event_boundary,
    )
