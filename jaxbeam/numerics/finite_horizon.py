"""Optimal gains over a finite time, found backward from its end, stretch by stretch.

Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected:

    dP/dt = -P A - A'P - Q + P B R^-1 B'P,     P(end) = F,     K = R^-1 B'P

Stretches come in groups of equal length, a group at a time is worked out.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.numerics import gain_polynomials, native_designs
from jaxbeam.numerics import stages as plain_flows
from jaxbeam.numerics.batched_linalg import (
    each_lane,
    few_lanes,
    in_lanes,
    lanes_of,
    solve_any,
    turned,
)
from jaxbeam.numerics.coupled_stages import Coupling, Plant, answers, flows_of_kind, law_solved
from jaxbeam.numerics.gain_table import GainTable
from jaxbeam.numerics.intervals import Commands, Square
from jaxbeam.numerics.stages import NODES, costs_to_go, flows, on_commands

GROUP = 8  # stretches
# Backward in time P hastens, right before an event, to what the plant from then on demands, and
# rings for a while at twice the frequencies of the modes. So stretches of the last tenth of the
# time since the event before are quartered, those of the tenth before halved, and what the last
# group would last is cut into ever shorter stretches, so often halved.
HALVINGS = 13
FEW = 8  # lanes by C at a time, each with what its own plant does; a cache holds as much
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
    in_time: str = "sequential",
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Gains that minimise x'Fx at the last event plus the integral of x'Qx + u'Ru, and P at edges.

    There are at least so many stretches, and a fine layer, between events (s); F is `terminal`. P
    is carried from stretch to stretch one after the other ("sequential"), the same in C ("native",
    see `native_designs`), or in "parallel" (see `costs_to_go`).

    Raises ValueError if there is no C to be had.
    """
    inputs = R.shape[0]
    still = Plant(jnp.zeros_like(Q), jnp.zeros((Q.shape[0], inputs)), jnp.eye(Q.shape[0]))

    def make(_, R, times, length, kind):
        A, B = jax.vmap(jax.vmap(plant))(times)
        whole = jnp.broadcast_to(still.E, A.shape)
        law = jnp.concatenate([A, B], axis=3)
        return flows(A, B, Q, R, jnp.full(GROUP, length)), whole, law

    return _backward(lambda: None, make, still, events, count, Q, R, terminal, in_time)


def finite_time_coupled(
    plant: Plant,
    changes: Changes,
    events: Float[Array, " event"],
    count: int,
    Q: Square,
    R: Commands,
    terminal: Square,
    in_time: str = "sequential",
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """The same for a plant that changes by a few forces; much faster, see `coupled`."""
    flowing = native_designs.coupled if in_time == "native" else flows_of_kind

    def prepare():
        longest = jnp.diff(events) * (shares(count)[1] * 2.0 ** halvings(count)[0])
        every = jax.vmap(lambda length: answers(plant, Q, length, HALVINGS))(longest)
        return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), every)

    def make(every, R, times, length, kind):
        coupling = changes(times)
        flow = flowing(plant, every, kind, coupling, R, length)
        return flow, coupling.shape, law_solved(coupling)

    return _backward(prepare, make, plant, events, count, Q, R, terminal, in_time)


def _backward(prepare, make, plant, events, count, Q, R, terminal, in_time):
    """Gains and P, from what `make` tells of a group: flows, and what changes at their nodes.

    It is given what `prepare` finds for all groups.
    """
    lacking = native_designs.lacking() if in_time == "native" else None
    if lacking is not None:
        raise ValueError(lacking)
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
    if in_time == "parallel":
        known = prepare()
        parts, shape, law = jax.lax.map(lambda group: make(known, R, *group), groups)
        whole = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), parts)
        costs = costs_to_go(whole, terminal, True)
        first = costs[:-1].reshape(-1, GROUP, *Q.shape)
        grouped = jnp.concatenate([first, costs[GROUP::GROUP, None]], axis=1)
        given = plant, shape, law, grouped, groups[1], Q, inverse
        axes = None, 0, 0, 0, 0, None, None
        pieces = jax.vmap(functools.partial(in_lanes, gain_polynomials.pieces), axes)(*given)
    else:
        by_hand = in_time == "native"
        given = prepare, make, plant, groups, Q, R, inverse, terminal
        costs, pieces = in_lanes(_few, by_hand, *given)
        costs = jnp.concatenate([costs.reshape(-1, *Q.shape), terminal[None]])
    inner = events[:-1, None] + spans[:, None] * edges[:-1]
    marks = jnp.append(inner.reshape(-1), events[-1])
    marks = (marks - marks[0]) / (marks[-1] - marks[0])
    return GainTable(marks, pieces.reshape(-1, *pieces.shape[2:])), costs


def _few(by_hand, prepare, make, plant, groups, *rest):
    """`_swept`, so many lanes at a time as caches hold, if these have answers of their own."""
    given = by_hand, prepare, make, plant, groups, *rest
    if not by_hand or lanes_of(prepare, groups) == 1:
        return _swept(*given)
    return few_lanes(_swept, FEW, *given)


def _swept(by_hand, prepare, make, plant, groups, Q, R, inverse, terminal):
    """P at the starts of stretches and polynomials of the gain, of all groups, in lanes."""
    carried = native_designs.carried if by_hand else plain_flows.carried
    fitted = native_designs.pieces if by_hand else gain_polynomials.pieces
    known = each_lane(lambda prepare: prepare(), prepare)
    free = jnp.zeros((*R.shape[:2], 1))  # commands, so that lanes with other R share the flows

    def back(cost, group):
        length = group[1]
        parts, shape, law = each_lane(lambda make, *rest: make(*rest), make, known, free, *group)
        costs = carried(parts, each_lane(on_commands, R, length), cost)
        pieces = fitted(plant, shape, law, costs, length, Q, inverse)
        return (costs[0] + turned(costs[0])) / 2, (costs[:-1], pieces)

    given = prepare, make, plant, groups, Q, R, terminal
    wide = jnp.broadcast_to(terminal, (*terminal.shape[:2], lanes_of(given)))
    return jax.lax.scan(back, wide, groups, reverse=True)[1]
