"""What a plant does over stretches of time, and what it costs, under commands that are polynomials.

Over a stretch the commands are the polynomials through their values U at its Gauss nodes, and

    x(end) = drift x(start) + push U,
    integral of x'Qx + u'Ru = (x(start), U)' toll (x(start), U)

Optimal control then picks U, one stretch after the other, backward from the end: for a cost P at
the end, that at the start is the least of toll + (drift, push)' P (drift, push) over all U.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.numerics.batched_linalg import (
    in_lanes,
    lanes_of,
    solve_lanes,
    times,
    turned,
)
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import Commands, Square, symmetric, transposed

STAGES = 6  # Gauss nodes of a stretch; order 12
NODES = (np.polynomial.legendre.leggauss(STAGES)[0] + 1) / 2


class Flow(eqx.Module):
    """What a plant does over a stretch, and what it costs; see the module."""

    drift: Float[Array, "*batch state state"]
    push: Float[Array, "*batch state value"]
    toll: Float[Array, "*batch both both"]


def flows(
    A: Float[Array, "stretch stage state state"],
    B: Float[Array, "stretch stage state input"],
    Q: Square,
    R: Commands,
    lengths: Float[Array, " stretch"],
) -> Flow:
    """Flows over stretches of given lengths (s) along a plant known at their Gauss nodes, `NODES`.

    By collocation of x' = A x + B u, the cost by Gauss's rule: together the same as collocation of
    the equations of the optimal state and costate, of order 12 (Hager, Numer. Math. 87, 2000). Fast
    modes should turn by no more than about 2 rad in a stretch.
    """
    scale = balance(A[0, 0])
    matrices, columns = A * scale / scale[:, None], B / scale[:, None]

    def one(part):
        matrix, column, length = part
        return _collocated(matrix, column, length, Q * scale * scale[:, None], R)

    found = jax.lax.map(one, (matrices, columns, lengths), batch_size=16)
    held = jnp.concatenate([scale, jnp.ones(found.push.shape[-1])])
    return Flow(
        drift=found.drift * scale[:, None] / scale,
        push=found.push * scale[:, None],
        toll=found.toll / held / held[:, None],
    )


def costs_to_go(parts: Flow, terminal: Square) -> Float[Array, "edge state state"]:
    """P at the start of each of successive stretches and, last, at the end, where it is given."""
    return in_lanes(carried, parts, jnp.zeros((1, 1)), terminal)


def carried(
    parts: Flow,
    effort: Float[Array, "#value #value #lane"],
    terminal: Float[Array, "state state #lane"],
) -> Float[Array, "edge state state lane"]:
    """P at the start of each of successive stretches and at the end, with lanes as the last axis.

    Commands also cost `effort`, which lanes that share the flows need not share.
    """
    states = terminal.shape[0]

    def back(cost, part):
        across, toll = part
        total = toll + times(across, turned(times(across, cost)))
        mixed = total[states:, :states]
        answer = solve_lanes(total[states:, states:] + effort, mixed)
        cost = total[:states, :states] - times(turned(mixed), answer)
        return cost, cost

    across = jnp.concatenate([parts.drift, parts.push], axis=2).swapaxes(1, 2)
    wide = jnp.broadcast_to(terminal, (states, states, lanes_of(parts, effort, terminal)))
    costs = jax.lax.scan(back, wide, (across, parts.toll), reverse=True)[1]
    return jnp.concatenate([costs, wide[None]])


def _collocated(matrix, column, length, Q, R) -> Flow:
    """The flow of a plant with (stage, state, ...) matrices; unknown are the rates h x'.

    x_i = x(start) + sum_j a_ij h x'_j.
    """
    _, size, inputs = column.shape
    matrix, column, values = length * matrix, length * column, STAGES * inputs
    rows = STAGES * size
    own = _UNTIL[:, None, :, None] * matrix[:, :, None, :]
    # Each node has a command of its own.
    pushed = np.eye(STAGES)[:, None, :, None] * column[:, :, None, :]
    right = jnp.concatenate([matrix, pushed.reshape(STAGES, size, values)], axis=2)
    rates = jnp.linalg.solve(
        jnp.eye(rows) - own.reshape(rows, rows), right.reshape(rows, size + values)
    ).reshape(STAGES, size, size + values)
    start = np.eye(size, size + values)
    states = start + jnp.tensordot(_UNTIL, rates, axes=1)
    end = start + jnp.tensordot(_WEIGHTS, rates, axes=1)
    weighted = _WEIGHTS[:, None, None] * (Q @ states)
    spent = symmetric(jnp.tensordot(transposed(states), weighted, ((0, 2), (0, 1))))
    toll = length * spent + jnp.pad(on_commands(R, length), (size, 0))
    return Flow(end[:, :size], end[:, size:], toll)


def on_commands(R: Commands, length: Float[Array, ""]) -> Float[Array, "value value"]:
    """What the commands cost over a stretch (s); Gauss's rule is exact for their squares."""
    # Where a stretch has no length they do nothing, and must not seem to be free.
    span = jnp.where(length > 0, length, 1.0)
    return span * jnp.kron(np.diag(_WEIGHTS), R)


def _gauss_tableau():
    """Weights a_ij (up to each node) and b_j (over all) of the Gauss collocation method."""
    powers = np.arange(1, STAGES + 1)
    vandermonde = NODES[:, None] ** (powers - 1)
    until = np.linalg.solve(vandermonde.T, (NODES[:, None] ** powers / powers).T).T
    return until, np.linalg.solve(vandermonde.T, 1 / powers)


_UNTIL, _WEIGHTS = _gauss_tableau()
