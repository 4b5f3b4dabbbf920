"""Estimators of the state: the settings in a case, and the two interfaces of the filters.

An estimator holds the settings of a case file. For a plant it designs a filter, which turns
readings into an estimate of the state, at samples or in continuous time, for a law that feeds back
the state. Estimators are in `jaxbeam.estimation`.
"""

import abc
from typing import Any, ClassVar, NamedTuple

from jaxtyping import Float

from jaxbeam.case.controller import Command, Measurement, Time
from jaxbeam.case.display import ExplainsArguments, ReprWithUnits
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.module import Module


class EstimatedLoads(NamedTuple):
    """Masses (kg), positions (m) and speeds (m/s, negative to the left) of loads of one wheel."""

    masses: Float[Array, " load"]
    positions: Float[Array, " load"]
    speeds: Float[Array, " load"]


class Estimate(NamedTuple):
    """Estimate of the state of the plant, and of the weights of the loads (N) if estimated too.

    The state is that of the beam of the plant for which the filter is designed. `weights` has one
    entry for each wheel of the case, zero while it is off the beam; None where weights are not
    estimated. `vehicles` are the states of vehicles, None where the filter does not have them;
    `loads` are the loads of a filter that follows their masses and speeds, else None.
    """

    state: Float[Array, " state"]
    weights: Float[Array, " wheel"] | None = None
    vehicles: Float[Array, " vehicle_state"] | None = None
    loads: EstimatedLoads | None = None


class AbstractSampledFilter(Module):
    """Filter at samples: (estimate, x_k+1) = update(x_k, y_k, t_k), x of any structure.

    Fields of the class are the design; they do not change during a run.
    """

    def initial_state(self) -> Any:
        """State of the filter at the start of a run."""
        return ()

    @abc.abstractmethod
    def update(self, state: Any, measurement: Measurement, t: Time) -> tuple[Estimate, Any]:
        """Estimate at a sample at t (s), and the next state of the filter."""

    def tabulated(self, times: Float[Array, " sample"]) -> "AbstractSampledFilter":
        """The filter with its time-dependent matrices tabulated at the `times` of a run (s)."""
        return self


class AbstractContinuousFilter(Module):
    """Filter in continuous time, x' = rates(x, y, u, t), from x = 0, integrated with the plant."""

    @property
    def state_count(self) -> int:
        """Number of states x."""
        return 0

    @abc.abstractmethod
    def estimate(
        self, state: Float[Array, " filter_state"], measurement: Measurement, t: Time
    ) -> Estimate:
        """Estimate at t (s)."""

    @abc.abstractmethod
    def rates(
        self,
        state: Float[Array, " filter_state"],
        measurement: Measurement,
        command: Command,
        t: Time,
    ) -> Float[Array, " filter_state"]:
        """Rates of the states x (1/s) under a command."""


class AbstractEstimator(ReprWithUnits, Module, metaclass=ExplainsArguments):
    """Estimate of the state from readings, at the samples of a controller, and its settings.

    To add one, write a file in `jaxbeam.estimation` with a subclass that names its `kind`.
    """

    kind: ClassVar[str]
    continuous_time: ClassVar[bool] = False  # whether it has a filter in continuous time

    @property
    def has_vehicles(self) -> bool:
        """Whether estimates have the states of vehicles."""
        return False

    @property
    def varies(self) -> bool:
        """Whether the gain changes as the loads cross, so that a loop has no equilibrium.

        Otherwise the filter depends on no number of the loads.
        """
        return False

    @abc.abstractmethod
    def sampled_filter(self, plant: Any, timing: Any) -> AbstractSampledFilter:
        """Filter at samples, designed for a `jaxbeam.model.state_space.Plant`.

        `timing` is the `jaxbeam.estimation.sampled_plant.SampleTiming` of the controller.
        """

    def continuous_filter(self, plant: Any) -> AbstractContinuousFilter:
        """Filter in continuous time, designed for a plant.

        Raises NotImplementedError if the estimator acts at samples only.
        """
        raise NotImplementedError(f"{type(self).__name__} acts at samples only")

    def validate(self, case: Any, system: Any) -> str | None:
        """Error of these settings in a case, as "key must ...", or None; before any compilation.

        Called twice: with None for the system; then, where all numbers are concrete (not inside
        `jit`), with the plant of the design without loads, a `state_space.StateSpace`.
        """
        return None
