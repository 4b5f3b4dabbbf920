"""What commands the actuators of a run, as the integrator sees it."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Int


class StepInfo(eqx.Module):
    """A step, or several: start (s), length (s), and the edge of the schedule it starts at.

    `event` is -1 for a step that starts between two edges.
    """

    start: Float[Array, " *step"]
    length: Float[Array, " *step"]
    event: Int[Array, " *step"]


class AbstractInputPolicy(eqx.Module):
    """What commands the actuators of a run.

    With `implicit`, it is told the states at the nodes within a step, and not only at the start. A
    run is given up where a state of the rig exceeds its `state_bound`.
    """

    implicit: eqx.AbstractVar[bool]
    state_bound: eqx.AbstractVar[Float[Array, " state"]]

    @abc.abstractmethod
    def start(self, batch_size: int) -> Any:
        """Its memory at the start of a run, of any structure."""

    @abc.abstractmethod
    def inputs(
        self, memory, state: Float[Array, "state lane"], info: StepInfo, states
    ) -> tuple[Float[Array, "node actuator lane"], Any]:
        """Commands (node, actuator, lane) of a step from this state, and the memory after it.

        `states` takes commands to the states at the nodes (node, state, lane), if `inner`.
        """

    @abc.abstractmethod
    def observe(self, memory, info: StepInfo) -> Any:
        """What is to be kept of the start of a step that starts at an edge, lanes last, or None."""
