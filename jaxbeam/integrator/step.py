"""Time steps: contact forces at the Gauss nodes, and the state at the end.

A sequence of steps without commands has its own derivative rule. The tangent of a step is linear in
that of the state before it; all other terms are computed for all steps at once, so that little
remains to be done step by step, in forward and in reverse mode.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Float

from jaxbeam.integrator.step_matrices import StepMatrices, advances_by_forces
from jaxbeam.integrator.vehicles.known_maps import known_forces, known_state_maps
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles
from jaxbeam.model.contact import ModalCompliance, solve_contact_forces
from jaxbeam.numerics.batched_linalg import MAX_UNROLLED_TERMS, matvec, solve_small
from jaxbeam.runtime.arrays import Array, any_jax, cond, custom_jvp, scan, vmap, xp

CHECKPOINT_NAME = "steps"  # states and contact forces that are saved for the reverse pass


@jax.named_scope("collocation")
def contact_forces(matrices: StepMatrices, inertia, weight, state, commands):
    """Contact forces (row, batch) in N of a step from a state, under commands if given."""

    if matrices.contact_response is None:
        return -weight

    def forces():
        acceleration = matvec(matrices.contact_response, state)
        if commands is not None:
            acceleration = acceleration + matrices.commands.contact_response @ commands
        right = weight + inertia * acceleration
        compliance = matrices.contact_compliance
        if isinstance(compliance, ModalCompliance):
            by_run = vmap(lambda m, d: compliance.solve(m[:, None], d[:, None])[:, 0], -1, -1)
            return by_run(inertia, right)
        return solve_contact_forces(compliance, inertia, right)

    # Without loads on the beam there is nothing to solve, which halves the cost of such steps.
    return cond(matrices.loaded, forces, lambda: xp.zeros_like(weight))


@jax.named_scope("propagation")
def advance(state, step: StepInput, commands=None, vehicles: Vehicles | None = None):
    """One step of a batch: the state at its end, and (state at its start, contact forces)."""
    matrices = step.matrices
    forces, vehicle_states = forces_and_vehicles(state, step, commands, vehicles)
    beam = state[: matrices.state_count]
    next_state = free_response(matrices.transition, beam) + matvec(matrices.force_response, forces)
    if commands is not None:
        next_state = next_state + matrices.commands.input_matrix @ commands
    if vehicle_states is not None:
        next_state = xp.concatenate([next_state, vehicle_states])
    return next_state, (state, forces)


def forces_and_vehicles(state, step: StepInput, commands, vehicles: Vehicles | None):
    """Contact forces (row, batch) of a step, and the states of the vehicles at its end, if any."""
    if vehicles is None:
        parts = step.matrices, step.inertia, step.weight
        return contact_forces(*parts, state, commands), None
    return vehicles.advance(step, state, commands)


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
    """Steps without commands: final state, state before each step, and contact forces."""
    matrices, inertia, weight = step.matrices, step.inertia, step.weight
    if not any_jax(step, state, vehicles):
        return _advance_known(step, state, vehicles)
    if vehicles is not None:
        final_state, (states, forces) = scan(
            lambda state, one: advance(state, one, None, vehicles), state, step
        )
        return final_state, states, forces
    has_matrix = isinstance(matrices.contact_compliance, Array)
    advance_all = _advance_with_rule if has_matrix else _advance_all
    return advance_all(matrices, inertia, weight, state)


def _advance_all(matrices, inertia, weight, state):
    steps = StepInput(matrices, inertia, weight, None)
    final_state, (states, forces) = scan(advance, state, steps)
    return final_state, states, forces


def _advance_known(step: StepInput, state, vehicles: Vehicles | None):
    """`advance_unforced` of known numbers, as one map a step.

    The systems of all steps are solved at once; NumPy takes a tenth of the time of one by one.
    """
    if vehicles is None and advances_by_forces(step.matrices.state_count):
        return _advance_by_forces(step, state)
    of_forces, of_states = known_maps(step, vehicles)
    states = np.empty((len(of_states.offset) + 1, *of_states.offset.shape[1:]))
    states[0] = state.T
    for i in range(len(states) - 1):
        states[i + 1] = of_states.at(i, states[i])
    states, forces = (np.swapaxes(part, 1, 2) for part in (states, of_forces(states[:-1])))
    return states[-1], states[:-1], forces


def _advance_by_forces(step: StepInput, state):
    """`_advance_known` of many states: by the contact forces, without matrices of all states."""
    of_columns, of_one = _known_forces(step)
    of_forces = KnownMap(of_columns, of_one[..., 0])
    blocks, side = step.matrices.transition.shape[1:3]
    states = np.empty((len(of_one) + 1, *state.T.shape))
    states[0] = state.T
    forces = np.empty(of_one.shape[:1] + states.shape[1:2] + of_one.shape[2:3])
    by_block = states.reshape(*states.shape[:2], blocks, side)
    for i, (transition, response) in enumerate(
        zip(step.matrices.transition, step.matrices.force_response, strict=True)
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


class KnownMap(NamedTuple):
    """Affine map of each step from the state and the commands: linear @ (z, u) + offset.

    Runs of a batch may share the linear part, whose batch axis then has length one.
    """

    linear: Float[np.ndarray, "step shared_or_batch row column"]
    offset: Float[np.ndarray, "step batch row"]

    def at(
        self, i: int, columns: Float[np.ndarray, "batch column"]
    ) -> Float[np.ndarray, "batch row"]:
        """Values of one step."""
        linear = self.linear[i]
        if len(linear) == 1:
            return columns @ linear[0].T + self.offset[i]
        return (linear @ columns[..., None])[..., 0] + self.offset[i]

    def __call__(
        self, columns: Float[np.ndarray, "step batch column"]
    ) -> Float[np.ndarray, "step batch row"]:
        """Values of all steps."""
        if self.linear.shape[1] == 1:
            return columns @ self.linear[:, 0].mT + self.offset
        return (self.linear @ columns[..., None])[..., 0] + self.offset


def known_maps(step: StepInput, vehicles: Vehicles | None) -> tuple[KnownMap, KnownMap]:
    """Maps of steps of known numbers to the contact forces and to the next state.

    z' = Phi z + B u - Gamma S (m (R z + D u) + w) with commands u, if there are any.
    """
    matrices, commands = step.matrices, step.matrices.commands
    surface = None
    if vehicles is None:
        of_columns, of_one = _known_forces(step)
    else:
        forces, surface = known_forces(vehicles, step)
        of_columns, of_one = forces[..., :-1], forces[..., -1:]
    linear, offset = (matrices.force_response[:, None] @ part for part in (of_columns, of_one))
    blocks, side = matrices.transition.shape[1:3]
    state_index = np.arange(matrices.state_count).reshape(blocks, side)
    linear[:, :, state_index[:, :, None], state_index[:, None, :]] += matrices.transition[:, None]
    if commands is not None:
        linear[..., linear.shape[-1] - commands.input_matrix.shape[-1] :] += commands.input_matrix[
            :, None
        ]
    if vehicles is not None:
        of_vehicles = known_state_maps(vehicles, step, surface)
        linear = np.concatenate([linear, of_vehicles[..., :-1]], axis=2)
        offset = np.concatenate([offset, of_vehicles[..., -1:]], axis=2)
    return KnownMap(of_columns, of_one[..., 0]), KnownMap(linear, offset[..., 0])


def _known_forces(step: StepInput):
    """Linear part and offset of the map to the contact forces of plain wheels."""
    matrices, commands = step.matrices, step.matrices.commands
    inertia, weight = (np.swapaxes(part, 1, 2)[..., None] for part in (step.inertia, step.weight))
    compliance, response = matrices.contact_compliance, matrices.contact_response
    if response is None:
        count = 0 if commands is None else commands.input_matrix.shape[-1]
        no_response = np.zeros((len(weight), 1, weight.shape[2], matrices.state_count + count))
        return no_response, -weight
    parts = [response, *([] if commands is None else [commands.contact_response])]
    # Runs of the same wheels share the systems; weights are then right sides of one each.
    batch = weight.shape[1]
    shared = batch > 1 and not np.ptp(inertia, axis=1).any()
    if shared:
        inertia, weight = inertia[:, :1], np.moveaxis(weight, 1, -1)[:, :, 0][:, None]
    right = [inertia * part[:, None] for part in parts]
    right = np.concatenate([*right, weight], axis=-1)
    if isinstance(compliance, ModalCompliance):
        compliance = jax.tree.map(lambda part: part[:, None], compliance)
        forces = compliance.solve(inertia, right)
    else:
        system = np.eye(weight.shape[2]) + inertia * compliance[:, None]
        forces = -np.linalg.solve(system, right)
    if not shared:
        return forces[..., :-1], forces[..., -1:]
    return forces[..., :-batch], np.swapaxes(forces[..., -batch:], 1, 3)  # step, batch, wheel, 1


_advance_with_rule = custom_jvp(_advance_all)


@_advance_with_rule.defjvp
def _advance_jvp(primals, tangents):
    """Tangents of steps f + m (G f + R z) + w = 0, z' = Phi z + Gamma f, with contact forces f.

    With S = (1 + m G)^-1: f. = c - S m R z.  and  z.' = Phi z. - Gamma S m R z. + e, where c and e
    do not depend on the tangent z. of the state.
    """
    matrices, inertia, weight, state = primals
    matrix_tangents, inertia_tangent, weight_tangent, state_tangent = tangents
    final_state, states, forces = _advance_with_rule(*primals)
    states, forces = (
        checkpoint_name(states, CHECKPOINT_NAME),
        checkpoint_name(forces, CHECKPOINT_NAME),
    )
    # Systems of all steps and runs at once.
    rows = forces.shape[1]
    matrix = inertia[:, :, None] * matrices.contact_compliance[..., None] + np.eye(rows)[:, :, None]
    identity = xp.broadcast_to(np.eye(rows)[:, :, None], matrix.shape)
    inverse = vmap(solve_small)(matrix, identity)
    force_feedback = inverse * inertia[:, None]
    state_feedback = xp.einsum("tir,trcl->ticl", matrices.force_response, force_feedback)
    acceleration = _matvec_of_steps(matrices.contact_compliance, forces) + _matvec_of_steps(
        matrices.contact_response, states
    )
    acceleration_tangent = _matvec_of_steps(
        matrix_tangents.contact_compliance, forces
    ) + _matvec_of_steps(matrix_tangents.contact_response, states)
    free_force_tangent = -_multiply_and_sum(
        inverse, inertia_tangent * acceleration + inertia * acceleration_tangent + weight_tangent
    )
    free_state_tangent = vmap(free_response)(matrix_tangents.transition, states)
    free_state_tangent = (
        free_state_tangent
        + _matvec_of_steps(matrix_tangents.force_response, forces)
        + _matvec_of_steps(matrices.force_response, free_force_tangent)
    )

    def step(tangent, parts):
        contact_response, transition, feedback, free_tangent = parts
        acceleration = matvec(contact_response, tangent)
        next_tangent = free_response(transition, tangent) + free_tangent
        return next_tangent - xp.sum(feedback * acceleration, axis=1), tangent

    parts = matrices.contact_response, matrices.transition, state_feedback, free_state_tangent
    final_tangent, state_tangents = scan(step, state_tangent, parts)
    force_tangents = free_force_tangent - _multiply_and_sum(
        force_feedback, _matvec_of_steps(matrices.contact_response, state_tangents)
    )
    return (final_state, states, forces), (final_tangent, state_tangents, force_tangents)


def _matvec_of_steps(
    matrix: Float[Array, "step row column"], vectors: Float[Array, "step column batch"]
):
    return (
        _multiply_and_sum(matrix[..., None], vectors)
        if max(matrix.shape[1:]) <= MAX_UNROLLED_TERMS
        else matrix @ vectors
    )


def _multiply_and_sum(matrix, vectors: Float[Array, "step column batch"]):
    return xp.sum(matrix * vectors[:, None], axis=2)
