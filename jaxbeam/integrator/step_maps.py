"""Steps as affine maps: of all steps at once, before the states are known.

With the state z at the start of a step, its commands u and the contact forces f at its nodes,

    f = -(1 + m G)^-1 (m (R z + D u) + w),    z' = Phi z + B u + Gamma f

are affine in z and u. What remains to be done step by step is a product of a matrix and a vector,
in NumPy and in compiled programs; systems of all steps are solved at once.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.vehicles.maps import vehicle_maps
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles
from jaxbeam.model.contact import ModalCompliance
from jaxbeam.runtime.arrays import Array, is_jax, set_at, solve_conditioned, xp


class AffineMap(NamedTuple):
    """Affine map of each step from the state and the commands: linear @ (z, u) + offset.

    Runs of a batch may share the linear part, whose batch axis then has length one.
    """

    linear: Float[Array, "*step shared_or_batch row column"]
    offset: Float[Array, "*step batch row"]

    def at(self, i: int, columns: Float[Array, "batch column"]) -> Float[Array, "batch row"]:
        """Values of one of several steps."""
        return AffineMap(self.linear[i], self.offset[i])(columns)

    def __call__(
        self, columns: Float[Array, "*step batch column"]
    ) -> Float[Array, "*step batch row"]:
        """Values of all steps."""
        if self.linear.shape[-3] == 1:
            return columns @ self.linear[..., 0, :, :].mT + self.offset
        return (self.linear @ columns[..., None])[..., 0] + self.offset


class StepMaps(NamedTuple):
    """Maps of steps to their contact forces, to the state at the end, and to those at the nodes.

    Columns are states of the beam, then of the vehicles, then commands. The last map, of (node,
    state), is None unless the step matrices have it.
    """

    forces: AffineMap
    states: AffineMap
    nodes: AffineMap | None


def step_maps(step: StepInput, vehicles: Vehicles | None) -> StepMaps:
    """Maps of the steps of a chunk."""
    matrices, commands, of_vehicles = step.matrices, step.matrices.commands, None
    if vehicles is None:
        of_columns, of_one = contact_maps(step)
        states = 0
    else:
        of_columns, of_one, of_vehicles = vehicle_maps(vehicles, step)
        states = vehicles.loads.vehicle_states

    def through_forces(response, *others):
        """Map by the forces and, with `others` on beam, vehicles and commands, at once."""
        linear, offset = (response[:, None] @ part for part in (of_columns, of_one))
        direct = [part for part in others if part.shape[-1]]
        direct = direct[0] if len(direct) == 1 else xp.concatenate(direct, axis=-1)
        if is_jax(direct):
            return linear + direct[:, None], offset
        linear += direct[:, None]  # in place where it is known: the largest matrix of the steps
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
    """Matrices of each step from the blocks on their diagonal."""
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
    # Runs of the same wheels share the systems; weights are then right sides of one each.
    batch = weight.shape[1]
    shared = batch > 1 and not is_jax(inertia) and not np.ptp(inertia, axis=1).any()
    if shared:
        inertia, weight = inertia[:, :1], xp.moveaxis(weight, 1, -1)[:, :, 0][:, None]
    right = [inertia * part[:, None] for part in parts], [weight]
    if is_jax(weight) is any(
        map(is_jax, right[0])
    ):  # solved together if both are traced or neither
        right = ([*right[0], weight],)
    found = [part for own in right for part in _forces(compliance, inertia, own)]
    of_columns, of_one = xp.concatenate(found[:-1], axis=-1), found[-1]
    if shared:
        of_one = xp.swapaxes(of_one, 1, 3)  # step, batch, wheel, 1
    return of_columns, of_one


def _forces(compliance, inertia, right: list) -> list:
    """Contact forces of f + m G f = -d for several right sides d."""
    sides = xp.concatenate(right, axis=-1)
    if isinstance(compliance, ModalCompliance):
        compliance = jax.tree.map(lambda part: part[:, None], compliance)
        forces = compliance.solve(inertia, sides)
    else:
        forces = -solve_conditioned(np.eye(sides.shape[2]) + inertia * compliance[:, None], sides)
    ends = np.cumsum([part.shape[-1] for part in right])[:-1]
    return xp.split(forces, ends, axis=-1)
