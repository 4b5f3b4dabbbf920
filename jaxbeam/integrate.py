"""The fast integrator: exact modal propagation, contact forces collocated at Gauss nodes.

Within a step every contact force is the polynomial through its values at the Gauss nodes, and so
is the force it puts on each mode; the rig answers exactly (`exponentials`). Demanding the contact
law at the nodes gives a small linear system a step. The free rig brings neither error nor
stiffness at any step length; the order is twice the number of nodes. Steps are taken in chunks:
what depends on the path alone is tabulated for a chunk at once and shared by all lanes, a short
loop then advances the states, and what is wanted of the chunk is reduced at once again.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbeam.dynamics import Traffic, contact_rows, solve_contact
from jaxbeam.exponentials import GAUSS, LONGEST, NODES, POINTS, Step, norm, propagators
from jaxbeam.grid import Grid
from jaxbeam.loads import AbstractLoad, MovingMass
from jaxbeam.motion import NEVER
from jaxbeam.peaks import refine, vertex
from jaxbeam.rig import Rig

CHUNK = 16
# Radians a step of the highest mode. Beyond twice the number of nodes the contact force of a mass,
# a polynomial in each step, misses that mode's oscillation and feeds it.
RESOLVED = 1.9 * NODES
NEAR = 1.1  # a peak between samples is less than this above the highest of them


def longest_step(rig: Rig, loads: tuple[AbstractLoad, ...]) -> Float[Array, ""]:
    """Longest step (s) with which these loads on the rig can be integrated without blowing up."""
    limit = LONGEST / norm(rig)
    if any(isinstance(load, MovingMass) for load in loads):
        fastest = jnp.sqrt(jnp.max(jnp.linalg.eigvalsh(rig.stiffness())))
        limit = jnp.minimum(limit, RESOLVED / fastest)
    return jax.lax.stop_gradient(limit)


class Extremes(eqx.Module):
    """What a march keeps of a run without storing it.

    `samples` are the deflections at equal points of the step with the largest absolute deflection
    of each watched place, `start` (s) and `span` (s) that step. Contact forces are those with
    which a load presses on the beam; `lost` (s) is the first time it would have to pull.
    """

    score: Float[Array, "sensor lane"]
    samples: Float[Array, "point sensor lane"]
    start: Float[Array, "sensor lane"]
    span: Float[Array, "sensor lane"]
    lowest: Float[Array, "load lane"]
    lost: Float[Array, "load lane"]

    def peak(self) -> tuple[Float[Array, "sensor lane"], Float[Array, "sensor lane"]]:
        """Largest absolute deflection (m) of each watched place, and when (s)."""
        value, place = refine(self.samples)
        return value, self.start + place * self.span


class Tables(eqx.Module):
    """What one chunk of steps needs, computed from path and rig alone."""

    respond: Float[Array, "step row state"]
    gains: Float[Array, "step row row"]
    drift: Float[Array, "step block side side"]
    push: Float[Array, "step state row"]
    watch: Float[Array, "step looked state"] | None
    watch_push: Float[Array, "step looked row"] | None
    slots: Int[Array, "step slot"]
    active: Bool[Array, "step slot"]


class Rigging(eqx.Module):
    """Propagators of the rig on a grid, and the rows that give the watched deflections."""

    step: Step
    watch: Float[Array, "length looked block side"] | None
    watch_push: Float[Array, "length looked force block mode"] | None


def _rigging(rig: Rig, grid: Grid, watched) -> Rigging:
    step = propagators(rig, grid.lengths, 0 if watched is None else POINTS)
    if watched is None:
        return Rigging(step, None, None)
    each = rig.modes_per_block
    blocks = rig.state_matrix.shape[0]
    rows = rig.shapes(watched, (0,))[0].reshape(-1, blocks, each)
    places = np.arange(0, 2 * each, 2)
    watch = jnp.einsum("wbm,lpbmj->lpwbj", rows, step.drift_points[..., places, :])
    push = jnp.einsum("wbm,lpfbmk->lpwfbk", rows, step.push_points[..., places, :])
    flat = (grid.lengths.shape[0], -1)
    return Rigging(
        step, watch.reshape(*flat, *watch.shape[3:]), push.reshape(*flat, *push.shape[3:])
    )


def _tabulate(rig: Rig, traffic: Traffic, grid: Grid, rigging: Rigging, slots: int, index):
    """Tables of the steps with the given indices, and their start times and lengths (s)."""
    panel, start, kind = grid.steps(index)
    span = grid.lengths[kind]
    times = start[:, None] + span[:, None] * GAUSS
    position, speed, acceleration = (jnp.moveaxis(p, 0, 1) for p in traffic.travel(times))
    active = grid.active[panel]  # step, load
    if slots < len(traffic.motions):
        # Loads on the beam first; those that find no slot are off the beam.
        chosen = jnp.argsort(~active, axis=1)[:, :slots]
        pick = chosen[:, :, None]
        position, speed, acceleration = (
            jnp.take_along_axis(part, pick, axis=1) for part in (position, speed, acceleration)
        )
        active = jnp.take_along_axis(active, chosen, axis=1)
    else:
        chosen = jnp.broadcast_to(jnp.arange(slots), active.shape)
    on = jnp.broadcast_to(active[:, :, None], position.shape)
    shape, rows = contact_rows(rig, position, speed, acceleration, on)

    def alike(_):
        return _tables_of_kind(rigging, kind[0], shape, rows)

    def one_by_one(_):
        def single(step):
            kind, shape, rows = step
            tables = _tables_of_kind(rigging, kind, shape[None], rows[None])
            return jax.tree.map(lambda table: table[0], tables)

        return jax.lax.map(single, (kind, shape, rows))

    # Mostly all steps of a chunk are equally long, and then share their propagators.
    tables: Any = jax.lax.cond(jnp.all(kind == kind[0]), alike, one_by_one, None)
    return Tables(*tables, slots=chosen, active=active), start, span


def _tables_of_kind(rigging: Rigging, kind, shape, rows):
    """Tables of steps of one length, from the shape and contact rows (step, slot, node, ...)."""
    step, watch, watch_push = jax.tree.map(
        lambda table: jax.lax.dynamic_index_in_dim(table, kind, keepdims=False),
        (rigging.step, rigging.watch, rigging.watch_push),
    )
    steps, slots, nodes = shape.shape[:3]
    size = slots * nodes
    states = rows.shape[3] * rows.shape[4]
    respond = jnp.einsum("tpcbi,cbij->tpcbj", rows, step.drift_nodes)
    felt = jnp.einsum("tpcbi,cfbim->tpcfbm", rows, step.push_nodes)
    gains = jnp.einsum("tpcfbm,tqfbm->tpcqf", felt, shape)
    direct = jnp.einsum("tpcbm,tqcbm->tpcq", shape, shape)
    gains = gains + direct[..., None] * np.eye(nodes)[:, None, :]
    push = jnp.einsum("tqfbm,fbim->tbiqf", shape, step.push_end)

    def each(table):
        return jnp.broadcast_to(table, (steps, *table.shape))

    tables = (
        respond.reshape(steps, size, states),
        gains.reshape(steps, size, size),
        each(step.drift_end),
        push.reshape(steps, states, size),
    )
    if watch is None:
        return *tables, None, None
    seen = jnp.einsum("lfbm,tqfbm->tlqf", watch_push, shape)
    looked = watch.shape[0]
    return (
        *tables,
        each(watch.reshape(looked, states)),
        seen.reshape(steps, looked, size),
    )


def _rows(loads: Float[Array, "load lane"], tables: Tables) -> Float[Array, "step row lane"]:
    """A property of the loads for every row of the contact equations; zero for idle slots."""
    chosen = jnp.where(tables.active[..., None], loads[tables.slots], 0.0)
    return jnp.repeat(chosen, len(GAUSS), axis=1)


def _advance(state, step):
    """One step of all lanes: the contact forces at the nodes, and the state at the end."""
    tables, inertia, weight = step
    forces = solve_contact(tables.gains, inertia, weight + inertia * (tables.respond @ state))
    blocks, side, _ = tables.drift.shape
    split = state.reshape(blocks, side, -1)
    if side == 2:
        drifted = tables.drift[:, :, :1] * split[:, :1] + tables.drift[:, :, 1:] * split[:, 1:]
    else:
        drifted = tables.drift @ split
    after = drifted.reshape(state.shape) + tables.push @ forces
    return after, (state, forces)


def _reduce(best: Extremes, tables: Tables, states, forces, start, span) -> Extremes:
    """Fold a chunk into the extremes."""
    steps, lanes = states.shape[0], states.shape[-1]
    seen = tables.watch @ states + tables.watch_push @ forces
    samples = jax.lax.optimization_barrier(seen.reshape(steps, POINTS + 1, -1, lanes))

    def raised(best):
        score = jax.lax.optimization_barrier(jax.vmap(vertex)(samples))
        top = jnp.argmax(score, axis=0)
        better = jnp.max(score, axis=0) > best.score
        chosen = jnp.take_along_axis(samples, top[None, None], axis=0)[0]
        return Extremes(
            jnp.where(better, jnp.max(score, axis=0), best.score),
            jnp.where(better, chosen, best.samples),
            jnp.where(better, start[top], best.start),
            jnp.where(better, span[top], best.span),
            best.lowest,
            best.lost,
        )

    # Most chunks come nowhere near the peak so far, or press all along: they end here.
    highest = jnp.max(jnp.abs(samples), axis=(0, 1))
    best = jax.lax.cond(jnp.any(highest * NEAR > best.score), raised, lambda best: best, best)
    pressing = jnp.min(-forces.reshape(steps, -1, len(GAUSS), lanes), axis=2)
    # A load that is not on the beam, or has no slot, does not count.
    here = (tables.slots[:, :, None] == np.arange(best.lowest.shape[0])) & tables.active[..., None]
    least = jnp.where(here[..., None], pressing[:, :, None], jnp.inf)
    lowest = jnp.minimum(best.lowest, jnp.min(least, axis=(0, 1), initial=jnp.inf))

    def lost(first):
        pulls = -forces.reshape(steps, -1, 1, len(GAUSS), lanes) < 0
        times = (start[:, None] + span[:, None] * GAUSS)[:, None, None, :, None]
        when = jnp.where(pulls & here[..., None, None], times, NEVER)
        return jnp.minimum(first, jnp.min(when, axis=(0, 1, 3), initial=NEVER))

    first = jax.lax.cond(jnp.any(lowest < 0), lost, lambda first: first, best.lost)
    return eqx.tree_at(lambda b: (b.lowest, b.lost), best, (lowest, first))


def _nothing_seen(places: int, loads: int, lanes: int) -> Extremes:
    nothing = jnp.zeros((places, lanes))
    return Extremes(
        nothing,
        jnp.zeros((POINTS + 1, places, lanes)),
        nothing,
        nothing,
        jnp.full((loads, lanes), jnp.inf),
        jnp.full((loads, lanes), NEVER),
    )


def _stepper(rig: Rig, traffic: Traffic, grid: Grid, watched, slots: int):
    """Function that takes state and extremes through the chunk that begins with a given step."""
    rigging = _rigging(rig, grid, watched)

    def chunk(state, best, first):
        index = first + jnp.arange(CHUNK)
        tables, start, span = _tabulate(rig, traffic, grid, rigging, slots, index)
        steps = tables, _rows(traffic.inertia, tables), _rows(traffic.weight, tables)
        state, (states, forces) = jax.lax.scan(_advance, state, steps)
        if watched is not None:
            best = _reduce(best, tables, states, forces, start, span)
        return state, best, states

    return chunk


def trace(
    rig: Rig,
    traffic: Traffic,
    grid: Grid,
    watched: Float[Array, " sensor"] | None,
    *,
    slots: int,
    steps: int,
) -> tuple[Extremes | None, Float[Array, "edge state lane"]]:
    """Integrate from rest over a grid of so many steps; return extremes and all states.

    States are those at the start of every step and at the end. Extremes are those at the
    `watched` places (m), None without any. `slots` is how many loads may be on the beam at once.
    Reverse mode stores one state a chunk.
    """
    chunk = _stepper(rig, traffic, grid, watched, slots)
    lanes, loads = traffic.inertia.shape[1], len(traffic.motions)

    def whole(carry, first):
        state, best = carry
        state, best, states = chunk(state, best, first)
        return (state, best), states

    best = None if watched is None else _nothing_seen(watched.shape[0], loads, lanes)
    rest = jnp.zeros((rig.states, lanes))
    firsts = jnp.arange(0, steps, CHUNK)
    (state, best), states = jax.lax.scan(jax.checkpoint(whole), (rest, best), firsts)
    states = jax.lax.collapse(states, 0, 2)[:steps]
    return best, jnp.concatenate([states, state[None]])


def march(
    rig: Rig, traffic: Traffic, grid: Grid, watched: Float[Array, " sensor"], *, slots: int
) -> Extremes:
    """Integrate from rest over a grid, keeping only extremes at the `watched` places (m).

    The loop runs as long as it must, and ends early when the energy left after the last exit
    cannot raise any peak. `slots` is how many loads may be on the beam at once. Forward mode only.
    """
    chunk = _stepper(rig, traffic, grid, watched, slots)
    flexibility = _flexibility(rig, watched)
    stiffness = rig.stiffness()
    size = 2 * stiffness.shape[0]

    def more(carry):
        _, _, first, going = carry
        return going & (first < grid.total)

    def go(carry):
        state, best, first, _ = carry
        state, best, _ = chunk(state, best, first)
        first = first + CHUNK
        left = grid.steps(first[None])[1][0] >= grid.last_exit
        place, rate = state[0:size:2], state[1:size:2]
        energy = jnp.sum(rate**2, axis=0) + jnp.sum(place * (stiffness @ place), axis=0)
        reach = jnp.sqrt(flexibility[:, None] * energy)
        # A run that has blown up has nothing more to show.
        over = jnp.all((reach < best.score) | ~jnp.isfinite(energy))
        return state, best, first, ~(left & over)

    lanes, loads = traffic.inertia.shape[1], len(traffic.motions)
    best = _nothing_seen(watched.shape[0], loads, lanes)
    start = (jnp.zeros((rig.states, lanes)), best, jnp.zeros((), int), jnp.ones((), bool))
    return jax.lax.while_loop(more, go, start)[1]


def _flexibility(rig: Rig, watched):
    """Static deflection at each place under a unit force there: bounds |w|^2 by the energy."""
    rows = rig.shapes(watched, (0,))[0]
    return jnp.sum(rows * jnp.linalg.solve(rig.stiffness(), rows.T).T, axis=-1)
