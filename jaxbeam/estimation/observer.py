"""Luenberger's observer: the poles of its error are where one wants them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import POSITIVE, concrete, number
from jaxbeam.estimation.constant_gain import (
    ConstantGainFilter,
    constant_gain_filter,
    sensor_offsets,
)
from jaxbeam.estimation.continuous import ContinuousEstimator
from jaxbeam.estimation.gains import placed_gain
from jaxbeam.estimation.observability import mode_count, observability_error
from jaxbeam.estimation.sampled_plant import SampleTiming, sample_timing
from jaxbeam.model.state_space import StateSpace
from jaxbeam.numerics.discretisation import balance, c2d


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
    def continuous_time(self) -> bool:
        return True

    def init(self, plant):
        if plant.case.controller.period is None:
            system, initial_state = plant.unloaded, jnp.zeros(plant.modal_model.states)
            gain = _modal_placed_gain(system.A, system.C, self.desired_matrix(system))
            return ContinuousEstimator(
                sensor_offsets(plant), initial_state, initial_state.size, unloaded=system, gain=gain
            )
        system, timing = plant.unloaded, sample_timing(plant.case.controller)
        no_noise = jnp.zeros_like(system.A)
        transition = timing.transition(lambda t: (system.A, system.B), no_noise, balance(system.A))
        gain = self.gain(system, transition.matrix, timing)
        return constant_gain_filter(plant, transition, system.C, system.D, gain)

    def step(self, memory: ConstantGainFilter, measurement, t):
        memory = memory.update(measurement)
        return Estimate(memory.plant_state), memory

    def gain(
        self,
        system: StateSpace,
        transition_matrix: Float[Array, "state state"],
        timing: SampleTiming,
    ) -> Float[Array, "state sensor"]:
        """The gain for a plant whose state `transition_matrix` takes from tick to tick."""
        desired, _ = c2d(
            self.desired_matrix(system), jnp.zeros((2 * mode_count(system), 1)), timing.period
        )
        return _modal_placed_gain(transition_matrix, system.C @ transition_matrix, desired)

    def desired_matrix(self, system: StateSpace) -> Float[Array, "modal modal"]:
        """A state matrix (1/s) with the poles that are wanted for the error."""
        modes = mode_count(system)
        if self.poles is None:
            return self.speed * system.A[: 2 * modes, : 2 * modes]
        stiffness, real_parts = jnp.diag(jnp.sum(self.poles**2, axis=1)), jnp.diag(self.poles[:, 0])
        return jnp.block(
            [[jnp.zeros((modes, modes)), jnp.eye(modes)], [-stiffness, 2 * real_parts]]
        )

    def validate(self, case, system):
        if (self.poles is None) == (self.speed is None):
            return "poles or speed must be given, and not both"
        if system is None:
            return None
        modes = mode_count(system)
        if self.poles is not None and self.poles.shape[0] != modes:
            return f"poles must list a pair for each of {modes} modes, not {self.poles.shape[0]}"
        if self.poles is not None and np.any(concrete(self.poles)[:, 0] >= 0):
            return "poles must have negative real parts, for the error to die away"
        if self.speed is not None and concrete(self.speed) <= 1:
            return "speed must be above 1"
        if self.speed is not None:
            poles = np.linalg.eigvals(concrete(system.A)[: 2 * modes, : 2 * modes])
            if np.max(poles.real) > -1e-9 * np.max(np.abs(poles)):
                return "speed must not be used on a beam without damping; give poles instead"
        return observability_error(system)


def _modal_placed_gain(A, C, desired) -> Float[Array, "state sensor"]:
    """The gain with which the states of the beam, the first ones, have a wanted state matrix."""
    modal = desired.shape[0]
    gain = placed_gain(A[:modal, :modal], C[:, :modal], desired)
    return jnp.zeros((A.shape[0], C.shape[0])).at[:modal].set(gain)
