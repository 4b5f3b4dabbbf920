"""Luenberger's observer: the poles of its error are where one wants them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import POSITIVE, known, number
from jaxbeam.estimation.constant_gain import FixedGain, at_rest, offsets
from jaxbeam.estimation.continuous import Flowing
from jaxbeam.estimation.gains import placed_gain
from jaxbeam.estimation.observability import modes_of, unseen_fault
from jaxbeam.estimation.sampled_plant import Ticks, ticks
from jaxbeam.model.state_space import StateSpace
from jaxbeam.numerics.discretisation import balance, hold


class Observer(AbstractEstimator):
    """Predicts with the model without loads, and adds a constant gain times the surprise.

    The error in the states of the beam dies away with the `poles` given, or with those of the
    beam `speed` times as fast (eq. 4.4 of the thesis, sampled: a pole p becomes exp(p period)).
    Without a period it acts at every instant, and the poles are those themselves. States of
    actuators follow from the commands, uncorrected. Loads are not modelled: they
    pull the estimate off. Nor are filters and delays of the sensors.
    """

    poles: Float[Array, "mode 2"] | None = number(
        "1/s", "real and imaginary part of a pair of poles for each mode", default=None
    )
    speed: Float[Array, ""] | None = number(
        "1", "how many times as fast as those of the beam its poles are", POSITIVE, default=None
    )

    @property
    def flows(self) -> bool:
        return True

    def init(self, model):
        if model.case.controller.period is None:
            plant, start = model.unloaded, jnp.zeros(model.rig.states)
            gain = _placed(plant.A, plant.C, self.wanted(plant))
            return Flowing(offsets(model), start, start.size, still=plant, gain=gain)
        plant, clock = model.unloaded, ticks(model.case.controller)
        still = jnp.zeros_like(plant.A)
        transition = clock.transition(lambda t: (plant.A, plant.B), still, balance(plant.A))
        gain = self.gain(plant, transition.drift, clock)
        return at_rest(model, transition, plant.C, plant.D, gain)

    def step(self, memory: FixedGain, measurement, t):
        memory = memory.corrected(measurement)
        return Estimate(memory.plant_state), memory

    def gain(
        self, plant: StateSpace, drift: Float[Array, "state state"], clock: Ticks
    ) -> Float[Array, "state sensor"]:
        """The gain for a plant whose state `drift` takes from tick to tick."""
        wanted, _ = hold(self.wanted(plant), jnp.zeros((2 * modes_of(plant), 1)), clock.period)
        return _placed(drift, plant.C @ drift, wanted)

    def wanted(self, plant: StateSpace) -> Float[Array, "modal modal"]:
        """A state matrix (1/s) with the poles that are wanted for the error."""
        modes = modes_of(plant)
        if self.poles is None:
            return self.speed * plant.A[: 2 * modes, : 2 * modes]
        square, real = jnp.diag(jnp.sum(self.poles**2, axis=1)), jnp.diag(self.poles[:, 0])
        return jnp.block([[jnp.zeros((modes, modes)), jnp.eye(modes)], [-square, 2 * real]])

    def fault(self, case, plant):
        if (self.poles is None) == (self.speed is None):
            return "poles or speed must be given, and not both"
        if plant is None:
            return None
        modes = modes_of(plant)
        if self.poles is not None and self.poles.shape[0] != modes:
            return f"poles must list a pair for each of {modes} modes, not {self.poles.shape[0]}"
        if self.poles is not None and np.any(known(self.poles)[:, 0] >= 0):
            return "poles must have negative real parts, for the error to die away"
        if self.speed is not None and known(self.speed) <= 1:
            return "speed must be above 1"
        if self.speed is not None:
            poles = np.linalg.eigvals(known(plant.A)[: 2 * modes, : 2 * modes])
            if np.max(poles.real) > -1e-9 * np.max(np.abs(poles)):
                return "speed must not be used on a beam without damping; give poles instead"
        return unseen_fault(plant)


def _placed(A, C, wanted) -> Float[Array, "state sensor"]:
    """The gain with which the states of the beam, the first ones, have a wanted state matrix."""
    modal = wanted.shape[0]
    gain = placed_gain(A[:modal, :modal], C[:, :modal], wanted)
    return jnp.zeros((A.shape[0], C.shape[0])).at[:modal].set(gain)
