"""Time steps: contact forces at the Gauss nodes, and the state at the end, as affine maps.

With the state z at the start of a step, its commands u and the contact forces f at its nodes,

    f = -(1 + m G)^-1 (m (R z + D u) + w),    z' = Phi z + B u + Gamma f

are affine in z and u. Maps of all steps are found at once, before the states are computed. Each
step is then one product of a matrix and a vector, in NumPy and in compiled programs.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.model.contact import ModalCompliance, solve_contact_forces
from jaxbeam.numerics.matrices import matvec
from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    cond,
    is_jax,
    is_numpy,
    scan,
    set_at,
    solve_conditioned,
    vmap,
    xp,
)
from jaxbeam.simulation.integrator.step_matrices import (
    StepMatrices,
    advances_by_forces,
    share_matrices,
)
from jaxbeam.simulation.integrator.vehicles import StepInput, Vehicles, vehicle_maps


class AffineMap(NamedTuple):
    """Affine map of each step from the state and the commands: linear @ (z, u) + offset.

    The batch axis of the linear part has length one where all runs of a batch have the same.
    """

    linear: Float[Array, "*step shared_or_batch row column"]
    offset: Float[Array, "*step batch row"]

    def at(
        self, i: int | slice, columns: Float[Array, "*step batch column"]
    ) -> Float[Array, "*step batch row"]:
        """Values of the map of step `i`, or of a slice of steps, for given columns."""
        return AffineMap(self.linear[i], self.offset[i])(columns)

    def __call__(
        self, columns: Float[Array, "*step batch column"]
    ) -> Float[Array, "*step batch row"]:
        """Values of the maps of all steps, for given columns."""
        if self.linear.shape[-3] == 1:
            return columns @ self.linear[..., 0, :, :].mT + self.offset
        return (self.linear @ columns[..., None])[..., 0] + self.offset


class StepMaps(NamedTuple):
    """Affine maps of steps to their contact forces, states at the end, and states at the nodes.

    Columns are states of the beam, then of the vehicles, then commands. The map to the states at
    the nodes (node, state) is None unless the step matrices include them.
    """

    forces: AffineMap
    states: AffineMap
    nodes: AffineMap | None


def step_maps(step: StepInput, vehicles: Vehicles | None) -> StepMaps:
    """Affine maps of the steps of a chunk."""
    matrices, commands, of_vehicles = step.matrices, step.matrices.commands, None
    if vehicles is None:
        of_columns, of_one = contact_maps(step)
        states = 0
    else:
        *of_forces, of_vehicles = vehicle_maps(vehicles, step)
        of_columns, of_one = _with_prescribed_forces(step, *of_forces)
        states = vehicles.loads.vehicle_states

    def through_forces(response, *others):
        """Map through the contact forces, plus the direct maps `others` of all columns."""
        linear, offset = (response[:, None] @ part for part in (of_columns, of_one))
        direct = [part for part in others if part.shape[-1]]
        direct = direct[0] if len(direct) == 1 else xp.concatenate(direct, axis=-1)
        if is_jax(direct):
            return linear + direct[:, None], offset
        linear += direct[:, None]  # in place, as it is the largest matrix of the steps
        return linear, offset

    def no_effect(rows):
        return np.zeros((of_one.shape[0], rows, states))

    transition = block_diagonal(matrices.transition)
    beam_states = transition.shape[-1]
    on_commands = [] if commands is None else [commands.input_matrix]
    others = transition, no_effect(beam_states), *on_commands
    linear, offset = through_forces(matrices.force_response, *others)
    if of_vehicles is not None:
        linear = xp.concatenate([linear, of_vehicles[0]], axis=2)
        offset = xp.concatenate([offset, of_vehicles[1]], axis=2)
    nodes = None
    if matrices.nodes is not None:
        parts = matrices.nodes
        others = parts.transition, no_effect(parts.transition.shape[1]), parts.command_response
        of_nodes = through_forces(parts.force_response, *others)
        nodes = AffineMap(of_nodes[0], of_nodes[1][..., 0])
    forces = AffineMap(of_columns, of_one[..., 0])
    return StepMaps(forces, AffineMap(linear, offset[..., 0]), nodes)


def block_diagonal(blocks: Float[Array, "step block side side"]) -> Float[Array, "step row column"]:
    """Block-diagonal matrix of each step from its blocks."""
    steps, count, side, _ = blocks.shape
    if count == 1:
        return blocks[:, 0]
    index = np.arange(count * side).reshape(count, side)
    places = np.s_[:, index[:, :, None], index[:, None, :]]
    return set_at(np.zeros((steps, count * side, count * side)), places, blocks)


def contact_maps(step: StepInput):
    """Linear part and offset of the map to the contact forces of plain wheels."""
    matrices, commands = step.matrices, step.matrices.commands
    inertia, weight = (xp.swapaxes(part, 1, 2)[..., None] for part in (step.inertia, step.weight))
    compliance, response = matrices.contact_compliance, matrices.contact_response
    if response is None:
        count = 0 if commands is None else commands.input_matrix.shape[-1]
        no_response = np.zeros((len(weight), 1, weight.shape[2], matrices.state_count + count))
        return no_response, -weight
    parts = [response, *([] if commands is None else [commands.contact_response])]
    # Runs of equal wheels have one system; their weights are then right-hand sides of it.
    shared = share_matrices(inertia)
    if shared:
        inertia, weight = inertia[:, :1], xp.moveaxis(weight, 1, -1)[:, :, 0][:, None]
    solved = response.shape[1]
    inertia, weight = inertia[:, :, :solved], weight[:, :, :solved]
    right = [inertia * part[:, None] for part in parts], [weight]
    if is_jax(weight) is any(
        map(is_jax, right[0])
    ):  # solved together if both are traced or neither
        right = ([*right[0], weight],)
    found = [part for own in right for part in _forces(compliance, inertia, own)]
    of_columns, of_one = xp.concatenate(found[:-1], axis=-1), found[-1]
    if shared:
        of_one = xp.swapaxes(of_one, 1, 3)  # step, batch, wheel, 1
    return _with_prescribed_forces(step, of_columns, of_one)


def _with_prescribed_forces(step: StepInput, of_columns, of_one):
    """Map to the contact forces of all wheels, from that to those which are solved for."""
    steps, batch, solved, columns = of_columns.shape
    weight = xp.swapaxes(step.weight[:, solved:], 1, 2)[..., None]
    if not weight.shape[2]:
        return of_columns, of_one
    none = np.zeros((steps, batch, weight.shape[2], columns))
    return xp.concatenate([of_columns, none], axis=2), xp.concatenate([of_one, -weight], axis=2)


def _forces(compliance, inertia, right: list) -> list:
    """Contact forces f that solve f + m G f = -d, for several right-hand sides d."""
    sides = xp.concatenate(right, axis=-1)
    if isinstance(compliance, ModalCompliance):
        compliance = jax.tree.map(lambda part: part[:, None], compliance)
        forces = compliance.solve(inertia, sides)
    else:
        forces = -solve_conditioned(np.eye(sides.shape[2]) + inertia * compliance[:, None], sides)
    ends = np.cumsum([part.shape[-1] for part in right])[:-1]
    return xp.split(forces, ends, axis=-1)


MANY_RUNS = 16  # from which NumPy advances a batch by contact forces, as maps of runs take longer


@jax.named_scope("collocation")
def contact_forces(matrices: StepMatrices, inertia, weight, state):
    """Contact forces (row, batch) in N of a step of plain wheels from a state."""

    if matrices.contact_response is None:
        return -weight

    def forces():
        solved, compliance = matrices.contact_response.shape[0], matrices.contact_compliance
        own = inertia[:solved]
        right = weight[:solved] + own * matvec(matrices.contact_response, state)
        if isinstance(compliance, ModalCompliance):
            by_run = vmap(lambda m, d: compliance.solve(m[:, None], d[:, None])[:, 0], -1, -1)
            found = by_run(own, right)
        else:
            found = solve_contact_forces(compliance, own, right)
        return xp.concatenate([found, -weight[solved:]])

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

    Each step is one affine map, and the systems of all steps are solved at once. Batches of plain
    wheels that are compiled, or of many concrete runs, are advanced by their contact forces
    instead: their runs have the same matrices but different maps.
    """
    shared = is_jax(step.matrices.transition) or is_numpy(state) and state.shape[1] >= MANY_RUNS
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
    """States (boundary, batch, state) of steps that are affine maps, from the initial state."""
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
    """`advance_unforced` of plain wheels by contact forces, without a matrix of all states."""
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
