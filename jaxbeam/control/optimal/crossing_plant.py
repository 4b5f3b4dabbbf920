"""Beam under moving loads as a constant plant coupled to time-varying contact forces."""

import numpy as np

from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.state_space import Plant
from jaxbeam.model.vehicles.contact_rows import (
    contact_rows,
    has_known_disturbance,
    known_disturbance,
    vehicle_system,
)
from jaxbeam.numerics.coupled_stages import ConstantPlant, Coupling
from jaxbeam.numerics.finite_horizon import CouplingFunction
from jaxbeam.runtime.arrays import block_diag, set_at, xp


def crossing_plant(plant: Plant, with_weights: bool) -> tuple[ConstantPlant, CouplingFunction]:
    """Plant without loads, and the coupling by forces at given times (s), in its states.

    These are the contact forces r and, with vehicles, the forces q of the surface on their springs;
    the states are those of beam and vehicles. With `with_weights` the weights W of the loads, and
    one for what else is known to disturb, are further, constant states, as in `Plant.augmented`.
    The law is that of `contact_rows`.
    """
    modal_model, load_count = plant.modal_model, plant.weights.shape[0]
    states, vehicles = modal_model.state_count, plant.vehicle_states
    disturbed = with_weights and has_known_disturbance(plant.loads)
    constants = load_count + disturbed if with_weights else 0
    rates = modal_model.rate_index
    unloaded, added = plant.unloaded, vehicles + constants
    to_modal, command_rows = plant.to_modal(xp.eye(states)), modal_model.command_matrix[rates]
    directions = plant.from_modal(xp.eye(states)[:, rates])
    state_matrix, sprung = unloaded.A, _sprung_wheels(plant.loads)
    if vehicles:
        A, B, _ = vehicle_system(plant.loads)
        state_matrix, directions = block_diag(state_matrix, A), block_diag(directions, B[:, sprung])
    unloaded_plant = ConstantPlant(
        xp.pad(state_matrix, (0, constants)),
        xp.pad(unloaded.B, ((0, added), (0, 0))),
        xp.pad(directions, ((0, states + added - directions.shape[0]), (0, 0))),
    )

    def contact_coupling(times):
        contact = contact_rows(modal_model, plant.loads, times)
        shape, mass = contact.shape, plant.loads.inertia
        force_rows = xp.concatenate(
            [-contact.force[..., :states] @ to_modal, -contact.force[..., states:]], axis=-1
        )
        constant_columns = -xp.eye(load_count, constants)
        constant_columns = xp.broadcast_to(
            constant_columns, (*times.shape, *constant_columns.shape)
        )
        known = known_disturbance(plant.loads, times) if disturbed else None
        if known is not None:
            constant_columns = set_at(constant_columns, np.s_[..., -1], -known[0])
        distribution = xp.swapaxes(shape, -1, -2)
        coupling = Coupling(
            force_distribution=distribution,
            force_state_rows=xp.concatenate([force_rows, constant_columns], axis=-1),
            command_feedthrough=-mass * (shape @ command_rows),
            force_feedthrough=mass * (shape @ distribution),
        )
        if not vehicles:
            return coupling
        assert contact.surface is not None
        surface_rows = contact.surface[..., sprung, :] @ to_modal
        surface_rows = xp.pad(surface_rows, [(0, 0)] * (surface_rows.ndim - 1) + [(0, added)])
        if known is not None:
            surface_rows = set_at(surface_rows, np.s_[..., -1], known[1][..., sprung])
        return _with_springs(coupling, surface_rows)

    return unloaded_plant, contact_coupling


def _with_springs(coupling: Coupling, surface_rows) -> Coupling:
    """Coupling with the forces on springs of the vehicles as further forces."""
    count, lead = surface_rows.shape[-2], [(0, 0)] * (surface_rows.ndim - 2)
    identity = xp.broadcast_to(xp.eye(count), (*surface_rows.shape[:-2], count, count))
    wheels = coupling.force_distribution.shape[-1]
    below = xp.pad(identity, [*lead, (0, 0), (wheels, 0)])
    beside = xp.pad(coupling.force_distribution, [*lead, (0, 0), (0, count)])
    return Coupling(
        force_distribution=xp.concatenate([beside, below], axis=-2),
        force_state_rows=xp.concatenate([coupling.force_state_rows, surface_rows], axis=-2),
        command_feedthrough=xp.pad(coupling.command_feedthrough, [*lead, (0, count), (0, 0)]),
        force_feedthrough=xp.pad(coupling.force_feedthrough, [*lead, (0, count), (0, count)]),
    )


def _sprung_wheels(loads: LoadSet) -> np.ndarray:
    """Indices of the wheels of vehicles."""
    parts = [np.arange(group.wheels.start, group.wheels.stop) for group in loads.wheels.vehicles]
    return np.concatenate(parts) if parts else np.zeros(0, int)
