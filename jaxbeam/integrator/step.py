"""Steps one after the other: contact forces at the nodes, and the state at the end.

A row of steps without commands has a derivative of its own. A change of a step is linear in that
of the state before it, so what does not depend on that state is worked out for all steps at once;
what is left to be done one after the other is little, and is little the other way round, too.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.model.contact import solve_contact_forces
from jaxbeam.numerics.batched_linalg import MAX_UNROLLED_TERMS, matvec, solve_small

CHECKPOINT_NAME = (
    "steps"  # states and forces in rows of steps, which reverse mode need not work out again
)


@jax.named_scope("collocation")
def contact_forces(matrices: StepMatrices, inertia, weight, state, commands):
    """Contact forces (row, lane) of a step from this state under these commands, if any."""

    def forces():
        acceleration = matvec(matrices.contact_response, state)
        if commands is not None:
            acceleration = acceleration + matrices.commands.contact_response @ commands
        return solve_contact_forces(
            matrices.contact_compliance, inertia, weight + inertia * acceleration
        )

    # Between loads and after the last there is nothing to solve, which saves half of such steps.
    return jax.lax.cond(matrices.loaded, forces, lambda: jnp.zeros_like(weight))


@jax.named_scope("propagation")
def advance(state, step):
    """One step of all lanes: the contact forces at the nodes, and the state at the end."""
    matrices, inertia, weight, commands = step
    forces = contact_forces(matrices, inertia, weight, state, commands)
    next_state = free_response(matrices.transition, state) + matvec(matrices.force_response, forces)
    if commands is not None:
        next_state = next_state + matrices.commands.input_matrix @ commands
    return next_state, (state, forces)


def free_response(transition: Float[Array, "block side side"], state: Float[Array, "state lane"]):
    """The state at the end of a step without forces."""
    blocks, side, _ = transition.shape
    state_blocks = state.reshape(blocks, side, -1)
    if side == 2:
        next_state = (
            transition[:, :, :1] * state_blocks[:, :1] + transition[:, :, 1:] * state_blocks[:, 1:]
        )
    else:
        next_state = transition @ state_blocks
    return next_state.reshape(state.shape)


@jax.custom_jvp
def advance_unforced(matrices: StepMatrices, inertia, weight, state):
    """The state after a row of steps without commands, states before each, and contact forces."""
    final_state, (states, forces) = jax.lax.scan(advance, state, (matrices, inertia, weight, None))
    return final_state, states, forces


@advance_unforced.defjvp
def _advance_unforced_jvp(primals, tangents):
    """A step demands f + m (G f + R z) + w = 0 of its forces f, and z' = D z + P f.

    With S = (1 + m G)^-1, their changes are f. = c - S m R z.  and  z.' = D z. - P S m R z. + e.
    """
    matrices, inertia, weight, state = primals
    matrix_tangents, inertia_tangent, weight_tangent, state_tangent = tangents
    final_state, states, forces = advance_unforced(*primals)
    states, forces = (
        checkpoint_name(states, CHECKPOINT_NAME),
        checkpoint_name(forces, CHECKPOINT_NAME),
    )
    # Systems of all steps and lanes side by side.
    rows = forces.shape[1]
    matrix = inertia[:, :, None] * matrices.contact_compliance[..., None] + np.eye(rows)[:, :, None]
    identity = jnp.broadcast_to(np.eye(rows)[:, :, None], matrix.shape)
    inverse = jax.vmap(solve_small)(matrix, identity)
    force_feedback = inverse * inertia[:, None]
    state_feedback = jnp.einsum("tir,trcl->ticl", matrices.force_response, force_feedback)
    acceleration = _matvec_of_steps(matrices.contact_compliance, forces) + _matvec_of_steps(
        matrices.contact_response, states
    )
    acceleration_tangent = _matvec_of_steps(
        matrix_tangents.contact_compliance, forces
    ) + _matvec_of_steps(matrix_tangents.contact_response, states)
    free_force_tangent = -_multiply_and_sum(
        inverse, inertia_tangent * acceleration + inertia * acceleration_tangent + weight_tangent
    )
    free_state_tangent = jax.vmap(free_response)(matrix_tangents.transition, states)
    free_state_tangent = (
        free_state_tangent
        + _matvec_of_steps(matrix_tangents.force_response, forces)
        + _matvec_of_steps(matrices.force_response, free_force_tangent)
    )

    def step(change, parts):
        respond, drift, back, rest = parts
        seen = matvec(respond, change)
        return free_response(drift, change) + rest - jnp.sum(back * seen, axis=1), change

    parts = matrices.contact_response, matrices.transition, state_feedback, free_state_tangent
    final_tangent, state_tangents = jax.lax.scan(step, state_tangent, parts)
    force_tangents = free_force_tangent - _multiply_and_sum(
        force_feedback, _matvec_of_steps(matrices.contact_response, state_tangents)
    )
    return (final_state, states, forces), (final_tangent, state_tangents, force_tangents)


def _matvec_of_steps(
    matrix: Float[Array, "step row column"], vectors: Float[Array, "step column lane"]
):
    return (
        _multiply_and_sum(matrix[..., None], vectors)
        if max(matrix.shape[1:]) <= MAX_UNROLLED_TERMS
        else matrix @ vectors
    )


def _multiply_and_sum(matrix, vectors: Float[Array, "step column lane"]):
    return jnp.sum(matrix * vectors[:, None], axis=2)
