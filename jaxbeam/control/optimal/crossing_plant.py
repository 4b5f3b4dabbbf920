"""The beam under its loads as a plant that changes in time only by the contact forces."""

import jax.numpy as jnp
import numpy as np

from jaxbeam.model.contact import contact_rows
from jaxbeam.model.state_space import LoadedBeam
from jaxbeam.numerics.coupled_stages import Coupling, Plant
from jaxbeam.numerics.finite_horizon import Changes


def coupled_beam(model: LoadedBeam, weights: bool) -> tuple[Plant, Changes]:
    """The rig of a model, and its contact forces r at given times (s), both in its states.

    With `weights`, those of the loads are further, constant states, as in `LoadedBeam.augmented`.
    The contact law is r = -W - m (rows z + S (S' r + forces of the commands)), S being the shapes.
    """
    rig, loads = model.rig, model.weights.shape[0]
    modes, states = model.scale.shape[0], rig.states
    rates = np.arange(1, 2 * modes, 2)
    free, more = model.unloaded, loads if weights else 0
    plant = Plant(
        jnp.pad(free.A, (0, more)),
        jnp.pad(free.B, ((0, more), (0, 0))),
        jnp.pad(model.from_rig(jnp.eye(states)[:, rates]), ((0, more), (0, 0))),
    )
    to_rig, pushed = model.to_rig(jnp.eye(states)), rig.command_matrix[rates]
    mass = model.traffic.inertia

    def changes(times):
        position, speed, acceleration = model.traffic.travel(times)
        active = model.traffic.on_beam(times)
        shape, rows = (
            jnp.moveaxis(part.reshape(*active.shape, -1), 0, -2)
            for part in contact_rows(rig, position, speed, acceleration, active)
        )
        known = jnp.broadcast_to(jnp.eye(loads)[:, :more], (*times.shape, loads, more))
        return Coupling(
            shape=jnp.swapaxes(shape, -1, -2),
            rows=jnp.concatenate([-mass * (rows @ to_rig), -known], axis=-1),
            direct=-mass * (shape @ pushed),
            back=mass * (shape @ jnp.swapaxes(shape, -1, -2)),
        )

    return plant, changes
