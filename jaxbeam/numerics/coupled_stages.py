"""Flows of a plant that changes in time only by a few forces: a beam under travelling masses.

    x' = A x + B u + E F(t) f,      f = V(t) x + S(t) u - D(t) f

A, B and E, the directions in which forces act, are constant; f are a few numbers, as the contact
forces. Within a stretch F f and u are polynomials through their values at the Gauss nodes, to which
the constant part answers exactly, with its cost (`answers`); demanding the law of f at the nodes
leaves one small linear system a stretch. So what bounds the length of a stretch is not how fast
the constant part is, but how fast f and the wanted u change; in a plant with lags much faster than
that, u is no polynomial, and `flows` are right with longer stretches.
"""

import functools
import math
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.numerics.batched_linalg import solve_any
from jaxbeam.numerics.intervals import Commands, Inputs, Square, transposed
from jaxbeam.numerics.stages import NODES, STAGES, Flow, on_commands

TERMS = 12  # of the series for the shortest stretches


class Plant(eqx.Module):
    """The constant part of a plant; see the module."""

    A: Square
    B: Inputs
    E: Float[Array, "state direction"]


class Coupling(eqx.Module):
    """What changes in time; see the module: F, V, S and D."""

    shape: Float[Array, "*time direction force"]
    rows: Float[Array, "*time force state"]
    direct: Float[Array, "*time force input"]
    back: Float[Array, "*time force force"]


class Answers(eqx.Module):
    """What the constant part does over a stretch under inputs given at its Gauss nodes.

    `inner` and `end` take (x, commands, directed forces) to the state at the nodes and at the end,
    `toll` is what they cost. Commands and forces are ordered by node. What the state at
    a node is made of lies together, as contact laws sum it.
    """

    inner: Float[Array, "*length stage whole state"]
    end: Float[Array, "*length state whole"]
    toll: Float[Array, "*length whole whole"]


def answers(plant: Plant, Q: Square, length: Float[Array, ""], halvings: int) -> Answers:
    """Answers for stretches of a length (s), of half of it, and so on, the longest first.

    Inputs are first taken as polynomials sum_p c_p s^p / p! of the share s of the stretch that is
    over. For the shortest stretch a Taylor series gives the answers; then they are doubled.
    """
    inputs = jnp.concatenate([plant.B, plant.E], axis=1)
    states, count = inputs.shape
    fractions = np.append(NODES, 1.0)
    shortest = length / 2**halvings
    drift, pushes = _series(plant.A * shortest, inputs, fractions)
    # To the nodes of the shortest stretch, from its start.
    powers = fractions[:, None] ** np.arange(1, STAGES + 1)
    inner = shortest * powers[:STAGES, :, None, None] * pushes[:STAGES]
    inner = jnp.concatenate([drift[:STAGES], _flat(inner)], axis=2)
    quadrature = (np.polynomial.legendre.leggauss(STAGES)[1] / 2)[:, None, None]
    cost = jnp.tensordot(transposed(inner), quadrature * (Q @ inner), ((0, 2), (0, 1)))

    def doubled(carry, _):
        drift, pushes, cost, span = carry
        after = _doubled(drift, pushes), _doubled_cost(drift[-1], span * pushes[-1], cost, count)
        return (*after[0], after[1], 2 * span), carry

    start = (drift, pushes, shortest * cost, shortest)
    last, before = jax.lax.scan(doubled, start, length=halvings)
    drift, pushes, cost, span = jax.tree.map(
        lambda few, one: jnp.concatenate([few, one[None]])[::-1], before, last
    )
    # From coefficients to values at the nodes, commands first.
    lagrange = _lagrange() * np.array([math.factorial(p) for p in range(STAGES)])  # node, power
    local = lagrange * powers[:, None]  # fraction, node, power: over each fraction by itself
    pushed = jnp.einsum("cqp,lcpik->lciqk", local, pushes) * span[:, None, None, None, None]
    whole = jnp.concatenate([drift, _ordered(pushed, plant)], axis=3)
    mixed = cost[:, :states, states:].reshape(-1, states, STAGES, count)
    mixed = _ordered(jnp.einsum("qp,lipk->liqk", lagrange, mixed), plant)
    both = cost[:, states:, states:].reshape(-1, STAGES, count, STAGES, count)
    both = jnp.einsum("qp,lpkxj->lqkxj", lagrange, both)
    both = _ordered(jnp.einsum("qx,lpkxj->lpkqj", lagrange, both), plant)
    both = _ordered(jnp.moveaxis(both, (1, 2), (-2, -1)), plant)
    top = jnp.concatenate([cost[:, :states, :states], mixed], axis=2)
    below = jnp.concatenate([transposed(mixed), both], axis=2)
    return Answers(
        transposed(whole[:, :STAGES]), whole[:, -1], jnp.concatenate([top, below], axis=1)
    )


def coupled_flows(
    plant: Plant,
    answer: Answers,
    coupling: Coupling,
    R: Commands,
    length: Float[Array, ""],
) -> Flow:
    """Flows over stretches of one length (s), from the coupling (stretch, stage) at their nodes."""
    states, inputs = plant.B.shape
    known = states + STAGES * inputs  # the states at the start and the commands
    stretches, forces = coupling.rows.shape[0], coupling.rows.shape[2]
    size = STAGES * forces
    # What the law of f sees, of what is known and of f itself. Stretches come last, for small sums.
    shape = jnp.moveaxis(coupling.shape, 0, -1)
    seen = jnp.einsum("cwi,scri->cwrs", answer.inner, coupling.rows)
    direct = jnp.moveaxis(coupling.direct, 0, -1).swapaxes(1, 2)  # stage, input, force, stretch
    at_once = np.eye(STAGES)[:, :, None, None, None] * direct[:, None]
    right = seen[:, :known].at[:, states:].add(at_once.reshape(STAGES, -1, forces, stretches))
    right = right.swapaxes(1, 2).reshape(size, known, stretches)
    felt = seen[:, known:].reshape(STAGES, STAGES, -1, forces, stretches)
    felt = _summed(felt[:, :, :, :, None] * shape[:, :, None], 2).swapaxes(1, 2)
    back = np.eye(forces)[:, :, None] + jnp.moveaxis(coupling.back, 0, -1)
    law = np.eye(STAGES)[:, None, :, None, None] * back[:, :, None] - felt
    force = jax.vmap(solve_any, -1)(law.reshape(size, size, stretches), right)
    # What the forces do to the end, what they cost with what is known, and by themselves.
    table = jnp.concatenate([answer.end, answer.toll])[:, known:]
    table = table.reshape(-1, STAGES, shape.shape[1])
    table = jnp.einsum("wqd,qdts->wqts", table, shape).reshape(-1, size, stretches)
    directed = table[states + known :].reshape(STAGES, -1, size, stretches)
    own = _summed(directed[:, :, None] * shape[:, :, :, None], 1).reshape(size, size, stretches)
    push, mixed, own = (
        jnp.moveaxis(part, -1, 0) for part in (table[:states], table[states : states + known], own)
    )
    end = answer.end[:, :known] + push @ force
    spent = jnp.pad(on_commands(R, length), (states, 0))
    turn = transposed(force) @ (transposed(mixed) + own @ force / 2)
    toll = answer.toll[:known, :known] + spent + turn + transposed(turn)
    return Flow(end[..., :states], end[..., states:], toll)


def flows_of_kind(
    plant: Plant,
    every: Answers,
    kind: Int[Array, ""],
    coupling: Coupling,
    R: Commands,
    length: Float[Array, ""],
) -> Flow:
    """Those over stretches of one of the lengths that there are answers for."""
    answer = jax.tree.map(lambda part: jax.lax.dynamic_index_in_dim(part, kind, 0, False), every)
    return coupled_flows(plant, answer, coupling, R, length)


def law_solved(coupling: Coupling) -> Float[Array, "stretch stage force both"]:
    """Rows that take state and command to f, its law being solved."""
    law = jnp.eye(coupling.back.shape[-1]) + coupling.back
    answer = jnp.concatenate([coupling.rows, coupling.direct], axis=3)
    return jax.vmap(jax.vmap(solve_any))(law, answer)


def _summed(terms, axis):
    """A short sum, spelt out: it is not worth a loop."""
    return functools.reduce(operator.add, jnp.unstack(terms, axis=axis))


def _flat(pushes):
    """Pushes (fraction, power, state, input) as columns (fraction, state, power and input)."""
    ordered = jnp.moveaxis(pushes, 1, 2)
    return ordered.reshape(*ordered.shape[:2], -1)


def _ordered(columns, plant: Plant):
    """Columns (..., node, input) in one row, the commands of all nodes before the forces."""
    inputs = plant.B.shape[1]
    commands, forces = columns[..., :inputs], columns[..., inputs:]
    shape = (*columns.shape[:-2], -1)
    return jnp.concatenate([commands.reshape(shape), forces.reshape(shape)], axis=-1)


def _series(x, inputs, fractions):
    """exp(c x), and phi_1 ... phi of c x times the inputs, for fractions c of a small x."""
    states = x.shape[0]
    columns = jnp.concatenate([jnp.eye(states), inputs], axis=1)
    rows = [columns]
    for _ in range(TERMS - 1):
        rows.append(x @ rows[-1])
    powers, terms = jnp.stack(rows), np.arange(TERMS)
    shares = fractions[:, None] ** terms
    orders = np.arange(STAGES + 1)[:, None] + terms
    weights = shares[:, None] / np.vectorize(math.factorial)(orders).astype(float)
    drift = jnp.tensordot(weights[:, 0], powers[:, :, :states], axes=1)
    return drift, jnp.tensordot(weights[:, 1:], powers[:, :, states:], axes=1)


def _doubled(drift, pushes):
    """The exponentials, and the phi functions (fraction, phi, state, input), of twice as much."""
    halves = 0.5 ** np.arange(1, STAGES + 1)
    after = drift[:, None] @ pushes + jnp.einsum("pq,cqik->cpik", _second().T, pushes)
    return drift @ drift, after * halves[:, None, None]


def _doubled_cost(drift, pushes, cost, count):
    """What two stretches cost, for inputs given as coefficients over both."""
    states = drift.shape[0]
    first = 0.5 ** np.arange(STAGES)
    early = _columns(pushes * first[:, None, None])
    scale = np.append(np.ones(states), np.repeat(first, count))
    later = jnp.asarray(_second() * first)  # coefficient within the second, over both

    def onward(columns):
        """Columns by coefficients within the second stretch, as those over both."""
        split = columns.reshape(-1, STAGES, count)
        return jnp.einsum("ipk,pq->iqk", split, later).reshape(columns.shape)

    mixed, both = cost[:states, states:], cost[states:, states:]
    across = onward(mixed)
    carried = cost[:states, :states] @ jnp.concatenate([drift, early], axis=1)
    corner = drift.T @ carried[:, :states]
    beside = drift.T @ (carried[:, states:] + across)
    crossed = early.T @ (carried[:, states:] / 2 + across)
    rest = onward(onward(both).T) + crossed + crossed.T
    top = jnp.concatenate([corner, beside], axis=1)
    return cost * scale * scale[:, None] + jnp.concatenate(
        [top, jnp.concatenate([beside.T, rest], axis=1)]
    )


def _columns(pushes):
    """Pushes (power, state, input) as columns (state, power and input)."""
    return jnp.moveaxis(pushes, 0, 1).reshape(pushes.shape[1], -1)


@functools.cache
def _second() -> np.ndarray:
    """Weights 1 / (q - p)!: coefficient q of (1 + s)^q / q! in s^p / p!."""
    rows = range(STAGES)
    return np.array([[1 / math.factorial(q - p) if q >= p else 0.0 for q in rows] for p in rows])


@functools.cache
def _lagrange() -> np.ndarray:
    """Monomial coefficients (node, power) of the Lagrange polynomials through the Gauss nodes."""
    return np.linalg.inv(NODES[:, None] ** np.arange(STAGES)).T
