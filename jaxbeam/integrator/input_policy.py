"""What commands the actuators of a run, as the integrator sees it."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Int


class Moment(eqx.Module):
    """A step, or several: start (s), length (s), and the edge of the schedule it starts at.

    `edge` is -1 for a step that starts between two edges.
    """

    start: Float[Array, " *step"]
    span: Float[Array, " *step"]
    edge: Int[Array, " *step"]


class AbstractDriver(eqx.Module):
    """What commands the actuators of a run.

    With `inner`, it is told the states at the nodes within a step, and not only at the start. A
    run is given up where a state of the rig exceeds its `bound`.
    """

    inner: eqx.AbstractVar[bool]
    bound: eqx.AbstractVar[Float[Array, " state"]]

    @abc.abstractmethod
    def start(self, lanes: int) -> Any:
        """Its memory at the start of a run, of any structure."""

    @abc.abstractmethod
    def drive(
        self, memory, state: Float[Array, "state lane"], moment: Moment, states
    ) -> tuple[Float[Array, "node actuator lane"], Any]:
        """Commands (node, actuator, lane) of a step from this state, and the memory after it.

        `states` takes commands to the states at the nodes (node, state, lane), if `inner`.
        """

    @abc.abstractmethod
    def shows(self, memory, moment: Moment) -> Any:
        """What is to be kept of the start of a step that starts at an edge, lanes last, or None."""
