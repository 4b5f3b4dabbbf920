"""Estimators at every instant: the model, and a gain times what surprises it, as rates.

    x' = A(t) x + B u + L(t) (y - C x - offset)

The estimate x joins the states of the plant, so it is integrated with them, to the same accuracy.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.estimator import Estimate
from jaxbeam.estimation.sensor_chain import FilteredPlant
from jaxbeam.model.state_space import StateSpace


class ContinuousEstimator(eqx.Module):
    """Memory of an estimator at every instant: its model and its gain, neither of which changes.

    The estimate starts at `initial_state`; its first `plant_states` states are those of the plant. Either a `unloaded`
    model without loads has a constant `gain`. Or the loads are followed in a `filtered_plant`, and the gain
    is a `gain_table` (`GainTable`) along the run, transposed and backward, over `duration` (s): then
    states of analogue filters follow those of the plant, and the weights of the loads, which are
    told if `estimates_weights`.
    """

    offset: Float[Array, " sensor"]
    initial_state: Float[Array, " state"]
    plant_states: int = eqx.field(static=True)
    unloaded: StateSpace | None = None
    gain: Float[Array, "state sensor"] | None = None
    filtered_plant: FilteredPlant | None = None
    gain_table: Any = None
    duration: Float[Array, ""] | None = None
    estimates_weights: bool = eqx.field(static=True, default=False)

    def system_at(self, t: Float[Array, ""]) -> StateSpace:
        """The model at a time (s), its outputs what the sensors see."""
        if self.unloaded is not None:
            return self.unloaded
        return self.filtered_plant.with_filtered_outputs(self.filtered_plant.plant.augmented(t))

    def estimate(self, deviation: Float[Array, " state"], t: Float[Array, ""]) -> Estimate:
        """What is believed at a time (s), `deviation` being how far it has come from the start."""
        state = self.initial_state + deviation
        if not self.estimates_weights:
            return Estimate(state[: self.plant_states])
        plant = self.filtered_plant.plant
        weights = state[plant.modal_model.state_count :]
        return Estimate(state[: self.plant_states], jnp.where(plant.loads.on_beam(t), weights, 0.0))

    def rates(
        self,
        deviation: Float[Array, " state"],
        readings: Float[Array, " sensor"],
        command: Float[Array, " actuator"],
        t: Float[Array, ""],
    ) -> Float[Array, " state"]:
        """Rates of the estimate for readings and commands at a time (s)."""
        system, state = self.system_at(t), self.initial_state + deviation
        innovation = readings - self.offset - system.C @ state - system.D @ command
        return system.A @ state + system.B @ command + self.gain_at(t) @ innovation

    def gain_at(self, t: Float[Array, ""]) -> Float[Array, "state sensor"]:
        """The gain at a time (s)."""
        if self.gain is not None:
            return self.gain
        return self.gain_table(1 - t / self.duration).T
