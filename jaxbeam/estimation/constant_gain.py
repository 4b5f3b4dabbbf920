"""Filter with a constant gain: prediction to the next sample, correction by the readings."""

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.estimator import AbstractSampledFilter, Estimate
from jaxbeam.estimation.sampled_plant import Transition
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, xp


class ConstantGainFilter(AbstractSampledFilter):
    """x = prediction + gain (y - C prediction - D u - offset), with the `transition` of a period.

    A missing reading corrects nothing.

    The first `plant_states` states x are those of the plant; states of the sensors may follow. The
    state of the filter is x and the command of the last sample.
    """

    transition: Transition
    C: Float[Array, "sensor state"]
    D: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    gain: Float[Array, "state sensor"]
    plant_states: int = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros(self.C.shape[1]), xp.zeros(self.D.shape[1])

    def update(self, state, measurement, t):
        x, command = state[0], measurement.command
        x = self.transition.predict(x, state[1], command)
        innovation = measurement.innovation(self.offset + self.C @ x + self.D @ command)
        x = x + self.gain @ innovation
        return Estimate(x[: self.plant_states]), (x, command)


def sensor_offsets(plant: Plant) -> Float[Array, " sensor"]:
    """Offsets of the sensors, in the units of their quantities."""
    return xp.array([sensor.offset for sensor in plant.case.sensors]).reshape(-1)
