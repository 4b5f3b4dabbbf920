"""Contact law of travelling loads on a vibrating beam.

A load of mass m at x(t) stays on the beam, so its acceleration is that of the deflection under it,

    D2w/Dt2 = w_tt + 2 x' w_xt + x'^2 w_xx + x'' w_x,

and the force on the beam, positive upwards, is r = -W - m D2w/Dt2 with W its weight (corrected
eqs 2.3 to 2.13 of the thesis; a force has m = 0). With the states z of the modal model and forces
f on the modes, D2w/Dt2 = (contact row) . z + (shape row) . f.
"""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.case.loads.base import trajectory
from jaxbeam.case.trajectory import AbstractTrajectory
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.batched_linalg import solve_small
from jaxbeam.runtime.arrays import Array, add_at, custom_jvp, is_jax, xp
from jaxbeam.runtime.module import Module


class LoadSet(Module):
    """All loads of a run: trajectories, inertia (kg) and weight (N).

    Inertia and weight may differ between the runs of a batch, which share everything else.
    """

    trajectories: tuple[AbstractTrajectory, ...]
    inertia: Float[Array, "load batch"]
    weight: Float[Array, "load batch"]

    def kinematics(self, times: Float[Array, "*time"]) -> tuple[Float[Array, "load *time"], ...]:
        """Positions (m), speeds (m/s) and accelerations (m/s^2) at given times (s)."""
        if not self.trajectories:
            return (xp.zeros((0, *times.shape)),) * 3
        paths = zip(*(path.kinematics(times) for path in self.trajectories), strict=True)
        position, speed, acceleration = (xp.stack(parts) for parts in paths)
        return position, speed, acceleration

    def cubics(self) -> tuple[Float[Array, "load piece"], Float[Array, "load piece 4"]]:
        """Start times (s) and coefficients of the cubic pieces of the trajectories.

        Padded to the same number of pieces; for trajectories of the kind
        `AbstractPiecewiseTrajectory`, which those of cases are.
        """
        if not self.trajectories:
            return xp.zeros((0, 1)), xp.zeros((0, 1, 4))
        cubics_by_load = [path.cubics() for path in self.trajectories]
        max_pieces = max(times.shape[0] for times, _ in cubics_by_load)
        padding = [(0, max_pieces - times.shape[0]) for times, _ in cubics_by_load]
        pairs = list(zip(cubics_by_load, padding, strict=True))
        times = [xp.pad(times, more, constant_values=np.inf) for (times, _), more in pairs]
        cubics = [xp.pad(cubics, [more, (0, 0)]) for (_, cubics), more in pairs]
        return xp.stack(times), xp.stack(cubics)

    @property
    def massless(self) -> bool:
        """Whether all loads are known to have no inertia, so that contact forces are weights."""
        return not is_jax(self.inertia) and not np.any(self.inertia)

    def on_beam(self, times: Float[Array, "*time"]) -> Bool[Array, "load *time"]:
        """Whether each load is on the beam at given times (s), from entry until before exit."""
        windows = [path.entry_exit_times() for path in self.trajectories]
        on = [(entry <= times) & (times < leave) for entry, leave in windows]
        return xp.array(on, bool).reshape(len(on), *xp.shape(times))


def load_set(case: Case) -> LoadSet:
    """Loads of a case, as a batch of one run."""
    trajectories = tuple(trajectory(load, case.beam.length) for load in case.loads)
    gravity = case.run.gravity
    inertia = [load.inertia() for load in case.loads]
    weight = [load.weight(gravity) for load in case.loads]
    column = (len(trajectories), 1)
    return LoadSet(
        trajectories, xp.array(inertia).reshape(column), xp.array(weight).reshape(column)
    )


def contact_rows(model: ModalModel, position, speed, acceleration, active):
    """Shape rows (*position, block, mode) and contact rows (*position, block, side) at the loads.

    Position (m), speed (m/s), acceleration (m/s^2) and `active` (on the beam) of the loads all have
    the shape (*position,); rows of loads off the beam are zero.
    """
    position_on_beam = xp.where(active, position, 0.0)
    shape, slope, curvature = xp.where(
        active[..., None], model.shapes(position_on_beam, (0, 1, 2)), 0.0
    )
    speed, acceleration = speed[..., None], acceleration[..., None]
    convective = speed**2 * curvature + acceleration * slope
    coriolis = 2 * speed * slope
    blocks, modes_per_block = model.state_matrix.shape[0], model.modes_per_block
    block_shape = (*position.shape, blocks, modes_per_block)
    shape = shape.reshape(block_shape)
    rates = model.state_matrix[:, 1 : 2 * modes_per_block : 2, :]
    state_rows = (
        xp.sum(shape[..., None] * rates, axis=-2) if modes_per_block == 1 else shape @ rates
    )
    convective = xp.stack([convective.reshape(block_shape), coriolis.reshape(block_shape)], axis=-1)
    convective = convective.reshape(*block_shape[:-1], 2 * modes_per_block)
    rows = add_at(state_rows, np.s_[..., : 2 * modes_per_block], convective)
    return shape, rows


def contact_at(
    model: ModalModel,
    loads: LoadSet,
    times: Float[Array, "*time"],
    states: Float[Array, "*time state batch"],
    commands: Float[Array, "*time actuator batch"] | None = None,
) -> tuple[Float[Array, "*time load batch"], Float[Array, "*time mode batch"]]:
    """Contact forces r (N, upwards on the beam) and accelerations of q at instants (s).

    At the instant at which a load enters or leaves, those just after it.
    """
    kinematics = (*loads.kinematics(times), loads.on_beam(times))
    position, speed, acceleration, active = (xp.moveaxis(part, 0, -1) for part in kinematics)
    shape, rows = contact_rows(model, position, speed, acceleration, active)
    shape = shape.reshape(*position.shape, model.mode_count)
    blocks, side, _ = model.state_matrix.shape
    state_blocks = states.reshape(*times.shape, blocks, side, -1)
    rates = (model.state_matrix @ state_blocks).reshape(states.shape)
    modal_acceleration = rates[..., model.rate_index, :]
    acceleration_under_load = rows.reshape(*position.shape, model.state_count) @ states
    if commands is not None:
        command_acceleration = model.command_matrix[model.rate_index] @ commands
        modal_acceleration, acceleration_under_load = (
            modal_acceleration + command_acceleration,
            acceleration_under_load + shape @ command_acceleration,
        )
    weight = xp.where(active[..., None], loads.weight, 0.0)
    if loads.massless:
        return -weight, modal_acceleration - shape.mT @ weight
    mass = xp.where(active[..., None], loads.inertia, 0.0)
    # The contact law: (1 + m S S') r = -W - m (contact row) . z.
    identity = np.eye(position.shape[-1])[..., None]
    matrix = identity + mass[..., None, :] * (shape @ shape.mT)[..., None]
    right = weight + mass * acceleration_under_load
    force = -_solve_at_instants(matrix, right)
    return force, modal_acceleration + shape.mT @ force


def _solve_at_instants(
    matrix: Float[Array, "*time load load batch"], right: Float[Array, "*time load batch"]
) -> Float[Array, "*time load batch"]:
    """Solutions of small systems, with instants and batch as one batch axis."""
    loads = right.shape[-2]
    columns = xp.moveaxis(right, -2, 0)
    systems = math.prod(columns.shape[1:])
    matrix = xp.moveaxis(matrix, (-3, -2), (0, 1)).reshape(loads, loads, systems)
    solution = solve_small(matrix, columns.reshape(loads, 1, systems))
    return xp.moveaxis(solution.reshape(columns.shape), 0, -2)


class ModalCompliance(eqx.Module):
    """Compliance G = U V' of contact forces that act through fewer modes than there are loads.

    `response` U maps generalised forces at the Gauss nodes (node and mode) to the acceleration
    under the loads (load and node). V' maps contact forces to generalised forces, with the mode
    shapes at the loads, `shape_rows`.
    """

    response: Float[Array, "*step row node_mode"]
    shape_rows: Float[Array, "*step load node mode"]

    def generalised_forces(
        self, forces: Float[Array, "*batch row column"]
    ) -> Float[Array, "*batch node_mode column"]:
        """Generalised forces V' f of contact forces."""
        *_, loads, nodes, modes = self.shape_rows.shape
        forces = forces.reshape(*forces.shape[:-2], loads, nodes, -1)
        by_node = xp.moveaxis(self.shape_rows, -3, -1) @ xp.moveaxis(forces, -3, -2)
        return by_node.reshape(*by_node.shape[:-3], nodes * modes, -1)

    def solve(
        self, inertia: Float[Array, "*batch row 1"], right: Float[Array, "*batch row column"]
    ) -> Float[Array, "*batch row column"]:
        """Contact forces f of f + m G f = -d, by the generalised forces Q of Q + V'm U Q = -V'd.

        The cost is linear in the number of loads.
        """
        coupling = self.generalised_forces(inertia * self.response)
        system = np.eye(coupling.shape[-1]) + coupling
        generalised = -xp.linalg.solve(system, self.generalised_forces(right))
        return -right - inertia * (self.response @ generalised)


@custom_jvp
def solve_contact_forces(compliance, inertia, load):
    """Contact forces r (row, batch) from (delta_ij + m_i G_ij) r_j = -d_i.

    The `compliance` G (row, row) is shared by the batch; `inertia` m and `load` d are (row, batch).
    For the step lengths in use, the matrix is close to the identity plus a positive matrix.
    """
    matrix = inertia[:, None] * compliance[:, :, None] + np.eye(compliance.shape[0])[:, :, None]
    return solve_small(matrix, -load[:, None])[:, 0]


@solve_contact_forces.defjvp
def _solve_contact_forces_jvp(primals, tangents):
    """Tangent of the forces by the same system: cheaper than differentiating the elimination."""
    force_coupling, inertia, right_side = primals
    force_coupling_tangent, inertia_tangent, right_side_tangent = tangents
    forces = solve_contact_forces(*primals)
    residual_tangent = (
        inertia_tangent * (force_coupling @ forces)
        + inertia * (force_coupling_tangent @ forces)
        + right_side_tangent
    )
    return forces, solve_contact_forces(force_coupling, inertia, residual_tangent)
