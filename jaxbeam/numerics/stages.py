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
    batch_axis_last,
    batch_size_of,
    matmul,
    solve_batch,
    transpose,
)
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import InputWeight, Square, matrix_transpose, symmetric_part

NODE_COUNT = 6  # Gauss nodes of a stretch; order 12
GAUSS_NODES = (np.polynomial.legendre.leggauss(NODE_COUNT)[0] + 1) / 2


class Stage(eqx.Module):
    """What a plant does over a stretch, and what it costs; see the module."""

    transition: Float[Array, "*batch state state"]
    input_matrix: Float[Array, "*batch state value"]
    cost: Float[Array, "*batch both both"]


def collocated_stages(
    A: Float[Array, "stretch stage state state"],
    B: Float[Array, "stretch stage state input"],
    Q: Square,
    R: InputWeight,
    lengths: Float[Array, " stretch"],
) -> Stage:
    """Stages of given lengths (s) of a plant known at their Gauss nodes, `GAUSS_NODES`.

    By collocation of x' = A x + B u, the cost by Gauss's rule: together the same as collocation of
    the equations of the optimal state and costate, of order 12 (Hager, Numer. Math. 87, 2000). Fast
    modes should turn by no more than about 2 rad in a stretch.
    """
    scale = balance(A[0, 0])
    scaled_A, scaled_B = A * scale / scale[:, None], B / scale[:, None]

    def collocate(part):
        matrix, column, length = part
        return _collocated_stage(matrix, column, length, Q * scale * scale[:, None], R)

    scaled_stages = jax.lax.map(collocate, (scaled_A, scaled_B, lengths), batch_size=16)
    scale_with_inputs = jnp.concatenate([scale, jnp.ones(scaled_stages.input_matrix.shape[-1])])
    return Stage(
        transition=scaled_stages.transition * scale[:, None] / scale,
        input_matrix=scaled_stages.input_matrix * scale[:, None],
        cost=scaled_stages.cost / scale_with_inputs / scale_with_inputs[:, None],
    )


def costs_to_go(stages: Stage, terminal_cost: Square) -> Float[Array, "edge state state"]:
    """P at the start of each of successive stretches and, last, at the end, where it is given."""
    return batch_axis_last(riccati_recursion, stages, jnp.zeros((1, 1)), terminal_cost)


def riccati_recursion(
    stages: Stage,
    command_cost: Float[Array, "#value #value #lane"],
    terminal_cost: Float[Array, "state state #lane"],
) -> Float[Array, "edge state state lane"]:
    """P at the start of each of successive stretches and at the end, with lanes as the last axis.

    Commands also cost `command_cost`, which lanes that share the flows need not share.
    """
    states = terminal_cost.shape[0]

    def backward_step(cost, part):
        across, stage_cost = part
        quadratic_cost = stage_cost + matmul(across, transpose(matmul(across, cost)))
        cross_cost = quadratic_cost[states:, :states]
        gain = solve_batch(quadratic_cost[states:, states:] + command_cost, cross_cost)
        cost = quadratic_cost[:states, :states] - matmul(transpose(cross_cost), gain)
        return cost, cost

    transition_and_input = jnp.concatenate(
        [stages.transition, stages.input_matrix], axis=2
    ).swapaxes(1, 2)
    batched_terminal_cost = jnp.broadcast_to(
        terminal_cost, (states, states, batch_size_of(stages, command_cost, terminal_cost))
    )
    costs = jax.lax.scan(
        backward_step, batched_terminal_cost, (transition_and_input, stages.cost), reverse=True
    )[1]
    return jnp.concatenate([costs, batched_terminal_cost[None]])


def _collocated_stage(A, B, length, Q, R) -> Stage:
    """The flow of a plant with (stage, state, ...) matrices; unknown are the rates h x'.

    x_i = x(start) + sum_j a_ij h x'_j.
    """
    _, size, inputs = B.shape
    A, B, values = length * A, length * B, NODE_COUNT * inputs
    rows = NODE_COUNT * size
    state_coupling = _INTEGRATION_MATRIX[:, None, :, None] * A[:, :, None, :]
    # Each node has a command of its own.
    input_coupling = np.eye(NODE_COUNT)[:, None, :, None] * B[:, :, None, :]
    right = jnp.concatenate([A, input_coupling.reshape(NODE_COUNT, size, values)], axis=2)
    rates = jnp.linalg.solve(
        jnp.eye(rows) - state_coupling.reshape(rows, rows), right.reshape(rows, size + values)
    ).reshape(NODE_COUNT, size, size + values)
    start = np.eye(size, size + values)
    states = start + jnp.tensordot(_INTEGRATION_MATRIX, rates, axes=1)
    end = start + jnp.tensordot(_QUADRATURE_WEIGHTS, rates, axes=1)
    weighted = _QUADRATURE_WEIGHTS[:, None, None] * (Q @ states)
    integrated_cost = symmetric_part(
        jnp.tensordot(matrix_transpose(states), weighted, ((0, 2), (0, 1)))
    )
    cost = length * integrated_cost + jnp.pad(command_cost_matrix(R, length), (size, 0))
    return Stage(end[:, :size], end[:, size:], cost)


def command_cost_matrix(R: InputWeight, length: Float[Array, ""]) -> Float[Array, "value value"]:
    """What the commands cost over a stretch (s); Gauss's rule is exact for their squares."""
    # Where a stretch has no length they do nothing, and must not seem to be free.
    safe_length = jnp.where(length > 0, length, 1.0)
    return safe_length * jnp.kron(np.diag(_QUADRATURE_WEIGHTS), R)


def _gauss_tableau():
    """Weights a_ij (up to each node) and b_j (over all) of the Gauss collocation method."""
    powers = np.arange(1, NODE_COUNT + 1)
    vandermonde = GAUSS_NODES[:, None] ** (powers - 1)
    integration_matrix = np.linalg.solve(
        vandermonde.T, (GAUSS_NODES[:, None] ** powers / powers).T
    ).T
    return integration_matrix, np.linalg.solve(vandermonde.T, 1 / powers)


_INTEGRATION_MATRIX, _QUADRATURE_WEIGHTS = _gauss_tableau()
