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
from jaxbeam.numerics.batched_linalg import matvec, solve_small, solve_unpivoted
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
    `spring_states` is O and `spring_surface` is S.
    """

    transition: Float[Array, "*length state state batch"]
    input: Float[Array, "*length node state wheel batch"]
    spring_states: Float[Array, "*length wheel node state batch"]
    spring_surface: Float[Array, "*length wheel node wheel node batch"]


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
    scale = xp.concatenate([xp.broadcast_to(frequency, (dofs, *frequency.shape)), np.ones((dofs, *frequency.shape))])
    scale = stop_gradient(scale)
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
    spring_states = xp.einsum("wsb,lcstb->lwctb", H, transition[:, nodes])
    response = xp.einsum("wsb,lcfsvb->lwcvfb", H, inputs[:, nodes])
    wheels = H.shape[0]
    identity = np.eye(wheels * NODE_COUNT).reshape(wheels, NODE_COUNT, wheels, NODE_COUNT, 1)
    return VehiclePropagators(
        transition=transition[:, -1] / scale[:, None] * scale,
        input=inputs[:, -1] / scale[:, None],
        spring_states=spring_states * scale,
        spring_surface=identity - response,
    )


def free_spring_forces(
    propagators: VehiclePropagators, group: VehicleGroup, states, surface
) -> Float[Array, "node wheel batch"]:
    """Forces s of the springs of a load at the nodes of a step.

    From the states (vehicle, state, batch) and q of the surface (node, wheel, batch).
    """
    by_vehicle = surface.reshape(surface.shape[0], group.count, -1, surface.shape[-1])
    forces = xp.einsum("wcvfb,fnvb->cnwb", propagators.spring_surface, by_vehicle) - xp.einsum(
        "wctb,ntb->cnwb", propagators.spring_states, states
    )
    return forces.reshape(surface.shape)


def next_vehicle_states(
    propagators: VehiclePropagators, group: VehicleGroup, states, surface
) -> Float[Array, "vehicle state batch"]:
    """States at the end of a step, from those at its start and q of the surface."""
    by_vehicle = surface.reshape(surface.shape[0], group.count, -1, surface.shape[-1])
    return xp.einsum("stb,ntb->nsb", propagators.transition, states) + xp.einsum(
        "fswb,fnwb->nsb", propagators.input, by_vehicle
    )


def spring_coupling(loads: LoadSet, propagators, wheels) -> Float[Array, "row row batch"]:
    """Matrix S between the rows (wheel and node) of some wheels; zero between vehicles."""
    count, coupling = wheels.shape[0], None
    for group, part in zip(loads.wheels.vehicles, propagators, strict=True):
        within = (wheels >= group.wheels.start) & (wheels < group.wheels.stop)
        index = xp.where(within, wheels - group.first_wheel, 0)
        vehicle, wheel = index // group.wheels_per_vehicle, index % group.wheels_per_vehicle
        same = within[:, None] & within & (vehicle[:, None] == vehicle)
        rows = xp.take(xp.take(part.spring_surface, wheel, axis=0), wheel, axis=2)
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
        shape = (NODE_COUNT, loads.wheel_count, state.shape[-1])
        surface = xp.zeros(shape)
        if step.surface is not None:
            height, rate, _ = (xp.swapaxes(part, 0, 1)[..., None] for part in step.surface)
            surface = wheels.stiffness * height + wheels.damping * rate
        triples = list(zip(parts, wheels.vehicles, vehicle_states, strict=True))
        springs = [free_spring_forces(*three, surface[:, three[1].wheels]) for three in triples]
        springs = forces_of_wheels(loads, springs, surface)
        # Rows are wheel and node.
        of_wheels = xp.moveaxis(xp.take(springs, step.wheels, axis=1), 0, 1)
        of_wheels = xp.where(step.on_beam[:, None, None], of_wheels, 0.0)
        spring_rows = of_wheels.reshape(-1, of_wheels.shape[-1])
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
            right = right + xp.einsum("ijb,jb->ib", coupling, on_springs)
            system = inertia[:, None] * matrices.contact_compliance[..., None]
            system = system + xp.einsum("ijb,jkb->ikb", coupling, impedance)
            system = system + np.eye(right.shape[0])[..., None]
            forces = solve_rows(system, -right)
            return forces, on_springs + xp.einsum("ijb,jb->ib", impedance, forces)

        def no_contact():
            return xp.zeros_like(spring_rows), xp.zeros_like(spring_rows)

        forces, on_springs = cond(matrices.loaded, contact, no_contact)
        by_wheel = on_springs.reshape(-1, NODE_COUNT, on_springs.shape[-1])
        by_wheel = add_at(xp.zeros((shape[1], shape[0], shape[2])), step.wheels, by_wheel)
        surface = surface + xp.swapaxes(by_wheel, 0, 1)
        next_states = [
            next_vehicle_states(*three, surface[:, three[1].wheels]).reshape(-1, shape[-1])
            for three in triples
        ]
        return forces, xp.concatenate(next_states)


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
