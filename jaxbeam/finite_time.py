"""Optimal gains over a finite time, found backward from its end, stretch by stretch.

Eqs (3.3) to (3.9) of the thesis, (3.8) with its sign corrected:

    dP/dt = -P A - A'P - Q + P B R^-1 B'P,     P(end) = F,     K = R^-1 B'P

Stretches come in groups of equal length, a group at a time is worked out.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.coupled import Coupling, Plant, answers, coupled_flows, law_solved
from jaxbeam.flows import NODES, costs_to_go, flows
from jaxbeam.gain_table import GainTable, from_nodes, polynomials
from jaxbeam.small import solve_any
from jaxbeam.stretches import Commands, Square, symmetric

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
    parallel: bool = False,
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Gains that minimise x'Fx at the last event plus the integral of x'Qx + u'Ru, and P at edges.

    There are at least so many stretches, and a fine layer, between events (s); F is `terminal`. P
    is carried from stretch to stretch one after the other, or in `parallel` (see `costs_to_go`).
    """
    every = jax.vmap(jax.vmap(plant))
    inputs = R.shape[0]
    still = Plant(jnp.zeros_like(Q), jnp.zeros((Q.shape[0], inputs)), jnp.eye(Q.shape[0]))

    def make(times, length, kind):
        A, B = every(times)
        whole = jnp.broadcast_to(still.E, A.shape)
        law = jnp.concatenate([A, B], axis=3)
        return flows(A, B, Q, R, jnp.full(GROUP, length)), whole, law

    return _backward(make, still, events, count, Q, R, terminal, parallel)


def finite_time_coupled(
    plant: Plant,
    changes: Changes,
    events: Float[Array, " event"],
    count: int,
    Q: Square,
    R: Commands,
    terminal: Square,
    parallel: bool = False,
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """The same for a plant that changes by a few forces; much faster, see `coupled`."""
    longest = jnp.diff(events) * (shares(count)[1] * 2.0 ** halvings(count)[0])
    every = jax.vmap(lambda length: answers(plant, Q, length, HALVINGS))(longest)
    every = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), every)

    def make(times, length, kind):
        answer = jax.tree.map(
            lambda part: jax.lax.dynamic_index_in_dim(part, kind, 0, False), every
        )
        coupling = changes(times)
        flow = coupled_flows(plant, answer, coupling, R, length)
        return flow, coupling.shape, law_solved(coupling)

    return _backward(make, plant, events, count, Q, R, terminal, parallel)


def _backward(make, plant, events, count, Q, R, terminal, parallel):
    """Gains and P, from what `make` tells of a group: flows, and what changes at their nodes."""
    edges, spans = shares(count), jnp.diff(events)
    steps = np.diff(edges).reshape(-1, GROUP)
    within = edges[:-1].reshape(-1, GROUP)[:, :, None] + steps[:, :, None] * NODES
    times = events[:-1, None, None, None] + spans[:, None, None, None] * within
    lengths = spans[:, None] * steps[:, 0]
    kinds = np.arange(spans.size)[:, None] * (HALVINGS + 1) + halvings(count)
    given = times, lengths, jnp.asarray(kinds)
    groups = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), given)
    inverse = solve_any(R, jnp.eye(R.shape[0]))

    def gains(shape, law, costs, length):
        return _pieces(plant, shape, law, costs, length, Q, inverse)

    if parallel:
        parts, shape, law = jax.lax.map(lambda group: make(*group), groups)
        whole = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), parts)
        costs = costs_to_go(whole, terminal, True)
        first = costs[:-1].reshape(-1, GROUP, *Q.shape)
        grouped = jnp.concatenate([first, costs[GROUP::GROUP, None]], axis=1)
        pieces = jax.lax.map(lambda given: gains(*given), (shape, law, grouped, groups[1]))
    else:

        def back(cost, group):
            part, shape, law = make(*group)
            costs = costs_to_go(part, cost)
            return symmetric(costs[0]), (costs[:-1], gains(shape, law, costs, group[1]))

        _, (costs, pieces) = jax.lax.scan(back, terminal, groups, reverse=True)
        costs = jnp.concatenate([costs.reshape(-1, *Q.shape), terminal[None]])
    inner = events[:-1, None] + spans[:, None] * edges[:-1]
    marks = jnp.append(inner.reshape(-1), events[-1])
    marks = (marks - marks[0]) / (marks[-1] - marks[0])
    return GainTable(marks, pieces.reshape(-1, *pieces.shape[2:])), costs


def _pieces(plant, shape, law, costs, length, Q, inverse):
    """Polynomials of the gain over a group of stretches, from P at its edges.

    The rate of the state is that by the constant part of the `plant`, plus E shape law (x, u); what
    changes is known at the nodes, and wanted, with its rates, at the edges.
    """
    push, law = from_nodes(plant.E @ shape), from_nodes(law)  # edge, rate, ...

    def at_edge(push, law, cost):
        return _gains(plant, push, law, cost, length, Q, inverse)

    gains = jax.vmap(at_edge)(push, law, costs)
    return polynomials(gains[:-1], gains[1:])


def _gains(plant, push, law, cost, length, Q, inverse):
    """The gain, its rate and the rate of that, by share of a stretch.

    A = plant.A + push law_x and B = plant.B + push law_u, with rates. P is never differentiated as
    a whole, but only what it does to a few columns.
    """
    states, inputs = plant.B.shape
    (W, W_1, W_2), (V, V_1, _), (D, D_1, D_2) = push, law[..., :states], law[..., states:]
    B, B_1 = plant.B + W @ D, W_1 @ D + W @ D_1
    B_2 = W_2 @ D + 2 * (W_1 @ D_1) + W @ D_2
    once, turned = plant.A @ B + W @ (V @ B), W_1 @ (V @ B) + W @ (V_1 @ B)  # A B, A_1 B
    more = jnp.concatenate([B_1, once], axis=1)
    twice = plant.A @ more + W @ (V @ more)
    few = jnp.concatenate([B, more], axis=1)
    held = cost @ jnp.concatenate([few, once, twice, turned, B_2], axis=1)
    seen, far = held[:, :inputs], 3 * inputs
    back = plant.A.T @ held[:, :far] + V.T @ (W.T @ held[:, :far])
    spent = seen @ (inverse @ (seen.T @ few))
    falls = length * (spent - held[:, far : 2 * far] - back - Q @ few)
    faster = falls[:, :inputs] + held[:, inputs : 2 * inputs]  # the rate of P B
    fall = falls[:, :inputs]
    back = plant.A.T @ fall + V.T @ (W.T @ fall + W_1.T @ seen) + V_1.T @ (W.T @ seen)
    mixed = faster @ (inverse @ (seen.T @ B)) + seen @ (inverse @ (faster.T @ B))
    bends = length * (mixed - falls[:, 2 * inputs :] - held[:, -2 * inputs : -inputs] - back)
    last = held[:, -inputs:] + 2 * falls[:, inputs : 2 * inputs] + bends
    return inverse @ jnp.stack([seen.T, faster.T, last.T])
