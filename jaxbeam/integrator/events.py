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

SAME = 1e-9  # of the run: closer times are one
DISTINCT = 64  # more different gaps than these are no longer told apart one by one


class Schedule(eqx.Module):
    """Edges in time, the gaps between them, and what is due at each.

    `gaps` says which of the `lengths` (s) each gap has; `samples` are the edges at which the run
    is sampled. For a run with a controller: `tick` numbers the edges at which it acts, `reads`
    those at which each sensor is read, -1 elsewhere. `age` counts the readings of a sensor made
    since the one that has arrived by a tick, `apply` the commands made since the one that begins
    to act at an edge, -1 where none does. `newest` and `waiting` are their largest values.
    """

    times: Float[Array, " edge"]
    gaps: Int[Array, " gap"]
    lengths: Float[Array, " length"]
    samples: Int[Array, " time"]
    tick: Int[Array, " edge"] | None = None
    apply: Int[Array, " edge"] | None = None
    reads: Int[Array, "edge sensor"] | None = None
    age: Int[Array, "edge sensor"] | None = None
    newest: int = eqx.field(static=True, default=0)
    waiting: int = eqx.field(static=True, default=0)
    most_reads: int = eqx.field(static=True, default=0)


def sampled(times: Float[Array, " time"], even: bool, lead: int = 0) -> Schedule:
    """The schedule of nothing but samples at ascending times (s); `even` if equally spaced.

    The first `lead` times are no samples. Also for times that are being traced.
    """
    count = times.shape[0]
    samples = jnp.arange(lead, count)
    if even:
        spacing = (times[-1] - times[0]) / (count - 1)
        return Schedule(times, jnp.zeros(count - 1, int), spacing[None], samples)
    return Schedule(times, jnp.arange(count - 1), jnp.diff(times), samples)


def merged(
    samples: Float[np.ndarray, " time"],
    ticks: Float[np.ndarray, " tick"],
    delay: float,
    clocks: list[Float[np.ndarray, "_"]],
    late: list[float],
    knots: Float[np.ndarray, " knot"],
) -> Schedule:
    """The schedule of a run with a controller, from rest at zero to the last sample.

    `ticks` (s) are when the controller acts, its commands begin `delay` (s) later; `clocks` (s)
    are when readings of each sensor arrive, of what it saw `late` (s) before; `knots` (s) are
    where a prescribed command bends.
    """
    end = float(samples[-1])
    seen = [clock - lag for clock, lag in zip(clocks, late, strict=True)]
    every = np.sort(np.concatenate([np.zeros(1), samples, ticks, ticks + delay, knots, *seen]))
    every = every[(every >= 0) & (every <= end * (1 + SAME))]
    times = every[np.diff(every, prepend=-np.inf) > SAME * end]
    # Samples are where they were asked for, to the last bit; others give way to them.
    near = np.clip(np.searchsorted(samples, times - SAME * end), 0, samples.size - 1)
    times = np.where(np.abs(samples[near] - times) <= SAME * end, samples[near], times)

    def edges(wanted):
        return np.clip(np.searchsorted(times, wanted - SAME * end), 0, times.size - 1)

    def numbered(wanted):
        due = np.full(times.size, -1)
        during = np.flatnonzero((wanted >= -SAME * end) & (wanted <= end * (1 + SAME)))
        due[edges(wanted[during])] = during
        return due

    def so_far(due):
        return np.maximum.accumulate(due)

    tick, begins = numbered(ticks), numbered(ticks + delay)
    apply = np.where(begins >= 0, so_far(tick) - begins, -1)
    reads = [numbered(times) for times in seen]
    arrived = [np.searchsorted(clock, times + SAME * end, side="right") - 1 for clock in clocks]
    # What was seen before the run is what is seen at rest: the buffer holds nothing else then.
    pairs = zip(reads, arrived, strict=True)
    age = [np.maximum(so_far(made) - here, 0) for made, here in pairs]
    gaps = np.diff(times)
    lengths, kind = np.unique(np.round(gaps / (1e-2 * SAME * end)), return_inverse=True)
    if lengths.size > DISTINCT:
        kind = np.arange(gaps.size)
    means = np.bincount(kind, gaps) / np.bincount(kind)

    def columns(parts):
        return jnp.asarray(np.array(parts).reshape(len(parts), times.size).T, int)

    return Schedule(
        jnp.asarray(times),
        jnp.asarray(kind),
        jnp.asarray(means),
        jnp.asarray(edges(samples)),
        tick=jnp.asarray(tick),
        apply=jnp.asarray(apply),
        reads=columns(reads),
        age=columns(age),
        newest=int(max((part.max() for part in age), default=0)),
        waiting=int(apply.max(initial=0)),
        most_reads=max((clock.size for clock in clocks), default=0),
    )


def stacked(schedules: list[Schedule]) -> Schedule:
    """Schedules of equally many edges and samples, along a new first axis.

    Raises ValueError if their numbers differ.
    """
    if len({(s.times.shape, s.samples.shape) for s in schedules}) > 1:
        raise ValueError("the schedules differ in the number of their edges or samples")
    most = max(s.lengths.shape[0] for s in schedules)
    counts = ("newest", "waiting", "most_reads")
    largest = {name: max(getattr(s, name) for s in schedules) for name in counts}

    def alike(schedule):
        lengths = jnp.append(schedule.lengths, jnp.zeros(most - schedule.lengths.shape[0]))
        return dataclasses.replace(schedule, lengths=lengths, **largest)

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(alike, schedules))
