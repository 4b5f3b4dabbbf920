"""An estimator with a gain that does not change: predict from tick to tick, then correct."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement
from jaxbeam.estimation.sampled_plant import Transition
from jaxbeam.model.state_space import LoadedBeam


class FixedGain(eqx.Module):
    """Memory of such an estimator: its design, the state it believes in, the command before.

    The reading expected of a state is C x + D u + offset. The first `own` states are those of the
    plant, which others may follow that the sensors add.
    """

    transition: Transition
    C: Float[Array, "sensor state"]
    D: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    gain: Float[Array, "state sensor"]
    state: Float[Array, " state"]
    command: Float[Array, " actuator"]
    own: int = eqx.field(static=True)

    @property
    def plant_state(self) -> Float[Array, " own"]:
        """The states of the plant."""
        return self.state[: self.own]

    def corrected(self, measurement: Measurement) -> "FixedGain":
        """The memory after the next tick."""
        now = measurement.command
        state = self.transition.mean(self.state, self.command, now)
        surprise = measurement.readings - self.offset - self.C @ state - self.D @ now
        return dataclasses.replace(self, state=state + self.gain @ surprise, command=now)


def at_rest(
    model: LoadedBeam,
    transition: Transition,
    C: Float[Array, "sensor state"],
    D: Float[Array, "sensor actuator"],
    gain: Float[Array, "state sensor"],
) -> FixedGain:
    """The memory at the start of a run, from rest."""
    state, command = jnp.zeros(C.shape[1]), jnp.zeros(D.shape[1])
    return FixedGain(transition, C, D, offsets(model), gain, state, command, model.rig.states)


def offsets(model: LoadedBeam) -> Float[Array, " sensor"]:
    """The constants that sensors add to what they read."""
    return jnp.array([sensor.offset for sensor in model.case.sensors]).reshape(-1)
