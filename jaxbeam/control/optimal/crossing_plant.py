"""Beam under moving loads as a constant plant coupled to time-varying contact forces."""

import numpy as np

from jaxbeam.model.contact import surface_rows
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.coupled_stages import ConstantPlant, Coupling
from jaxbeam.numerics.finite_horizon import CouplingFunction
from jaxbeam.runtime.arrays import xp


def crossing_plant(plant: Plant, with_weights: bool) -> tuple[ConstantPlant, CouplingFunction]:
    """Plant without loads, and the coupling by contact forces r at given times (s), in its states.

    With `with_weights` the weights W of the loads are further, constant states, as in
    `Plant.augmented`. The contact law is r = -W - m (rows z + S (S' r + forces of the commands)),
    with the mode shapes S at the loads.
    """
    modal_model, load_count = plant.modal_model, plant.weights.shape[0]
    modes, states = plant.coordinate_scale.shape[0], modal_model.state_count
    rates = np.arange(1, 2 * modes, 2)
    unloaded, weight_states = plant.unloaded, load_count if with_weights else 0
    unloaded_plant = ConstantPlant(
        xp.pad(unloaded.A, (0, weight_states)),
        xp.pad(unloaded.B, ((0, weight_states), (0, 0))),
        xp.pad(plant.from_modal(xp.eye(states)[:, rates]), ((0, weight_states), (0, 0))),
    )
    to_modal, command_rows = plant.to_modal(xp.eye(states)), modal_model.command_matrix[rates]
    mass = plant.loads.inertia

    def contact_coupling(times):
        position, speed, acceleration = plant.loads.kinematics(times)
        active = plant.loads.on_beam(times)
        motion = surface_rows(modal_model, position, speed, acceleration, active)
        shape, rows = (
            xp.moveaxis(part.reshape(*active.shape, -1), 0, -2)
            for part in (motion.shape, motion.acceleration)
        )
        weight_columns = xp.broadcast_to(
            xp.eye(load_count)[:, :weight_states], (*times.shape, load_count, weight_states)
        )
        return Coupling(
            force_distribution=xp.swapaxes(shape, -1, -2),
            force_state_rows=xp.concatenate([-mass * (rows @ to_modal), -weight_columns], axis=-1),
            command_feedthrough=-mass * (shape @ command_rows),
            force_feedthrough=mass * (shape @ xp.swapaxes(shape, -1, -2)),
        )

    return unloaded_plant, contact_coupling
