"""What an estimator is: something that turns measurements into the state of the plant.

It stands in front of a law that feeds back the state. The estimators are in `estimation`.
"""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement


class Estimate(eqx.Module):
    """What is believed of the plant: its state, and the weights of the loads (N) if sought too.

    The states are those of the model that the estimator was given. `weights` has one entry for
    each load of the case, zero while it is off the beam; None leaves them to be known otherwise.
    """

    state: Float[Array, " state"]
    weights: Float[Array, " load"] | None = None


class AbstractEstimator(eqx.Module):
    """Interface of all estimators.

    They run at the sampling period of the controller that they serve, which is that of
    `model.case.controller`. Without a period those that `flow` have a memory that is a
    `estimation.flowing.Flowing`. To add one, write a file with a subclass and name it in
    `jaxbeam.estimation.KINDS`.
    """

    @property
    def continuous_time(self) -> bool:
        """Whether it may act at every instant."""
        return False

    @abc.abstractmethod
    def init(self, plant: Any) -> Any:
        """Memory at the start of a run, of any structure; gains may be designed here.

        `plant` is the `statespace.LoadedBeam` that the controller is designed for.
        """

    @abc.abstractmethod
    def step(
        self, memory: Any, measurement: Measurement, t: Float[Array, ""]
    ) -> tuple[Estimate, Any]:
        """The estimate at time t (s), and the memory after it; `measurement.state` is not used."""

    def validate(self, case: Any, system: Any) -> str | None:
        """What is wrong with it in a case, as "key must ...", before a run compiles; or None.

        Asked twice: with None for the plant, before that is computed; then, if its numbers are
        known (they are not inside `jit`), with the design model without loads, a
        `statespace.StateSpace`.
        """
        return None
