"""Steps of vehicles on the beam: contact forces at the Gauss nodes, and states at the end.

See `vehicle_propagators` for the response of a vehicle to the surface under its wheels.
"""

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.integrator.vehicles.propagators import (
    VehiclePropagators,
    next_vehicle_states,
    spring_coupling,
    spring_forces,
    vehicle_propagators,
)
from jaxbeam.model.contact import forces_of_wheels, split_states
from jaxbeam.model.load_set import LoadSet
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
    take,
    xp,
)
from jaxbeam.runtime.module import Module

MAX_UNROLLED_ROWS = 24  # of contact equations whose elimination is spelt out


class VehicleStep(Module):
    """Wheels of the rows of a step, and the surface, for each step of a chunk.

    `length_index` is that of the step's length; `on_beam` tells which wheels are there; `surface`
    is the motion of the profile under all wheels (see `LoadPath`).
    """

    length_index: Int[Array, " *step"]
    wheels: Int[Array, "*step wheel"]
    on_beam: Bool[Array, "*step wheel"]
    surface: Float[Array, "*step 3 all node"] | None


class StepInput(Module):
    """What a step of a batch takes: matrices, and inertia (kg) and weight (N) of the rows.

    The weight includes the inertia forces of the profile. Without vehicles, `vehicles` is None.
    """

    matrices: StepMatrices
    inertia: Float[Array, "*step row batch"]
    weight: Float[Array, "*step row batch"]
    vehicles: VehicleStep | None


class Vehicles(Module):
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
        inertia, weight, wheel_step = step.inertia, step.weight, step.vehicles
        assert wheel_step is not None
        parts = tuple(
            jax.tree.map(
                lambda part: index_in_dim(part, wheel_step.length_index, keepdims=False), part
            )
            for part in self.propagators
        )
        state, vehicle_states = split_states(matrices.state_count, loads, state)
        shape = (loads.wheel_count, NODE_COUNT, state.shape[-1])
        surface = xp.zeros(shape)
        if wheel_step.surface is not None:
            height, rate, _ = wheel_step.surface[..., None]
            surface = wheels.stiffness[:, None] * height + wheels.damping[:, None] * rate
        triples = list(zip(parts, wheels.vehicles, vehicle_states, strict=True))
        springs = forces_of_wheels(loads, [spring_forces(*t, surface) for t in triples], surface, 0)
        # Rows are wheel and node.
        of_wheels = xp.where(
            wheel_step.on_beam[:, None, None], take(springs, wheel_step.wheels), 0.0
        )
        spring_rows = of_wheels.reshape(-1, shape[-1])
        stiffness, damping = (
            xp.repeat(take(part, wheel_step.wheels), NODE_COUNT, axis=0)
            for part in (wheels.stiffness, wheels.damping)
        )

        def contact():
            acceleration = matvec(matrices.contact_response, state)
            deflection, velocity = (matvec(part, state) for part in matrices.springs.response)
            if commands is not None:
                acceleration = acceleration + matrices.commands.contact_response @ commands
                by_command = matrices.springs.commands @ commands
                deflection, velocity = deflection + by_command[0], velocity + by_command[1]
            coupling = spring_coupling(loads, parts, wheel_step.wheels)
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
        surface = surface + add_at(xp.zeros(shape), wheel_step.wheels, by_wheel)
        return forces, xp.concatenate([next_vehicle_states(*t, surface) for t in triples])


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
