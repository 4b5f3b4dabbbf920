"""Time steps: contact forces at the Gauss nodes, and the state at the end."""

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.step_maps import AffineMap, contact_maps, step_maps
from jaxbeam.integrator.step_matrices import StepMatrices, advances_by_forces
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles
from jaxbeam.model.contact import ModalCompliance, solve_contact_forces
from jaxbeam.numerics.batched_linalg import matvec
from jaxbeam.runtime.arrays import Array, any_jax, cond, is_jax, is_known, scan, vmap, xp

MANY_RUNS = 16  # of a batch that NumPy advances by its contact forces, as maps of each take longer


@jax.named_scope("collocation")
def contact_forces(matrices: StepMatrices, inertia, weight, state):
    """Contact forces (row, batch) in N of a step of plain wheels from a state."""

    if matrices.contact_response is None:
        return -weight

    def forces():
        right = weight + inertia * matvec(matrices.contact_response, state)
        compliance = matrices.contact_compliance
        if isinstance(compliance, ModalCompliance):
            by_run = vmap(lambda m, d: compliance.solve(m[:, None], d[:, None])[:, 0], -1, -1)
            return by_run(inertia, right)
        return solve_contact_forces(compliance, inertia, right)

    # Without loads on the beam there is nothing to solve, which halves the cost of such steps.
    return cond(matrices.loaded, forces, lambda: xp.zeros_like(weight))


@jax.named_scope("propagation")
def advance(state, step: StepInput):
    """One step of plain wheels: state at its end, and (state at its start, contact forces)."""
    matrices = step.matrices
    forces = contact_forces(matrices, step.inertia, step.weight, state)
    after = free_response(matrices.transition, state) + matvec(matrices.force_response, forces)
    return after, (state, forces)


def free_response(transition: Float[Array, "block side side"], state: Float[Array, "state batch"]):
    """State at the end of a step without forces and commands."""
    blocks, side, _ = transition.shape
    state_blocks = state.reshape(blocks, side, -1)
    if side == 2:
        next_state = (
            transition[:, :, :1] * state_blocks[:, :1] + transition[:, :, 1:] * state_blocks[:, 1:]
        )
    else:
        next_state = transition @ state_blocks
    return next_state.reshape(state.shape)


def advance_free(transitions: Float[Array, "step block side side"], state):
    """Steps without forces and commands: final state, and state before each step."""
    return scan(lambda state, one: (free_response(one, state), state), state, transitions)


def advance_unforced(step: StepInput, state, vehicles: Vehicles | None):
    """Steps without commands: final state, state before each step, and contact forces.

    As one map a step, whose systems are solved at once. Plain wheels of a compiled batch, whose
    runs share the matrices but not the maps, and of many known states by their contact forces.
    """
    shared = is_jax(step.matrices.transition) or is_known(state) and state.shape[1] >= MANY_RUNS
    if vehicles is None and shared and state.shape[1] > 1:
        final_state, (states, forces) = scan(advance, state, step)
        return final_state, states, forces
    if vehicles is None and advances_by_forces(step.matrices.state_count):
        return _advance_by_forces(step, state)
    maps = step_maps(step, vehicles)
    states = _states_of_maps(maps.states, state.T)
    states, forces = (xp.swapaxes(part, 1, 2) for part in (states, maps.forces(states[:-1])))
    return states[-1], states[:-1], forces


def _states_of_maps(of_states: AffineMap, start: Float[Array, "batch state"]):
    """States (boundary, batch, state) of steps that are affine maps, from the first one."""
    if any_jax(of_states, start):

        def advance(state, one):
            return one(state), state

        last, states = scan(advance, xp.asarray(start), of_states)
        return xp.concatenate([states, last[None]])
    states = np.empty((len(of_states.offset) + 1, *of_states.offset.shape[1:]))
    states[0] = start
    if of_states.linear.shape[1] > 1:
        for i in range(len(states) - 1):
            states[i + 1] = of_states.at(i, states[i])
        return states
    # Written into place: of small matrices, calls take longer than products.
    before = states[0]
    steps = zip(states[1:], of_states.linear[:, 0].mT, of_states.offset, strict=True)
    for after, linear, offset in steps:
        np.matmul(before, linear, out=after)
        after += offset
        before = after
    return states


def _advance_by_forces(step: StepInput, state):
    """Steps of plain wheels by the contact forces, without matrices of all states."""
    of_columns, of_one = contact_maps(step)
    of_forces = AffineMap(of_columns, of_one[..., 0])
    matrices = step.matrices
    inputs = matrices.transition, matrices.force_response, of_forces
    if any_jax(inputs, state):

        def advance(state, one):
            transition, response, force_map = one
            forces = force_map(state.T).T
            return free_response(transition, state) + response @ forces, (state, forces)

        final_state, (states, forces) = scan(advance, state, inputs)
        return final_state, states, forces
    blocks, side = matrices.transition.shape[1:3]
    states = np.empty((len(of_forces.offset) + 1, *state.T.shape))
    states[0] = state.T
    forces = np.empty(of_forces.offset.shape[:1] + states.shape[1:2] + of_forces.offset.shape[2:])
    by_block = states.reshape(*states.shape[:2], blocks, side)
    for i, (transition, response) in enumerate(
        zip(matrices.transition, matrices.force_response, strict=True)
    ):
        forces[i] = of_forces.at(i, states[i])
        if side == 2:
            free = transition[:, :, 0] * by_block[i, :, :, :1]
            by_block[i + 1] = free + transition[:, :, 1] * by_block[i, :, :, 1:]
        else:
            by_block[i + 1] = (transition @ by_block[i, ..., None])[..., 0]
        states[i + 1] += forces[i] @ response.T
    states, forces = np.swapaxes(states, 1, 2), np.swapaxes(forces, 1, 2)
    return states[-1], states[:-1], forces
