"""Optimal gains over a finite time, found backward from its end, stretch by stretch.

Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected:

    dP/dt = -P A - A'P - Q + P B R^-1 B'P,     P(end) = F,     K = R^-1 B'P

Stretches come in groups of equal length, a group at a time is worked out.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.numerics.batched_linalg import (
    each_lane,
    in_lanes,
    lanes_of,
    solve_any,
    turned,
)
from jaxbeam.numerics.coupled_stages import Coupling, Plant, answers, flows_of_kind, law_solved
from jaxbeam.numerics.gain_polynomials import pieces
from jaxbeam.numerics.gain_table import GainTable
from jaxbeam.numerics.intervals import Commands, Square
from jaxbeam.numerics.stages import NODES, carried, flows, on_commands

GROUP = 8  # stretches
# Backward in time P hastens, right before an event, to what the plant from then on demands, and
# rings for a while at twice the frequencies of the modes. So stretches of the last tenth of the
# time since the event before are quartered, those of the tenth before halved, and what the last
# group would last is cut into ever shorter stretches, so often halved.
HALVINGS = 13
LAYER = [2, 2, 2, *range(3, HALVINGS + 1), HALVINGS]

# What changes in a plant, at times (s) of any shape.
Changes = Callable[[Float[Array, "..."]], Coupling]
# State matrix and command matrix at a time (s).
Matrices = Callable[[Float[Array, ""]], tuple[Float[Array, "..."], Float[Array, "..."]]]


def halvings(count: int) -> Int[np.ndarray, " group"]:
    """How often the stretches of each group are halved, for at least so many stretches."""
    whole = max(1, -(-count // GROUP))
    tenth = whole // 10
    before = np.repeat([0, 1, 2], [whole - 1 - 2 * tenth, 2 * tenth, 4 * tenth])
    return np.concatenate([before, LAYER])


def shares(count: int) -> Float[np.ndarray, " edge"]:
    """Edges of the stretches between two events, as shares, 0 to 1, of the time between them."""
    lengths = np.repeat(0.5 ** halvings(count), GROUP)
    return np.append(0.0, np.cumsum(lengths) / np.sum(lengths))


def layer(count: int) -> Float[np.ndarray, " edge"]:
    """Edges of the fine layer before an event, as shares of the time since the one before."""
    return 1 - shares(count)[-1 - GROUP * len(LAYER) : -1]


def finite_time(
    plant: Matrices,
    events: Float[Array, " event"],
    count: int,
    Q: Square,
    R: Commands,
    terminal: Square,
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Gains that minimise x'Fx at the last event plus the integral of x'Qx + u'Ru, and P at edges.

    There are at least so many stretches, and a fine layer, between events (s); F is `terminal`.
    """
    inputs = R.shape[0]
    still = Plant(jnp.zeros_like(Q), jnp.zeros((Q.shape[0], inputs)), jnp.eye(Q.shape[0]))

    def make(_, R, times, length, kind):
        A, B = jax.vmap(jax.vmap(plant))(times)
        whole = jnp.broadcast_to(still.E, A.shape)
        law = jnp.concatenate([A, B], axis=3)
        return flows(A, B, Q, R, jnp.full(GROUP, length)), whole, law

    return _backward(lambda: None, make, still, events, count, Q, R, terminal)


def finite_time_coupled(
    plant: Plant,
    changes: Changes,
    events: Float[Array, " event"],
    count: int,
    Q: Square,
    R: Commands,
    terminal: Square,
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """The same for a plant that changes by a few forces; much faster, see `coupled`."""

    def prepare():
        longest = jnp.diff(events) * (shares(count)[1] * 2.0 ** halvings(count)[0])
        every = jax.vmap(lambda length: answers(plant, Q, length, HALVINGS))(longest)
        return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), every)

    def make(every, R, times, length, kind):
        coupling = changes(times)
        flow = flows_of_kind(plant, every, kind, coupling, R, length)
        return flow, coupling.shape, law_solved(coupling)

    return _backward(prepare, make, plant, events, count, Q, R, terminal)


def _backward(prepare, make, plant, events, count, Q, R, terminal):
    """Gains and P, from what `make` tells of a group: flows, and what changes at their nodes.

    It is given what `prepare` finds for all groups.
    """
    edges, spans = shares(count), jnp.diff(events)
    steps = np.diff(edges).reshape(-1, GROUP)
    within = edges[:-1].reshape(-1, GROUP)[:, :, None] + steps[:, :, None] * NODES
    times = events[:-1, None, None, None] + spans[:, None, None, None] * within
    lengths = spans[:, None] * steps[:, 0]
    kinds = np.arange(spans.size)[:, None] * (HALVINGS + 1) + halvings(count)
    given = times, lengths, jnp.asarray(kinds)
    groups = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), given)
    inverse = solve_any(R, jnp.eye(R.shape[0]))
    prepare = eqx.filter_closure_convert(prepare)
    first = jax.tree.map(lambda part: part[0], groups)
    make = eqx.filter_closure_convert(make, eqx.filter_eval_shape(prepare), R, *first)
    costs, found = in_lanes(_swept, prepare, make, plant, groups, Q, R, inverse, terminal)
    costs = jnp.concatenate([costs.reshape(-1, *Q.shape), terminal[None]])
    inner = events[:-1, None] + spans[:, None] * edges[:-1]
    marks = jnp.append(inner.reshape(-1), events[-1])
    marks = (marks - marks[0]) / (marks[-1] - marks[0])
    return GainTable(marks, found.reshape(-1, *found.shape[2:])), costs


def _swept(prepare, make, plant, groups, Q, R, inverse, terminal):
    """P at the starts of stretches and polynomials of the gain, of all groups, in lanes."""
    known = each_lane(lambda prepare: prepare(), prepare)
    free = jnp.zeros((*R.shape[:2], 1))  # commands, so that lanes with other R share the flows

    def back(cost, group):
        length = group[1]
        parts, shape, law = each_lane(lambda make, *rest: make(*rest), make, known, free, *group)
        costs = carried(parts, each_lane(on_commands, R, length), cost)
        found = pieces(plant, shape, law, costs, length, Q, inverse)
        return (costs[0] + turned(costs[0])) / 2, (costs[:-1], found)

    given = prepare, make, plant, groups, Q, R, terminal
    wide = jnp.broadcast_to(terminal, (*terminal.shape[:2], lanes_of(given)))
    return jax.lax.scan(back, wide, groups, reverse=True)[1]
