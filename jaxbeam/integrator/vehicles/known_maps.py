"""Steps of vehicles with known numbers, as maps of states: all steps at once in NumPy.

The same equations as `Vehicles.advance`, for all steps before the states are known.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles
from jaxbeam.model.load_set import VehicleGroup
from jaxbeam.runtime.arrays import take


def known_forces(vehicles: Vehicles, step: StepInput):
    """Maps of known steps to contact forces, and to q = k y + c y' of the beam at the rows.

    Both (step, batch, row, column), with columns of state, commands, and one; see `advance`.
    """
    matrices, loads, wheels = step.matrices, vehicles.loads, vehicles.loads.wheels
    states = matrices.state_count
    inertia, weight = (np.swapaxes(part, 1, 2)[..., None] for part in (step.inertia, step.weight))
    at_rows = (take(part, step.vehicles.wheels) for part in (wheels.stiffness, wheels.damping))
    stiffness, damping = (
        np.swapaxes(np.repeat(part, NODE_COUNT, axis=1), 1, 2)[..., None] for part in at_rows
    )

    def on_springs(parts):
        return stiffness * parts[:, 0, None] + damping * parts[:, 1, None]

    springs, commands = matrices.springs, matrices.commands
    acceleration: list[Any] = [matrices.contact_response]
    surface: list[Any] = [on_springs(springs.response)]
    if commands is not None:
        acceleration.append(commands.contact_response)
        surface.append(on_springs(springs.commands))
    inputs = sum(part.shape[-1] for part in acceleration[1:])
    coupling, by_states, by_profile = _springs(vehicles, step)
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
    return forces, surface_map + impedance @ forces


def _springs(vehicles: Vehicles, step: StepInput):
    """S and O at the rows, and S q of the profile, of known steps (step, batch, row, ...)."""
    loads, wheels, length = vehicles.loads, step.vehicles.wheels, step.vehicles.length_index
    on_beam = np.repeat(step.vehicles.on_beam, NODE_COUNT, axis=1)[:, None, :, None]
    profile = _profile(vehicles, step)
    rows = (wheels[..., None] * NODE_COUNT + np.arange(NODE_COUNT)).reshape(len(wheels), -1)
    all_rows = loads.wheel_count * NODE_COUNT
    shape = len(length), profile.shape[1], all_rows
    coupling, by_states = np.zeros((*shape, all_rows)), np.zeros((*shape, loads.vehicle_states))
    first = 0
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
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


def _profile(vehicles: Vehicles, step: StepInput) -> Float[np.ndarray, "step batch row 1"]:
    """q of the profile at all wheels and nodes of known steps."""
    wheels = vehicles.loads.wheels
    count, batch_size = step.inertia.shape[0], step.inertia.shape[-1]
    rows = vehicles.loads.wheel_count * NODE_COUNT
    if step.vehicles.surface is None:
        return np.zeros((count, batch_size, rows, 1))
    height, rate, _ = np.moveaxis(step.vehicles.surface, 1, 0)[:, :, None]
    stiffness, damping = (part.T[..., None] for part in (wheels.stiffness, wheels.damping))
    return (stiffness * height + damping * rate).reshape(count, batch_size, rows, 1)


def known_state_maps(vehicles: Vehicles, step: StepInput, surface):
    """Maps of known steps to the states of the vehicles at their ends.

    `surface` is the map to q of the beam at the rows; see `known_forces`.
    """
    loads, wheels, length = vehicles.loads, step.vehicles.wheels, step.vehicles.length_index
    columns, states = surface.shape[-1], step.matrices.state_count
    by_wheel = np.zeros((*surface.shape[:2], loads.wheel_count, NODE_COUNT, columns))
    parts = surface.reshape(*surface.shape[:2], -1, NODE_COUNT, columns)
    parts = parts * step.vehicles.on_beam[:, None, :, None, None]
    step_index, batch_index = np.ogrid[: len(wheels), : surface.shape[1]]
    np.add.at(by_wheel, (step_index[..., None], batch_index[..., None], wheels[:, None]), parts)
    by_row = by_wheel.reshape(*surface.shape[:2], -1, columns)
    by_row[..., -1:] += _profile(vehicles, step)
    maps, first = [], states
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
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
