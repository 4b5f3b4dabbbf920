"""An estimator with a gain that does not change: predict from tick to tick, then correct."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement
from jaxbeam.estimation.sampled_plant import Transition
from jaxbeam.model.state_space import Plant


class ConstantGainFilter(eqx.Module):
    """Memory of such an estimator: its design, the state it believes in, the command before.

    The reading expected of a state is C x + D u + offset. The first `plant_states` states are those of the
    plant, which others may follow that the sensors add.
    """

    transition: Transition
    C: Float[Array, "sensor state"]
    D: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    gain: Float[Array, "state sensor"]
    state: Float[Array, " state"]
    command: Float[Array, " actuator"]
    plant_states: int = eqx.field(static=True)

    @property
    def plant_state(self) -> Float[Array, " plant_states"]:
        """The states of the plant."""
        return self.state[: self.plant_states]

    def update(self, measurement: Measurement) -> "ConstantGainFilter":
        """The memory after the next tick."""
        command = measurement.command
        state = self.transition.predict(self.state, self.command, command)
        innovation = measurement.readings - self.offset - self.C @ state - self.D @ command
        return dataclasses.replace(self, state=state + self.gain @ innovation, command=command)


def constant_gain_filter(
    plant: Plant,
    transition: Transition,
    C: Float[Array, "sensor state"],
    D: Float[Array, "sensor actuator"],
    gain: Float[Array, "state sensor"],
) -> ConstantGainFilter:
    """The memory at the start of a run, from rest."""
    state, command = jnp.zeros(C.shape[1]), jnp.zeros(D.shape[1])
    return ConstantGainFilter(
        transition, C, D, sensor_offsets(plant), gain, state, command, plant.modal_model.state_count
    )


def sensor_offsets(plant: Plant) -> Float[Array, " sensor"]:
    """The constants that sensors add to what they read."""
    return jnp.array([sensor.offset for sensor in plant.case.sensors]).reshape(-1)
