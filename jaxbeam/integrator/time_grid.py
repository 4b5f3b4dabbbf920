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
from jaxbeam.case.loads import motion
from jaxbeam.integrator.events import Schedule
from jaxbeam.model.modal_model import Rig


class Grid(eqx.Module):
    """Panels, each with a number of equal steps; step lengths are shared among panels.

    `counts` are the numbers of steps in the panels, `ends` those up to the end of each: added up
    once, because a loop over many panels must not add them up in every turn. `kind` says which of
    `lengths` (s) the steps of a panel have. The last of the lengths is zero: it belongs to the
    steps after the end, which fill up a chunk. `opens` is the edge of the schedule at which a panel
    starts, -1 for an event; `place` is where edges of the schedule are.
    """

    edges: Float[Array, " edge"]
    counts: Int[Array, " panel"]
    ends: Int[Array, " panel"]
    kind: Int[Array, " panel"]
    lengths: Float[Array, " length"]
    active: Bool[Array, "panel load"]
    windows: Float[Array, "load 2"]
    opens: Int[Array, " panel"] | None = None
    place: Int[Array, " planned"] | None = None

    @property
    def last_exit(self) -> Float[Array, ""]:
        """Time (s) after which no load is on the beam."""
        return jnp.max(self.windows[:, 1], initial=0.0)

    @property
    def total(self) -> Int[Array, ""]:
        """Number of steps."""
        return self.ends[-1]

    def steps(self, index: Int[Array, " step"]):
        """Panel, start time (s) and kind of length of the steps with these indices."""
        beyond = index >= self.total
        if self.opens is None:
            panel = jnp.searchsorted(self.ends, index, side="right", method="compare_all")
        else:  # there may be many, all alike
            panel = index // self.counts[0]
        panel = jnp.minimum(panel, self.counts.shape[0] - 1)
        kind = jnp.where(beyond, self.lengths.shape[0] - 1, self.kind[panel])
        start = self.edges[panel] + (index - self._first(panel)) * self.lengths[self.kind[panel]]
        return panel, jnp.where(beyond, self.edges[-1], start), kind

    def edge(self, index: Int[Array, " step"]) -> Int[Array, " step"]:
        """Edge of the schedule at which each of some steps starts, -1 for none."""
        panel, _, _ = self.steps(index)
        starts = (index == self._first(panel)) & (index < self.total)
        return jnp.where(starts, self.opens[panel], -1)

    def _first(self, panel):
        """The first step of a panel."""
        return self.ends[panel] - self.counts[panel]


def _events(case: Case, rig: Rig):
    """Entry and exit of every load (load, 2), and all events (event,), in s."""
    inner = rig.modes.nodes[1:-1]
    motions = [motion(load, case.beam.length) for load in case.loads]
    if not motions:
        return jnp.zeros((0, 2)), jnp.zeros(0)
    windows = jnp.stack([jnp.stack(path.window()) for path in motions])
    kinks = [path.passage_times(inner) for path in motions]
    return windows, jnp.concatenate([windows.ravel(), *kinks])


def _activity(windows, edges):
    """Which loads are on the beam in each panel (panel, load)."""
    middle = (edges[1:] + edges[:-1]) / 2
    return (windows[:, 0] < middle[:, None]) & (middle[:, None] < windows[:, 1])


def even_grid(
    case: Case, rig: Rig, longest: Float[Array, ""], more: int | Int[Array, ""] = 0
) -> Grid:
    """Panels from event to event, with as many steps as keep them below `longest` (s), and `more`.

    To see what finer steps change, `more` is one: a short panel has the same whole number of steps
    of many lengths.
    """
    windows, events = _events(case, rig)
    end = case.run.duration
    edges = jnp.concatenate([jnp.zeros(1), jnp.clip(jnp.sort(events), 0.0, end), end[None]])
    spans = jnp.diff(edges)
    counts = jnp.ceil(jax.lax.stop_gradient(spans / longest)).astype(int) + more * (spans > 0)
    lengths = spans / jnp.maximum(counts, 1)
    kind = jnp.arange(spans.shape[0])
    lengths = jnp.append(lengths, 0.0)
    active = _activity(windows, edges)
    return Grid(edges, counts, jnp.cumsum(counts), kind, lengths, active, windows)


def scheduled_grid(
    case: Case, rig: Rig, schedule: Schedule, substeps: int | Int[Array, ""]
) -> Grid:
    """Panels from edge to edge of a schedule (or event between), each of `substeps` steps.

    Nearly all panels then share a few step lengths, and with them their propagators.
    """
    times = schedule.times
    windows, events = _events(case, rig)
    if schedule.tick is not None:
        # A step of no length after the end lets the controller act there once more.
        events = jnp.append(events, times[-1])
    where = jnp.concatenate([times, jnp.clip(events, times[0], times[-1])])
    order = jnp.argsort(where)
    edges = where[order]
    spans = jnp.diff(edges)
    planned = order < times.shape[0]
    # The others lie beside an event: at most two for each.
    usual = planned[1:] & planned[:-1]
    kinds = schedule.lengths.shape[0]
    kind = jnp.where(
        usual,
        schedule.gaps[jnp.clip(jnp.cumsum(planned)[:-1] - 1, 0, schedule.gaps.shape[0] - 1)],
        kinds - 1 + jnp.cumsum(~usual),
    )
    lengths = jnp.concatenate([schedule.lengths, jnp.zeros(2 * events.shape[0] + 1)])
    lengths = lengths.at[jnp.where(usual, lengths.shape[0], kind)].set(spans, mode="drop")
    counts = jnp.full(spans.shape, substeps)
    active = _activity(windows, edges)
    opens = jnp.where(planned[:-1], order[:-1], -1)
    ends, lengths = jnp.cumsum(counts), lengths / substeps
    place = jnp.argsort(order)
    return Grid(edges, counts, ends, kind, lengths, active, windows, opens, place)
