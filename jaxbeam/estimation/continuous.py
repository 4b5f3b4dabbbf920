"""Filters in continuous time, integrated together with the plant.

x' = A(t) x + B u + L(t) (y - C x - D u - offset)
"""

import abc

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.estimator import AbstractContinuousFilter, Estimate
from jaxbeam.estimation.sensor_chain import FilteredPlant
from jaxbeam.estimation.simulated_vehicles import with_loads
from jaxbeam.model.linear_system import StateSpace
from jaxbeam.numerics.gain_table import GainTable
from jaxbeam.runtime.arrays import Array


class AbstractLinearFilter(AbstractContinuousFilter):
    """Linear filter x' = A(t) x + B u + L(t) (y - C x - D u - offset), from x = `initial`.

    The states that are integrated are x - `initial`. The first `plant_states` states x are those of
    the plant; states of analogue filters may follow.
    """

    offset: Float[Array, " sensor"]
    initial: Float[Array, " state"]
    plant_states: int = eqx.field(static=True)

    @property
    def state_count(self):
        return self.initial.shape[0]

    @abc.abstractmethod
    def system_at(self, t: Float[Array, ""]) -> StateSpace:
        """A, B, C and D at t (s); the outputs are the inputs of the sensors."""

    @abc.abstractmethod
    def gain_at(self, t: Float[Array, ""]) -> Float[Array, "state sensor"]:
        """Gain L at t (s)."""

    def estimate(self, state, measurement, t):
        return Estimate((self.initial + state)[: self.plant_states])

    def rates(self, state, measurement, command, t):
        system, x = self.system_at(t), self.initial + state
        innovation = measurement.readings - self.offset - system.C @ x - system.D @ command
        return system.A @ x + system.B @ command + self.gain_at(t) @ innovation


class TimeInvariantFilter(AbstractLinearFilter):
    """Filter for a plant without loads, with a constant gain."""

    system: StateSpace
    gain: Float[Array, "state sensor"]

    def system_at(self, t):
        return self.system

    def gain_at(self, t):
        return self.gain


class ContinuousCrossingFilter(AbstractLinearFilter):
    """Filter for a plant with its moving loads, with a gain that varies over the run.

    States of vehicles and weights of the loads are the last states x; the estimate includes the
    weights if `estimates_weights`. `dual_gain` is the transposed gain over the time back from the
    end of the run, of `duration` (s).
    """

    filtered: FilteredPlant
    dual_gain: GainTable
    duration: Float[Array, ""]
    estimates_weights: bool = eqx.field(static=True)

    def system_at(self, t):
        return self.filtered.with_filtered_outputs(self.filtered.plant.augmented(t))

    def gain_at(self, t):
        return self.dual_gain(1 - t / self.duration).T

    def estimate(self, state, measurement, t):
        estimate = super().estimate(state, measurement, t)
        x = (self.initial + state)[self.filtered.plant.modal_model.state_count :]
        return with_loads(self.filtered.plant, estimate.state, x, t, self.estimates_weights)
