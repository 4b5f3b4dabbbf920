"""Steps of vehicles as maps of states: those of all steps at once, before the states are known.

With the motion of the beam y = R z + G f + D u under the wheels at the nodes of a step, and the
forces s = S (k y + c y') - O z_v of the springs (see `vehicles.propagators`), the contact law

    f = -W - m y'' - s

is solved for f as an affine function of the states z of the beam and z_v of the vehicles, and of
the commands u; the states of the vehicles at the end of the step follow.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles, VehicleStep
from jaxbeam.model.load_set import VehicleGroup
from jaxbeam.runtime.arrays import Array, add_at, solve_conditioned, take, with_blocks, xp


def vehicle_maps(vehicles: Vehicles, step: StepInput):
    """Linear part and offset of the map to contact forces, and both of that to vehicles' states.

    All (step, batch, row, column); columns are states of the beam, of the vehicles, and commands.
    """
    matrices, loads, wheels = step.matrices, vehicles.loads, vehicles.loads.wheels
    steps, batch = step.inertia.shape[0], step.inertia.shape[-1]
    inertia, weight = (xp.swapaxes(part, 1, 2)[..., None] for part in (step.inertia, step.weight))
    at_rows = (take(part, step.vehicles.wheels) for part in (wheels.stiffness, wheels.damping))
    stiffness, damping = (
        xp.swapaxes(xp.repeat(part, NODE_COUNT, axis=1), 1, 2)[..., None] for part in at_rows
    )

    def on_springs(parts):
        return stiffness * parts[:, 0, None] + damping * parts[:, 1, None]

    springs, commands = matrices.springs, matrices.commands
    rows = matrices.contact_response.shape[1]
    no_vehicles = np.zeros((steps, batch, rows, loads.vehicle_states))
    surface = [on_springs(springs.response), no_vehicles]
    by_commands = no_vehicles[..., :0]
    if commands is not None:
        surface.append(on_springs(springs.commands))
        by_commands = inertia * commands.contact_response[:, None]
    coupling, by_states, by_profile = springs_of_wheels(vehicles, step.vehicles, batch)
    surface = xp.concatenate(surface, axis=-1)
    by_beam = inertia * matrices.contact_response[:, None]
    right = xp.concatenate([by_beam, -by_states, by_commands], axis=-1) + coupling @ surface
    right = xp.concatenate([right, weight + by_profile], axis=-1)
    impedance = on_springs(springs.compliance)
    system = np.eye(rows) + inertia * matrices.contact_compliance[:, None]
    forces = -solve_conditioned(system + coupling @ impedance, right)
    surface = xp.concatenate([surface, np.zeros((*surface.shape[:-1], 1))], axis=-1)
    of_vehicles = _state_maps(vehicles, step, surface + impedance @ forces)
    of_vehicles = of_vehicles[..., :-1], of_vehicles[..., -1:]
    return forces[..., :-1], forces[..., -1:], of_vehicles


def springs_of_wheels(vehicles: Vehicles, step: VehicleStep, batch: int):
    """S and O at the rows, and S q of the profile, of the steps (step, batch, row, ...)."""
    loads, wheels, length = vehicles.loads, step.wheels, step.length_index
    on_beam = xp.repeat(step.on_beam, NODE_COUNT, axis=1)[:, None, :, None]
    profile = _profile(vehicles, step, batch)
    rows = (wheels[..., None] * NODE_COUNT + np.arange(NODE_COUNT)).reshape(len(wheels), -1)
    all_rows = loads.wheel_count * NODE_COUNT
    shape = len(length), profile.shape[1], all_rows
    coupling_blocks, state_blocks, first = [], [], 0
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
        of_surface, of_states = (
            xp.moveaxis(take(matrix, length), -1, 1)
            for matrix in (part.spring_surface, part.spring_states)
        )
        states = of_states.shape[-1]
        for i in range(group.count):
            own = _rows_of(group, i)
            coupling_blocks.append((np.s_[..., own, own], of_surface))
            state_blocks.append((np.s_[..., own, first : first + states], of_states))
            first += states
    coupling = with_blocks((*shape, all_rows), coupling_blocks)
    by_states = with_blocks((*shape, loads.vehicle_states), state_blocks)
    by_profile = coupling @ profile
    of_steps, of_batch = np.ogrid[: shape[0], : shape[1]]
    index = of_steps[..., None], of_batch[..., None], rows[:, None]
    pairs = (
        *(part[..., None] for part in index[:2]),
        rows[:, None, :, None],
        rows[:, None, None],
    )
    return (
        take(coupling, pairs) * on_beam,
        take(by_states, index) * on_beam,
        take(by_profile, index) * on_beam,
    )


def _profile(vehicles: Vehicles, step: VehicleStep, batch: int) -> Float[Array, "step batch row 1"]:
    """q of the profile at all wheels and nodes of the steps."""
    wheels = vehicles.loads.wheels
    shape = len(step.wheels), batch, vehicles.loads.wheel_count * NODE_COUNT, 1
    if step.surface is None:
        return xp.zeros(shape)
    height, rate, _ = xp.moveaxis(step.surface, 1, 0)[:, :, None]
    stiffness, damping = (part.T[..., None] for part in (wheels.stiffness, wheels.damping))
    return (stiffness * height + damping * rate).reshape(shape)


def _state_maps(vehicles: Vehicles, step: StepInput, surface):
    """Maps of the steps to the states of the vehicles at their ends; the last column is of one.

    `surface` is the map to q = k y + c y' of the beam at the rows.
    """
    loads, wheels, length = vehicles.loads, step.vehicles.wheels, step.vehicles.length_index
    (steps, batch, _, columns), states = surface.shape, step.matrices.state_count
    parts = surface.reshape(steps, batch, -1, NODE_COUNT, columns)
    parts = parts * step.vehicles.on_beam[:, None, :, None, None]
    step_index, batch_index = np.ogrid[:steps, :batch]
    by_wheel = add_at(
        np.zeros((steps, batch, loads.wheel_count, NODE_COUNT, columns)),
        (step_index[..., None], batch_index[..., None], wheels[:, None]),
        parts,
    )
    by_row = by_wheel.reshape(steps, batch, -1, columns)
    if step.vehicles.surface is not None:
        by_row = add_at(by_row, np.s_[..., -1:], _profile(vehicles, step.vehicles, batch))
    maps, first = [], states
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
        transition, to_end = (
            xp.moveaxis(take(matrix, length), -1, 1) for matrix in (part.transition, part.input)
        )
        for i in range(group.count):
            own = slice(first, first + transition.shape[-1])
            next_state = to_end @ by_row[..., _rows_of(group, i), :]
            maps.append(add_at(next_state, np.s_[..., own], transition))
            first = own.stop
    return xp.concatenate(maps, axis=2)


def _rows_of(group: VehicleGroup, vehicle: int) -> slice:
    """Rows (wheel and node) of a vehicle of a load among those of all wheels."""
    rows = group.wheels_per_vehicle * NODE_COUNT
    start = group.first_wheel * NODE_COUNT + vehicle * rows
    return slice(start, start + rows)
