"""Contact law of wheels on a vibrating beam.

A wheel at x(t) follows the surface, whose height is the deflection plus that of the profile r(x):

    y = w + r,    y' = w_t + x' w_x + x' r',
    y'' = w_tt + 2 x' w_xt + x'^2 (w_xx + r'') + x'' (w_x + r'),

and the force on the beam, positive upwards, is f = -W - m y'' - s with W the static load, m the
unsprung mass and s = k y + c y' - H z the force of the springs between wheel and vehicle, with the
states z of the vehicle (corrected eqs 2.3 to 2.13 of the thesis for a mass, which has no springs; a
force has m = 0). With the states of the modal model and forces f on the modes, y, y' and y'' are
rows times states, and y'' is also (shape row) . f.

Contact of vehicles with the beam: rows of forces, and the states of the vehicles.

With x the states of the modal model and then those of the vehicles, in the order of the integrator,
the law of `contact` is

    (1 + m S S') r = -W - V x - m S q_u'',     q = Y x,     z' = A z + B q  (`vehicle_system`),

for contact forces r (upwards on the beam), the mode shapes S at the wheels, the modal accelerations
q_u'' of the commands, and the forces q = k y + c y' that the beam exerts on springs of vehicles.
The profile and forces that vary in time add to W and q what `prescribed_disturbance` returns.

Where a wheel with mass passes a kink, the slope of its path jumps: that of a beam at a hinge and,
if it is flexible in shear, where the shear force or the shear stiffness does; that of a profile at
the ends of a ramp. A wheel that stays on the surface then changes its velocity by |v| ([w'] + [r'])
at once, from left to right; see `jaxbeam.simulation.integrator.step_matrices.with_impulses`.
"""

import math

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.beam import has
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.elements import kink_nodes
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.transfer_matrices import has_settlement
from jaxbeam.numerics.matrices import solve_small
from jaxbeam.numerics.polynomials import slope_jumps
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    any_jax,
    block_diag,
    custom_jvp,
    set_at,
    slice_in_dim,
    take,
    xp,
)

CONCRETE_BLOCK = 2**14  # instants times wheels at once: fifty for 30 s take 0.1 GiB, not 0.9


class SurfaceRows(Module):
    """Rows from modal states to the motion of the beam under wheels; zero off the beam.

    `shape` is that of the modes; `acceleration`, `velocity` and `deflection` act on the states in
    the blocks of the modal model. The first is None where no wheel has inertia, the others where
    none has springs. In steps of a run they are those of the first wheels, which are solved for.
    """

    shape: Float[Array, "*wheel block mode"]
    acceleration: Float[Array, "*solved block side"] | None
    velocity: Float[Array, "*solved block side"] | None
    deflection: Float[Array, "*solved block side"] | None


def surface_rows(
    model: ModalModel,
    position,
    speed,
    acceleration,
    active,
    springs=False,
    inertia=True,
    eccentricity=None,
) -> SurfaceRows:
    """Rows from modal states to the motion of the beam under wheels.

    Velocity and deflection are computed with `springs` only, accelerations with `inertia` only.
    Position (m), speed (m/s), acceleration (m/s^2) and `active` (on the beam) of the wheels all
    have the shape (*wheel,), to which that of the `eccentricity` (m) is broadcast.
    """
    position_on_beam = xp.where(active, position, 0.0)
    blocks, modes_per_block = model.state_matrix.shape[0], model.modes_per_block
    block_shape = (*position.shape, blocks, modes_per_block)
    if not (inertia or springs):
        found = model.load_shapes(position_on_beam, (0,), eccentricity)
        shape = xp.where(active[..., None], found[0], 0.0)
        return SurfaceRows(shape.reshape(block_shape), None, None, None)
    shape, slope, curvature = xp.where(
        active[..., None], model.load_shapes(position_on_beam, (0, 1, 2), eccentricity), 0.0
    )
    speed, acceleration = speed[..., None], acceleration[..., None]
    side = model.state_matrix.shape[1]

    def state_rows(of_coordinates, of_rates):
        """Rows on coordinates and rates of the modes, in turn."""
        pairs = xp.stack([part.reshape(block_shape) for part in (of_coordinates, of_rates)], -1)
        return pairs.reshape(*block_shape[:-1], 2 * modes_per_block)

    def all_states(rows):
        return xp.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, side - rows.shape[-1])])

    convective = state_rows(speed**2 * curvature + acceleration * slope, 2 * speed * slope)
    blocks_of_shape = shape.reshape(block_shape)
    rates = model.state_matrix[:, 1 : 2 * modes_per_block : 2, :]
    rows = (
        xp.sum(blocks_of_shape[..., None] * rates, axis=-2)
        if modes_per_block == 1
        else blocks_of_shape @ rates
    )
    rows = add_at(rows, np.s_[..., : 2 * modes_per_block], convective)
    if not springs:
        return SurfaceRows(blocks_of_shape, rows, None, None)
    velocity, deflection = state_rows(speed * slope, shape), state_rows(shape, xp.zeros_like(shape))
    return SurfaceRows(blocks_of_shape, rows, all_states(velocity), all_states(deflection))


class ContactState(Module):
    """Contact forces f (N, upwards on the beam) and accelerations at instants.

    Accelerations of the coordinates q, and of the degrees of freedom of the vehicles of each load
    (m/s^2 or rad/s^2).
    """

    force: Float[Array, "*time wheel batch"]
    modal_acceleration: Float[Array, "*time mode batch"]
    vehicle_acceleration: tuple[Float[Array, "*time _ _ batch"], ...]  # vehicle, dof


def contact_at(
    model: ModalModel,
    loads: LoadSet,
    times: Float[Array, "*time"],
    states: Float[Array, "*time state batch"],
    commands: Float[Array, "*time actuator batch"] | None = None,
) -> ContactState:
    """Contact forces and accelerations at times (s), from the states of model and vehicles.

    At the instant at which a wheel enters or leaves, the values just after it.
    """
    count = CONCRETE_BLOCK // max(loads.wheel_count, 1)
    if times.ndim != 1 or times.size <= count or any_jax(model, loads, times, states, commands):
        return _contact_at(model, loads, times, states, commands)
    blocks = []
    for first in range(0, times.size, count):
        block = slice(first, first + count)
        block_commands = None if commands is None else commands[block]
        blocks.append(_contact_at(model, loads, times[block], states[block], block_commands))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def _contact_at(model: ModalModel, loads: LoadSet, times, states, commands) -> ContactState:
    """`contact_at`, at all instants at once."""
    kinematics = (*loads.kinematics(times), loads.on_beam(times))
    position, speed, acceleration, active = (xp.moveaxis(part, 0, -1) for part in kinematics)
    springs = bool(loads.wheels.vehicles)
    motion = position, speed, acceleration, active
    rows = surface_rows(model, *motion, springs, eccentricity=loads.eccentricity)
    profile = loads.surface_motion(position, speed, acceleration)
    states, vehicle_states = split_states(model.state_count, loads, states)
    shape = rows.shape.reshape(*position.shape, model.mode_count)
    blocks, side, _ = model.state_matrix.shape
    state_blocks = states.reshape(*times.shape, blocks, side, -1)
    rates = (model.state_matrix @ state_blocks).reshape(states.shape)
    modal_acceleration = rates[..., model.rate_index, :]

    def surface_of(row, height):
        beam = row.reshape(*position.shape, model.state_count) @ states
        return beam if height is None else beam + height[..., None]

    height, height_rate, height_acceleration = (None,) * 3 if profile is None else profile
    surface_acceleration = surface_of(rows.acceleration, height_acceleration)
    if commands is not None:
        command_acceleration = model.command_matrix[model.rate_index] @ commands
        modal_acceleration = modal_acceleration + command_acceleration
        surface_acceleration = surface_acceleration + shape @ command_acceleration
    weight, vehicle_acceleration = loads.varying_weight(times), ()
    if springs:
        wheels = loads.wheels
        surface = wheels.stiffness * surface_of(rows.deflection, height)
        surface = surface + wheels.damping * surface_of(rows.velocity, height_rate)
        pairs = list(zip(wheels.vehicles, vehicle_states, strict=True))
        weight = weight + forces_of_wheels(
            loads, [g.spring_forces(z, surface[..., g.wheels, :]) for g, z in pairs], surface
        )
        vehicle_acceleration = tuple(
            group.accelerations(state, surface[..., group.wheels, :]) for group, state in pairs
        )
    mass = loads.inertia
    on_beam = active[..., None]
    pressing = on_beam | loads.on_ground[:, None]
    free_force = xp.where(pressing, -(weight + mass * surface_acceleration), 0.0)
    if loads.massless:
        return ContactState(free_force, modal_acceleration + shape.mT @ free_force, ())
    force = _pressing_forces(shape, xp.where(on_beam, mass, 0.0), free_force)
    return ContactState(force, modal_acceleration + shape.mT @ force, vehicle_acceleration)


def _pressing_forces(
    shape: Float[Array, "*time load mode"],
    mass: Float[Array, "*time load batch"],
    free_force: Float[Array, "*time load batch"],
) -> Float[Array, "*time load batch"]:
    """Contact forces f (N), solved from (1 + m S S') f = free force, with S the mode shapes.

    The free force is -W - s - m (acceleration row) . z. Where modes are fewer than loads, the
    generalised forces Q = S' f are solved first: (1 + S' m S) Q = S' (free force).
    """
    loads, modes = shape.shape[-2:]
    if loads <= modes:
        coupling = mass[..., None, :] * (shape @ shape.mT)[..., None]
        return solve_at_instants(np.eye(loads)[..., None] + coupling, free_force)
    with_mass = xp.moveaxis(mass, -1, -2)[..., None] * shape[..., None, :, :]
    coupling = xp.moveaxis(shape.mT[..., None, :, :] @ with_mass, -3, -1)
    generalised = solve_at_instants(np.eye(modes)[..., None] + coupling, shape.mT @ free_force)
    return free_force - mass * (shape @ generalised)


def split_states(state_count: int, loads: LoadSet, states: Float[Array, "*time state batch"]):
    """States of the modal model, and those of the vehicles of each load, of all `states`.

    The first `state_count` are those of the model; each load's are (*time, vehicle, state, batch).
    """
    first, vehicle_states = state_count, []
    for group in loads.wheels.vehicles:
        part = states[..., first : first + group.state_count, :]
        vehicle_states.append(part.reshape(*part.shape[:-2], group.count, -1, part.shape[-1]))
        first += group.state_count
    return states[..., :state_count, :], vehicle_states


def forces_of_wheels(loads: LoadSet, spring_forces, like, axis: int = -2):
    """Spring forces (N) of all wheels along an axis, from those of the vehicles of each load.

    Zero for wheels without springs; `like` is an array of the shape that a wheel without has.
    """
    parts, first = [], 0
    for group, force in zip(loads.wheels.vehicles, spring_forces, strict=True):
        parts += [xp.zeros_like(slice_in_dim(like, first, group.first_wheel, axis)), force]
        first = group.wheels.stop
    return xp.concatenate([*parts, xp.zeros_like(slice_in_dim(like, first, None, axis))], axis=axis)


def solve_at_instants(
    matrix: Float[Array, "*time load load batch"], right: Float[Array, "*time load batch"]
) -> Float[Array, "*time load batch"]:
    """Solutions x of small systems matrix x = right, one for each instant and run of a batch."""
    loads = right.shape[-2]
    columns = xp.moveaxis(right, -2, 0)
    systems = math.prod(columns.shape[1:])
    matrix = xp.moveaxis(matrix, (-3, -2), (0, 1)).reshape(loads, loads, systems)
    solution = solve_small(matrix, columns.reshape(loads, 1, systems))
    return xp.moveaxis(solution.reshape(columns.shape), 0, -2)


class ModalCompliance(Module):
    """Compliance G = U V' of contact forces that act through fewer modes than there are loads.

    `response` U maps generalised forces at the Gauss nodes (node and mode) to the acceleration
    under the loads (load and node), of which the first are solved for. V' maps contact forces to
    generalised forces, with the mode shapes at all loads, `shape_rows`.
    """

    response: Float[Array, "*step solved_row node_mode"]
    shape_rows: Float[Array, "*step load node mode"]

    def __matmul__(
        self, forces: Float[Array, "*batch row column"]
    ) -> Float[Array, "*batch solved_row column"]:
        """Accelerations G f (m/s^2) under the solved loads."""
        return self.response @ self.generalised_forces(forces)

    def generalised_forces(
        self, forces: Float[Array, "*batch row column"]
    ) -> Float[Array, "*batch node_mode column"]:
        """Generalised forces V' f of contact forces of the first loads."""
        *_, nodes, modes = self.shape_rows.shape
        forces = forces.reshape(*forces.shape[:-2], forces.shape[-2] // nodes, nodes, -1)
        shape_rows = self.shape_rows[..., : forces.shape[-3], :, :]
        by_node = xp.moveaxis(shape_rows, -3, -1) @ xp.moveaxis(forces, -3, -2)
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


class ContactRows(Module):
    """Matrices of the contact law at some times: shape S, mass m, force V and surface Y.

    The law stands at the head of this file. Masses (kg) are zero off the beam; Y has no columns of
    vehicle states, and is None without vehicles.
    """

    shape: Float[Array, "*time wheel mode"]
    mass: Float[Array, "*time wheel"]
    force: Float[Array, "*time wheel all"]
    surface: Float[Array, "*time wheel state"] | None


def contact_rows(model: ModalModel, loads: LoadSet, times: Float[Array, "*time"]) -> ContactRows:
    """Matrices of the contact law at times (s): just after a wheel that enters or leaves then."""
    kinematics = (*loads.kinematics(times), loads.on_beam(times))
    position, speed, acceleration, active = (xp.moveaxis(part, 0, -1) for part in kinematics)
    wheels, springs = loads.wheels, bool(loads.wheels.vehicles)
    motion = position, speed, acceleration, active
    mass_rows, rows = _mass_rows(model, motion, loads.inertia[:, 0], springs, loads.eccentricity)
    if not springs:
        return mass_rows
    shape, mass, force = mass_rows.shape, mass_rows.mass, mass_rows.force
    surface = wheels.stiffness * rows.deflection.reshape(force.shape)
    surface = surface + wheels.damping * rows.velocity.reshape(force.shape)
    of_vehicles = xp.where(active[..., None], vehicle_system(loads)[2], 0.0)
    return ContactRows(
        shape, mass, xp.concatenate([force + surface, -of_vehicles], axis=-1), surface
    )


def mass_contact_rows(
    model: ModalModel,
    position: Float[Array, "*time wheel"],
    speed: Float[Array, "*time wheel"],
    active: Bool[Array, "*time wheel"],
    mass: Float[Array, "*time wheel"],
) -> ContactRows:
    """Matrices of the contact law of masses (kg) at positions (m) with constant speeds (m/s).

    `active` ones are on the beam.
    """
    return _mass_rows(model, (position, speed, xp.zeros_like(speed), active), mass, False)[0]


def _mass_rows(
    model, motion, inertia, springs, eccentricity=None
) -> tuple[ContactRows, SurfaceRows]:
    """Matrices of the contact law without springs, and the rows of the surface under the wheels."""
    position, speed, acceleration, active = motion
    kinematics = position, speed, acceleration
    rows = surface_rows(model, *kinematics, active, springs, eccentricity=eccentricity)
    shape = rows.shape.reshape(*position.shape, model.mode_count)
    of_acceleration = rows.acceleration.reshape(*position.shape, model.state_count)
    mass = xp.where(active, inertia, 0.0)
    return ContactRows(shape, mass, mass[..., None] * of_acceleration, None), rows


def vehicle_system(
    loads: LoadSet,
) -> tuple[
    Float[Array, "vehicle_state vehicle_state"],
    Float[Array, "vehicle_state wheel"],
    Float[Array, "wheel vehicle_state"],
]:
    """Matrices A, B and H of all vehicles of one run as a single linear system.

    z' = A z + B q with the forces q = k y + c y' of the surface under the wheels; the springs press
    on the beam with q - H z (see `VehicleGroup`).
    """
    states, wheels = loads.vehicle_states, loads.wheel_count
    blocks, B, H, first = [], xp.zeros((states, wheels)), xp.zeros((wheels, states)), 0
    for group in loads.wheels.vehicles:
        size, count = group.A.shape[0], group.wheels_per_vehicle
        for i in range(group.count):
            wheel = group.first_wheel + i * count
            own, under = slice(first, first + size), slice(wheel, wheel + count)
            blocks.append(group.A[..., 0])
            B, H = (
                set_at(B, (own, under), group.B[..., 0]),
                set_at(H, (under, own), group.H[..., 0]),
            )
            first += size
    return (block_diag(*blocks) if blocks else xp.zeros((0, 0))), B, H


def has_prescribed_disturbance(loads: LoadSet) -> bool:
    """Whether a profile or forces over time disturb the beam in addition to the static loads."""
    return loads.profile is not None or bool(loads.wheels.histories)


def prescribed_disturbance(
    loads: LoadSet, times: Float[Array, "*time"]
) -> tuple[Float[Array, "*time wheel"], Float[Array, "*time wheel"]]:
    """Forces (N) of profile and force histories at times (s): added to the weights W, and to q.

    Before the start of a run vehicles stand where they are at t = 0.
    """
    weight = (loads.varying_weight(times) - loads.weight)[..., 0]
    if loads.profile is None:
        return weight, xp.zeros_like(weight)
    moves = xp.asarray(times) >= 0
    position, speed, acceleration = loads.kinematics(xp.maximum(times, 0.0))
    speed, acceleration = (xp.where(moves, part, 0.0) for part in (speed, acceleration))
    motion = loads.surface_motion(position, speed, acceleration)
    assert motion is not None
    height, rate, curvature = (xp.moveaxis(part, 0, -1) for part in motion)
    weight = weight + loads.inertia[:, 0] * curvature
    if not loads.wheels.vehicles:
        return weight, xp.zeros_like(weight)
    surface = loads.wheels.stiffness[:, 0] * height + loads.wheels.damping[:, 0] * rate
    return weight + surface, surface


def initial_vehicle_states(loads: LoadSet) -> Float[Array, "state batch"] | None:
    """States of all vehicles at t = 0: in equilibrium on the profile; None without any."""
    wheels = loads.wheels
    if not wheels.vehicles:
        return None
    surface = xp.zeros_like(wheels.stiffness)
    motion = loads.surface_motion(*loads.kinematics(xp.zeros(())))
    if motion is not None:
        surface = surface + wheels.stiffness * motion[0].reshape(len(surface), -1)
    states = [group.initial_state(surface[group.wheels]) for group in wheels.vehicles]
    return xp.concatenate([part.reshape(-1, part.shape[-1]) for part in states])


class KinkSteps(Module):
    """Kink passages among steps (`here`), and the jumps of velocity under the wheels in them.

    `slopes` are rows from q to |v| [w'], `profile` is |v| [r'] (m/s); zero for other wheels.
    """

    here: Bool[Array, " step"]
    slopes: Float[Array, "step load mode"]
    profile: Float[Array, "step load"]


class KinkPassages(Module):
    """Passages of wheels over kinks: times (s; `NEVER` if there is none), indices of the wheels.

    `slope_jumps` are rows from the coordinates q to the jump [w'] of the slope of the beam,
    `profile_jumps` the jumps of the slope of the profile (1), from left to right.
    """

    times: Float[Array, " passage"]
    wheels: Int[Array, " passage"]
    slope_jumps: Float[Array, "passage mode"]
    profile_jumps: Float[Array, " passage"]

    def of_steps(
        self,
        passage: Int[Array, " step"],
        loads: Int[Array, "step load"],
        on_beam: Bool[Array, "step load"],
        speed: Float[Array, "step load"],
    ) -> "KinkSteps":
        """Kink passages and velocity jumps of steps, from the index of the passage (-1 for none).

        `loads` are the indices of the wheels in each step, `speed` (m/s) is at its start.
        """
        here, which = passage >= 0, xp.maximum(passage, 0)
        passing = here[:, None] & on_beam & (loads == take(self.wheels, which)[:, None])
        speed = xp.where(passing, xp.abs(speed), 0.0)
        slopes = speed[..., None] * take(self.slope_jumps, which)[:, None]
        return KinkSteps(here, slopes, speed * take(self.profile_jumps, which)[:, None])

    def happen(
        self, windows: Float[Array, "wheel 2"], start: Float[Array, ""], end: Float[Array, ""]
    ) -> Bool[Array, " passage"]:
        """Whether each passage is between two times (s), with the wheel on the beam on both sides.

        `windows` are the times of entry and exit of all wheels.
        """
        entry, leave = take(windows, self.wheels).T
        return (self.times > xp.maximum(entry, start)) & (self.times < leave) & (self.times <= end)


def kink_passages(
    case: Case, model: ModalModel, loads: LoadSet | None = None
) -> KinkPassages | None:
    """Passages over all kinks of the wheels that may have mass; None without kinks or such wheels.

    `loads` are those of the case, computed unless they are given.
    """
    nodes = np.array(kink_nodes(case, model.modes.layout), int)
    if model.modes.rail_series is not None:  # a rail has no kinks
        nodes = nodes[:0]
    if not (nodes.size or case.profile is not None or has_settlement(case)):
        return None
    wheels = np.flatnonzero(np.concatenate([np.zeros(0, bool), *map(_has_mass, case.loads)]))
    if not wheels.size:
        return None
    loads = load_set(case, model.modes.layout) if loads is None else loads
    positions, profile_jumps = model.modes.nodes[nodes], xp.zeros(nodes.size)
    rows = slope_jumps(model.modes.nodes, model.modes.series)[nodes - 1]
    rows = rows if model.mode_map is None else rows @ model.mode_map
    if loads.profile is not None:
        more, jumps = loads.profile.slope_kinks()
        positions = xp.concatenate([positions, more])
        profile_jumps = xp.concatenate([profile_jumps, jumps])
        rows = xp.concatenate([rows, xp.zeros((jumps.shape[0], rows.shape[1]))])
    if not positions.shape[0]:
        return None
    # A wheel that stops on a kink does not pass it.
    times, rest = loads.passages(positions)[wheels], loads.rest_times()[wheels][:, None]
    return KinkPassages(
        xp.where(times < rest, times, NEVER).reshape(-1),
        np.repeat(wheels, positions.shape[0]),
        xp.tile(rows, (wheels.size, 1)),
        xp.tile(profile_jumps, wheels.size),
    )


def may_have_kinks(case: Case) -> bool:
    """Whether a wheel with mass may pass a kink of the beam; profiles are left out."""
    beam = case.beam
    sheared = has(beam, "shear_stiffness") and (case.supports or beam.segments)
    return bool(beam.hinges or sheared) and any(np.any(_has_mass(load)) for load in case.loads)


def _has_mass(load: AbstractLoad) -> Bool[np.ndarray, " wheel"]:
    """Whether each wheel of a load may have mass that is rigidly on the surface."""
    masses = load.vehicle(np.ones(())).wheel_masses
    values = np.asarray(concrete(masses)) if is_concrete(masses) else np.ones(masses.shape)
    return np.tile(values != 0, load.spacings().shape[0])
