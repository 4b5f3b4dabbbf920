"""Control laws fed by an estimate of the state, and their composition with a filter."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractSampledLaw,
    ControlStep,
    Measurement,
    Time,
)
from jaxbeam.case.estimator import (
    AbstractContinuousFilter,
    AbstractSampledFilter,
    Estimate,
)
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module


class AbstractStateLaw(Module):
    """Control law fed by an estimate of the state of its plant; static laws have an empty state.

    Fields of the class hold the design; they are constant during a run.
    """

    @property
    def needs_vehicles(self) -> bool:
        """Whether the estimate must have the states of the vehicles."""
        return False

    def initial_state(self) -> Any:
        """State of the law at the start of a run."""
        return ()

    @abc.abstractmethod
    def step(
        self, state: Any, estimate: Estimate, measurement: Measurement, t: Time
    ) -> ControlStep:
        """Command for an estimate at t (s), and the next state of the law."""

    def tabulated(self, times: Float[Array, " sample"]) -> "AbstractStateLaw":
        """As `AbstractSampledLaw.tabulated`."""
        return self


class GainLaw(AbstractStateLaw):
    """u = -K x with a constant gain K; with `feeds_back_command` x ends with the last command."""

    gain: Float[Array, "actuator column"]
    feeds_back_command: bool = eqx.field(static=True, default=False)

    def step(self, state, estimate, measurement, t):
        x = estimate.state
        if self.feeds_back_command:
            x = xp.concatenate([x, measurement.command])
        return ControlStep(-self.gain @ x, state)


class TrueState(AbstractSampledFilter, AbstractContinuousFilter):
    """Full state information: the estimate is the true state of the plant in other coordinates.

    `state_map` maps the states of the plant to those of the design plant.
    """

    state_map: Float[Array, "design_state state"]

    def update(self, state, measurement, t):
        return self.estimate(state, measurement, t), state

    def estimate(self, state, measurement, t):
        return Estimate(self.state_map @ measurement.state)

    def rates(self, state, measurement, command, t):
        return state


class SampledStateLaw(AbstractSampledLaw):
    """State law behind a filter at samples; the state holds those of the law and of the filter."""

    law: AbstractStateLaw
    filter: AbstractSampledFilter

    def initial_state(self):
        return self.law.initial_state(), self.filter.initial_state()

    def tabulated(self, times):
        return SampledStateLaw(self.law.tabulated(times), self.filter.tabulated(times))

    def step(self, state, measurement, t):
        law_state, filter_state = state
        estimate, filter_state = self.filter.update(filter_state, measurement, t)
        command, law_state, solved = self.law.step(law_state, estimate, measurement, t)
        return ControlStep(command, (law_state, filter_state), solved)


class ContinuousStateLaw(AbstractContinuousLaw):
    """Static state law behind a filter in continuous time; the states are those of the filter."""

    law: AbstractStateLaw
    filter: AbstractContinuousFilter

    @property
    def state_count(self):
        return self.filter.state_count

    def command(self, state, measurement, t):
        estimate = self.filter.estimate(state, measurement, t)
        return self.law.step(self.law.initial_state(), estimate, measurement, t).command

    def rates(self, state, measurement, command, t):
        return self.filter.rates(state, measurement, command, t)
