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

from jaxbeam.integrator.step_matrices import Tables
from jaxbeam.model.contact import solve_contact
from jaxbeam.numerics.batched_linalg import MAX_UNROLLED_TERMS, matvec, solve_small

KEPT = "steps"  # states and forces in rows of steps, which reverse mode need not work out again


@jax.named_scope("collocation")
def contact(tables: Tables, inertia, weight, state, commands):
    """Contact forces (row, lane) of a step from this state under these commands, if any."""

    def pressed():
        felt = matvec(tables.respond, state)
        if commands is not None:
            felt = felt + tables.commands.respond @ commands
        return solve_contact(tables.gains, inertia, weight + inertia * felt)

    # Between loads and after the last there is nothing to solve, which saves half of such steps.
    return jax.lax.cond(tables.active, pressed, lambda: jnp.zeros_like(weight))


@jax.named_scope("propagation")
def advance(state, step):
    """One step of all lanes: the contact forces at the nodes, and the state at the end."""
    tables, inertia, weight, commands = step
    forces = contact(tables, inertia, weight, state, commands)
    after = drifted(tables.drift, state) + matvec(tables.push, forces)
    if commands is not None:
        after = after + tables.commands.push @ commands
    return after, (state, forces)


def drifted(drift: Float[Array, "block side side"], state: Float[Array, "state lane"]):
    """The state at the end of a step without forces."""
    blocks, side, _ = drift.shape
    split = state.reshape(blocks, side, -1)
    if side == 2:
        after = drift[:, :, :1] * split[:, :1] + drift[:, :, 1:] * split[:, 1:]
    else:
        after = drift @ split
    return after.reshape(state.shape)


@jax.custom_jvp
def undriven(tables: Tables, inertia, weight, state):
    """The state after a row of steps without commands, states before each, and contact forces."""
    after, (states, forces) = jax.lax.scan(advance, state, (tables, inertia, weight, None))
    return after, states, forces


@undriven.defjvp
def _undriven_jvp(given, changes):
    """A step demands f + m (G f + R z) + w = 0 of its forces f, and z' = D z + P f.

    With S = (1 + m G)^-1, their changes are f. = c - S m R z.  and  z.' = D z. - P S m R z. + e.
    """
    tables, inertia, weight, state = given
    moved, heavier, weightier, before = changes
    after, states, forces = undriven(*given)
    states, forces = checkpoint_name(states, KEPT), checkpoint_name(forces, KEPT)
    # Systems of all steps and lanes side by side.
    rows = forces.shape[1]
    matrix = inertia[:, :, None] * tables.gains[..., None] + np.eye(rows)[:, :, None]
    right = jnp.broadcast_to(np.eye(rows)[:, :, None], matrix.shape)
    inverse = jax.vmap(solve_small)(matrix, right)
    stiff = inverse * inertia[:, None]
    back = jnp.einsum("tir,trcl->ticl", tables.push, stiff)
    felt = _each(tables.gains, forces) + _each(tables.respond, states)
    pulled = _each(moved.gains, forces) + _each(moved.respond, states)
    alone = -_sum(inverse, heavier * felt + inertia * pulled + weightier)
    rest = jax.vmap(drifted)(moved.drift, states)
    rest = rest + _each(moved.push, forces) + _each(tables.push, alone)

    def step(change, parts):
        respond, drift, back, rest = parts
        seen = matvec(respond, change)
        return drifted(drift, change) + rest - jnp.sum(back * seen, axis=1), change

    parts = tables.respond, tables.drift, back, rest
    change, changed = jax.lax.scan(step, before, parts)
    forced = alone - _sum(stiff, _each(tables.respond, changed))
    return (after, states, forces), (change, changed, forced)


def _each(matrix: Float[Array, "step row column"], lanes: Float[Array, "step column lane"]):
    return (
        _sum(matrix[..., None], lanes)
        if max(matrix.shape[1:]) <= MAX_UNROLLED_TERMS
        else matrix @ lanes
    )


def _sum(matrix, lanes: Float[Array, "step column lane"]):
    return jnp.sum(matrix * lanes[:, None], axis=2)
