"""Estimators at every instant: the model, and a gain times what surprises it, as rates.

    x' = A(t) x + B u + L(t) (y - C x - offset)

The estimate x joins the states of the plant, so it is integrated with them, to the same accuracy.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.estimator import Estimate
from jaxbeam.estimation.sensor_chain import Sight
from jaxbeam.model.state_space import StateSpace


class Flowing(eqx.Module):
    """Memory of an estimator at every instant: its model and its gain, neither of which changes.

    The estimate starts at `start`; its first `own` states are those of the plant. Either a `still`
    model without loads has a constant `gain`. Or the loads are followed in a `view`, and the gain
    is a `table` (`GainTable`) along the run, transposed and backward, over `duration` (s): then
    states of analogue filters follow those of the plant, and the weights of the loads, which are
    told if `sought`.
    """

    offset: Float[Array, " sensor"]
    start: Float[Array, " state"]
    own: int = eqx.field(static=True)
    still: StateSpace | None = None
    gain: Float[Array, "state sensor"] | None = None
    view: Sight | None = None
    table: Any = None
    duration: Float[Array, ""] | None = None
    sought: bool = eqx.field(static=True, default=False)

    def plant(self, t: Float[Array, ""]) -> StateSpace:
        """The model at a time (s), its outputs what the sensors see."""
        if self.still is not None:
            return self.still
        return self.view.behind(self.view.model.augmented(t))

    def estimate(self, moved: Float[Array, " state"], t: Float[Array, ""]) -> Estimate:
        """What is believed at a time (s), `moved` being how far it has come from the start."""
        state = self.start + moved
        if not self.sought:
            return Estimate(state[: self.own])
        model = self.view.model
        weights = state[model.rig.states :]
        return Estimate(state[: self.own], jnp.where(model.traffic.on_beam(t), weights, 0.0))

    def rates(
        self,
        moved: Float[Array, " state"],
        readings: Float[Array, " sensor"],
        command: Float[Array, " actuator"],
        t: Float[Array, ""],
    ) -> Float[Array, " state"]:
        """Rates of the estimate for readings and commands at a time (s)."""
        plant, state = self.plant(t), self.start + moved
        surprise = readings - self.offset - plant.C @ state - plant.D @ command
        return plant.A @ state + plant.B @ command + self.at(t) @ surprise

    def at(self, t: Float[Array, ""]) -> Float[Array, "state sensor"]:
        """The gain at a time (s)."""
        if self.gain is not None:
            return self.gain
        return self.table(1 - t / self.duration).T
