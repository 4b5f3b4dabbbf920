"""Discrete plant and quadratic cost over an interval, under commands polynomial in time.

The commands are the polynomials through their values U at the Gauss nodes of the interval:

    x1 = Phi x0 + Gamma U,     integral of x'Qx + u'Ru = (x0, U)' W (x0, U)

Optimal control minimises over U, one interval after the other, backward in time: for a cost P at
the end, that at the start is the minimum of W + (Phi, Gamma)' P (Phi, Gamma) over U.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.numerics.batched_linalg import batch_size_of, matmul, solve_batch, transpose
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.matrices import InputWeight, Square, symmetric_part
from jaxbeam.numerics.polynomials import gauss_nodes, gauss_weights, integration_matrix
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

NODE_COUNT = 6  # Gauss nodes of an interval; order 12
GAUSS_NODES = gauss_nodes(NODE_COUNT)


class Stage(Module):
    """Transition Phi, input matrix Gamma and cost matrix W of an interval; see the module."""

    transition: Float[Array, "*batch state state"]
    input_matrix: Float[Array, "*batch state node_input"]
    cost: Float[Array, "*batch state_and_input state_and_input"]


def collocated_stages(
    A: Float[Array, "interval node state state"],
    B: Float[Array, "interval node state input"],
    Q: Square,
    R: InputWeight,
    lengths: Float[Array, " interval"],
) -> Stage:
    """Stages of intervals of given lengths (s), for a plant given at their `GAUSS_NODES`.

    Collocation of x' = A x + B u, with the cost by Gauss's rule, equals collocation of the
    equations of optimal state and costate, of order 12 (Hager, Numer. Math. 87, 2000). The phase of
    the fastest mode should advance by at most about 2 rad in an interval.
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


def riccati_recursion(
    stages: Stage,
    command_cost: Float[Array, "#node_input #node_input #batch"],
    terminal_cost: Float[Array, "state state #batch"],
) -> Float[Array, "breakpoint state state batch"]:
    """P at the start of each of successive intervals and at the end, batch axis last.

    `command_cost` is added to the cost of the commands; so a batch that differs in R alone shares
    its stages.
    """
    states = terminal_cost.shape[0]

    def backward_step(cost, part):
        dynamics, stage_cost = part  # (Phi, Gamma)'
        quadratic_cost = stage_cost + matmul(dynamics, transpose(matmul(dynamics, cost)))
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
    """Stage of a plant with matrices (node, state, ...).

    Unknown are the rates h x'_i at the nodes, with x_i = x0 + sum_j a_ij h x'_j.
    """
    _, size, inputs = B.shape
    A, B, values = length * A, length * B, NODE_COUNT * inputs
    integration_weights = integration_matrix(NODE_COUNT)
    quadrature_weights = gauss_weights(NODE_COUNT)
    rows = NODE_COUNT * size
    state_coupling = integration_weights[:, None, :, None] * A[:, :, None, :]
    input_coupling = np.eye(NODE_COUNT)[:, None, :, None] * B[:, :, None, :]
    right = jnp.concatenate([A, input_coupling.reshape(NODE_COUNT, size, values)], axis=2)
    rates = xp.linalg.solve(
        jnp.eye(rows) - state_coupling.reshape(rows, rows), right.reshape(rows, size + values)
    ).reshape(NODE_COUNT, size, size + values)
    start = np.eye(size, size + values)
    states = start + jnp.tensordot(integration_weights, rates, axes=1)
    end = start + jnp.tensordot(quadrature_weights, rates, axes=1)
    weighted = quadrature_weights[:, None, None] * (Q @ states)
    integrated_cost = symmetric_part(jnp.tensordot(states.mT, weighted, ((0, 2), (0, 1))))
    cost = length * integrated_cost + jnp.pad(command_cost_matrix(R, length), (size, 0))
    return Stage(end[:, :size], end[:, size:], cost)


def command_cost_matrix(
    R: InputWeight, length: Float[Array, ""]
) -> Float[Array, "node_input node_input"]:
    """Cost matrix of the commands over an interval (s); Gauss's rule is exact for their squares."""
    # Over an interval of length zero the commands have no effect; a cost keeps W invertible.
    safe_length = jnp.where(length > 0, length, 1.0)
    return safe_length * jnp.kron(np.diag(gauss_weights(NODE_COUNT)), R)
