"""Steps of vehicles: exact propagation of their states under the motion of the surface.

Within a step, the forces q = k y + c y' that the surface exerts on the springs of the wheels are
polynomials through their values at the Gauss nodes, as the contact forces are. The states of a
vehicle follow exactly (`propagators`), and the springs press on the surface at the nodes with

    s = S q - O z

where z are its states at the start of the step.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator.propagators import (
    GAUSS_NODES,
    NODE_COUNT,
    force_weights,
    phi_functions_of,
)
from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.model.contact import forces_of_wheels, split_states
from jaxbeam.model.load_set import LoadSet, VehicleGroup
from jaxbeam.numerics.batched_linalg import (
    matmul_last,
    matvec,
    solve_small,
    solve_unpivoted,
)
from jaxbeam.runtime.arrays import (
    Array,
    add_at,
    any_jax,
    cond,
    index_in_dim,
    stop_gradient,
    take,
    xp,
)

MAX_UNROLLED_ROWS = 24  # of contact equations whose elimination is spelt out


class VehiclePropagators(eqx.Module):
    """Matrices of the vehicles of one load over steps of some lengths.

    `transition` and `input` map states and q at the nodes to the states at the end;
    `spring_states` is O and `spring_surface` is S. Rows are (wheel, node).
    """

    transition: Float[Array, "*length state state batch"]
    input: Float[Array, "*length state row batch"]
    spring_states: Float[Array, "*length row state batch"]
    spring_surface: Float[Array, "*length row row batch"]


def vehicle_state_norm(loads: LoadSet) -> Float[Array, ""]:
    """Largest norm of the scaled state matrices of the vehicles, in 1/s; zero without any."""
    norms = [
        xp.max(xp.sum(xp.abs(_scaled_systems(group)[0]), axis=1)) for group in loads.wheels.vehicles
    ]
    return stop_gradient(xp.max(xp.stack(norms))) if norms else np.zeros(())


def _scaled_systems(group: VehicleGroup):
    """State, input and output matrices with displacements scaled to the size of rates."""
    dofs = group.A.shape[0] // 2
    frequency = xp.sqrt(1.0 + xp.max(xp.sum(xp.abs(group.A[dofs:, :dofs]), axis=1), axis=0))
    shape = (dofs, *frequency.shape)
    scale = stop_gradient(xp.concatenate([xp.broadcast_to(frequency, shape), np.ones(shape)]))
    return group.A * scale[:, None] / scale, group.B * scale[:, None], group.H / scale, scale


@jax.named_scope("vehicles")
def vehicle_propagators(
    group: VehicleGroup, lengths: Float[Array, " length"]
) -> VehiclePropagators:
    """Propagators of the vehicles of a load over steps of the given lengths (s)."""
    A, B, H, scale = _scaled_systems(group)
    durations = lengths[:, None] * np.append(GAUSS_NODES, 1.0)
    transition, phi_functions = phi_functions_of(A, B, durations)
    inputs = xp.einsum("cfp,pswblc->lcfswb", force_weights(), phi_functions)
    transition = xp.einsum("stblc->lcstb", transition)
    nodes = slice(0, NODE_COUNT)
    spring_states = xp.einsum("wsb,lcstb->lwctb", H, transition[:, nodes]) * scale
    response = xp.einsum("wsb,lcfsvb->lwcvfb", H, inputs[:, nodes])
    to_end = xp.einsum("lfswb->lswfb", inputs[:, -1])
    count, rows, states, batch_size = lengths.shape[0], H.shape[0] * NODE_COUNT, *scale.shape
    return VehiclePropagators(
        transition=transition[:, -1] / scale[:, None] * scale,
        input=to_end.reshape(count, states, rows, batch_size) / scale[:, None],
        spring_states=spring_states.reshape(count, rows, states, batch_size),
        spring_surface=np.eye(rows)[..., None] - response.reshape(count, rows, rows, batch_size),
    )


def _by_vehicle(group: VehicleGroup, surface: Float[Array, "wheel node batch"]):
    """Values at the wheels of a load as (row, vehicle, batch)."""
    values = surface[group.wheels].reshape(group.count, -1, surface.shape[-1])
    return xp.swapaxes(values, 0, 1)


def spring_forces(
    propagators: VehiclePropagators, group: VehicleGroup, states, surface
) -> Float[Array, "wheel node batch"]:
    """Forces s of the springs of a load at the nodes of a step.

    From the states (vehicle, state, batch) and q of the surface (wheel, node, batch).
    """
    forces = matmul_last(propagators.spring_surface, _by_vehicle(group, surface))
    forces = forces - matmul_last(propagators.spring_states, xp.swapaxes(states, 0, 1))
    return xp.swapaxes(forces, 0, 1).reshape(-1, NODE_COUNT, forces.shape[-1])


def next_vehicle_states(
    propagators: VehiclePropagators, group: VehicleGroup, states, surface
) -> Float[Array, "all batch"]:
    """States of all vehicles of a load at the end of a step; arguments as for `spring_forces`."""
    after = matmul_last(propagators.transition, xp.swapaxes(states, 0, 1))
    after = after + matmul_last(propagators.input, _by_vehicle(group, surface))
    return xp.swapaxes(after, 0, 1).reshape(group.state_count, -1)


def spring_coupling(loads: LoadSet, propagators, wheels) -> Float[Array, "row row batch"]:
    """Matrix S between the rows (wheel and node) of some wheels; zero between vehicles."""
    count, coupling = wheels.shape[0], None
    if count == loads.wheel_count == 1:
        return propagators[0].spring_surface
    for group, part in zip(loads.wheels.vehicles, propagators, strict=True):
        within = (wheels >= group.wheels.start) & (wheels < group.wheels.stop)
        index = xp.where(within, wheels - group.first_wheel, 0)
        vehicle, wheel = index // group.wheels_per_vehicle, index % group.wheels_per_vehicle
        same = within[:, None] & within & (vehicle[:, None] == vehicle)
        all_wheels = (group.wheels_per_vehicle, NODE_COUNT) * 2
        rows = part.spring_surface.reshape(*all_wheels, -1)
        rows = xp.take(xp.take(rows, wheel, axis=0), wheel, axis=2)
        rows = xp.where(same[:, None, :, None, None], rows, 0.0)
        coupling = rows if coupling is None else coupling + rows
    assert coupling is not None
    return coupling.reshape(count * NODE_COUNT, count * NODE_COUNT, -1)


class VehicleStep(eqx.Module):
    """Wheels of the rows of a step, and the surface, for each step of a chunk.

    `length_index` is that of the step's length; `on_beam` tells which wheels are there; `surface`
    is the motion of the profile under all wheels (see `LoadPath`).
    """

    length_index: Int[Array, " *step"]
    wheels: Int[Array, "*step wheel"]
    on_beam: Bool[Array, "*step wheel"]
    surface: Float[Array, "*step 3 all node"] | None


class StepInput(eqx.Module):
    """What a step of a batch takes: matrices, and inertia (kg) and weight (N) of the rows.

    The weight includes the inertia forces of the profile. Without vehicles, `vehicles` is None.
    """

    matrices: StepMatrices
    inertia: Float[Array, "*step row batch"]
    weight: Float[Array, "*step row batch"]
    vehicles: VehicleStep | None


class Vehicles(eqx.Module):
    """Loads with vehicles, and the propagators of the vehicles of each for all step lengths."""

    loads: LoadSet
    propagators: tuple[VehiclePropagators, ...]

    def advance(self, step: StepInput, state, commands):
        """Contact forces (row, batch) of a step, and the states of the vehicles at its end.

        `state` is that of the model and the vehicles; `weight` includes the inertia forces of the
        profile. With the motion of the beam y_b = R z + G f + D u under the wheels, the contact
        law at the nodes is f = -W - m y_b'' - s - S (k y_b + c y_b').
        """
        loads, wheels, matrices = self.loads, self.loads.wheels, step.matrices
        inertia, weight, step = step.inertia, step.weight, step.vehicles
        parts = tuple(
            jax.tree.map(lambda part: index_in_dim(part, step.length_index, keepdims=False), part)
            for part in self.propagators
        )
        state, vehicle_states = split_states(matrices.state_count, loads, state)
        shape = (loads.wheel_count, NODE_COUNT, state.shape[-1])
        surface = xp.zeros(shape)
        if step.surface is not None:
            height, rate, _ = step.surface[..., None]
            surface = wheels.stiffness[:, None] * height + wheels.damping[:, None] * rate
        triples = list(zip(parts, wheels.vehicles, vehicle_states, strict=True))
        springs = forces_of_wheels(loads, [spring_forces(*t, surface) for t in triples], surface, 0)
        # Rows are wheel and node.
        of_wheels = xp.where(step.on_beam[:, None, None], take(springs, step.wheels), 0.0)
        spring_rows = of_wheels.reshape(-1, shape[-1])
        stiffness, damping = (
            xp.repeat(take(part, step.wheels), NODE_COUNT, axis=0)
            for part in (wheels.stiffness, wheels.damping)
        )

        def contact():
            acceleration = matvec(matrices.contact_response, state)
            deflection, velocity = (matvec(part, state) for part in matrices.springs.response)
            if commands is not None:
                acceleration = acceleration + matrices.commands.contact_response @ commands
                by_command = matrices.springs.commands @ commands
                deflection, velocity = deflection + by_command[0], velocity + by_command[1]
            coupling = spring_coupling(loads, parts, step.wheels)
            on_springs = stiffness * deflection + damping * velocity
            compliance = matrices.springs.compliance
            impedance = stiffness[:, None] * compliance[0][..., None]
            impedance = impedance + damping[:, None] * compliance[1][..., None]
            right = weight + inertia * acceleration + spring_rows
            right = right + matmul_last(coupling, on_springs[:, None])[:, 0]
            system = inertia[:, None] * matrices.contact_compliance[..., None]
            system = system + matmul_last(coupling, impedance)
            system = system + np.eye(right.shape[0])[..., None]
            forces = solve_rows(system, -right)
            return forces, on_springs + matmul_last(impedance, forces[:, None])[:, 0]

        def no_contact():
            return xp.zeros_like(spring_rows), xp.zeros_like(spring_rows)

        forces, on_springs = cond(matrices.loaded, contact, no_contact)
        by_wheel = on_springs.reshape(-1, NODE_COUNT, shape[-1])
        surface = surface + add_at(xp.zeros(shape), step.wheels, by_wheel)
        return forces, xp.concatenate([next_vehicle_states(*t, surface) for t in triples])

    def known_forces(self, step: StepInput):
        """Maps of known steps to contact forces, and to q = k y + c y' of the beam at the rows.

        Both (step, batch, row, column) with columns as in `step.known_maps`; see `advance`.
        """
        matrices, loads, wheels = step.matrices, self.loads, self.loads.wheels
        count, states = step.inertia.shape[0], matrices.state_count
        inertia, weight = (
            np.swapaxes(part, 1, 2)[..., None] for part in (step.inertia, step.weight)
        )
        at_rows = (take(part, step.vehicles.wheels) for part in (wheels.stiffness, wheels.damping))
        stiffness, damping = (
            np.swapaxes(np.repeat(part, NODE_COUNT, axis=1), 1, 2)[..., None] for part in at_rows
        )

        def on_springs(parts):
            return stiffness * parts[:, 0, None] + damping * parts[:, 1, None]

        springs, commands = matrices.springs, matrices.commands
        acceleration, surface = [matrices.contact_response], [on_springs(springs.response)]
        if commands is not None:
            acceleration.append(commands.contact_response)
            surface.append(on_springs(springs.commands))
        inputs = sum(part.shape[-1] for part in acceleration[1:])
        coupling, by_states, by_profile = self._known_springs(step)
        right = np.zeros((*weight.shape[:-1], states + loads.vehicle_states + inputs + 1))
        vehicle_columns = slice(states, states + loads.vehicle_states)
        beam_columns = np.r_[:states, states + loads.vehicle_states : right.shape[-1] - 1]
        surface_map = np.zeros(right.shape)
        surface_map[..., beam_columns] = np.concatenate(surface, axis=-1)
        right[..., beam_columns] = inertia * np.concatenate(acceleration, axis=-1)[:, None]
        right[..., vehicle_columns] = -by_states
        right[..., -1:] = weight + by_profile
        right += coupling @ surface_map
        impedance = on_springs(springs.compliance)
        system = np.eye(weight.shape[2]) + inertia * matrices.contact_compliance[:, None]
        forces = -np.linalg.solve(system + coupling @ impedance, right)
        assert len(forces) == count
        return forces, surface_map + impedance @ forces

    def _known_springs(self, step: StepInput):
        """S and O at the rows, and S q of the profile, of known steps (step, batch, row, ...)."""
        loads, wheels, length = self.loads, step.vehicles.wheels, step.vehicles.length_index
        on_beam = np.repeat(step.vehicles.on_beam, NODE_COUNT, axis=1)[:, None, :, None]
        profile = self._known_profile(step)
        rows = (wheels[..., None] * NODE_COUNT + np.arange(NODE_COUNT)).reshape(len(wheels), -1)
        all_rows = loads.wheel_count * NODE_COUNT
        shape = len(length), profile.shape[1], all_rows
        coupling, by_states = np.zeros((*shape, all_rows)), np.zeros((*shape, loads.vehicle_states))
        first = 0
        for group, part in zip(loads.wheels.vehicles, self.propagators, strict=True):
            of_surface, of_states = (
                np.moveaxis(matrix[length], -1, 1)
                for matrix in (part.spring_surface, part.spring_states)
            )
            states = of_states.shape[-1]
            for i in range(group.count):
                own = _rows_of(group, i)
                coupling[..., own, own] = of_surface
                by_states[..., own, first : first + states] = of_states
                first += states
        by_profile = coupling @ profile
        steps, batch = np.ogrid[: shape[0], : shape[1]]
        index = steps[..., None], batch[..., None], rows[:, None]
        pairs = (
            *(part[..., None] for part in index[:2]),
            rows[:, None, :, None],
            rows[:, None, None],
        )
        return coupling[pairs] * on_beam, by_states[index] * on_beam, by_profile[index] * on_beam

    def _known_profile(self, step: StepInput) -> Float[np.ndarray, "step batch row 1"]:
        """q of the profile at all wheels and nodes of known steps."""
        wheels = self.loads.wheels
        count, batch_size = step.inertia.shape[0], step.inertia.shape[-1]
        rows = self.loads.wheel_count * NODE_COUNT
        if step.vehicles.surface is None:
            return np.zeros((count, batch_size, rows, 1))
        height, rate, _ = np.moveaxis(step.vehicles.surface, 1, 0)[:, :, None]
        stiffness, damping = (part.T[..., None] for part in (wheels.stiffness, wheels.damping))
        return (stiffness * height + damping * rate).reshape(count, batch_size, rows, 1)

    def known_state_maps(self, step: StepInput, surface):
        """Maps of known steps to the states of the vehicles at their ends.

        `surface` is the map to q of the beam at the rows; see `known_forces`.
        """
        loads, wheels, length = self.loads, step.vehicles.wheels, step.vehicles.length_index
        columns, states = surface.shape[-1], step.matrices.state_count
        by_wheel = np.zeros((*surface.shape[:2], loads.wheel_count, NODE_COUNT, columns))
        parts = surface.reshape(*surface.shape[:2], -1, NODE_COUNT, columns)
        parts = parts * step.vehicles.on_beam[:, None, :, None, None]
        step_index, batch_index = np.ogrid[: len(wheels), : surface.shape[1]]
        np.add.at(by_wheel, (step_index[..., None], batch_index[..., None], wheels[:, None]), parts)
        by_row = by_wheel.reshape(*surface.shape[:2], -1, columns)
        by_row[..., -1:] += self._known_profile(step)
        maps, first = [], states
        for group, part in zip(loads.wheels.vehicles, self.propagators, strict=True):
            transition, to_end = (
                np.moveaxis(matrix[length], -1, 1) for matrix in (part.transition, part.input)
            )
            for i in range(group.count):
                next_state = to_end @ by_row[..., _rows_of(group, i), :]
                next_state[..., first : first + transition.shape[-1]] += transition
                first += transition.shape[-1]
                maps.append(next_state)
        return np.concatenate(maps, axis=2)


def _rows_of(group: VehicleGroup, vehicle: int) -> slice:
    """Rows (wheel and node) of a vehicle of a load among those of all wheels."""
    rows = group.wheels_per_vehicle * NODE_COUNT
    start = group.first_wheel * NODE_COUNT + vehicle * rows
    return slice(start, start + rows)


def initial_vehicle_states(loads: LoadSet) -> Float[Array, "state batch"] | None:
    """States of all vehicles at rest in static equilibrium at t = 0; None without any."""
    wheels = loads.wheels
    if not wheels.vehicles:
        return None
    surface = xp.zeros_like(wheels.stiffness)
    motion = loads.surface_motion(*loads.kinematics(xp.zeros(())))
    if motion is not None:
        surface = surface + wheels.stiffness * motion[0][:, None]
    states = [group.initial_state(surface[group.wheels]) for group in wheels.vehicles]
    return xp.concatenate([part.reshape(-1, part.shape[-1]) for part in states])


def solve_rows(
    matrix: Float[Array, "row row batch"], right: Float[Array, "row batch"]
) -> Float[Array, "row batch"]:
    """Solutions of the contact equations; larger ones by a loop, which compiles in a second."""
    if matrix.shape[0] <= MAX_UNROLLED_ROWS or not any_jax(matrix, right):
        return solve_small(matrix, right[:, None])[:, 0]
    by_run = jax.vmap(solve_unpivoted, in_axes=(-1, -1), out_axes=-1)
    return by_run(matrix, right[:, None])[:, 0]


def vehicles_of(loads: LoadSet, lengths: Float[Array, " length"]) -> Vehicles | None:
    """Vehicles of the loads for steps of the given lengths (s); None without any."""
    groups = loads.wheels.vehicles
    if not groups:
        return None
    return Vehicles(loads, tuple(vehicle_propagators(group, lengths) for group in groups))
