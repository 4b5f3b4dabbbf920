"""Feedback of the whole state with a given gain."""

from jaxtyping import Array, Float

from jaxbeam.controller import AbstractController
from jaxbeam.fields import NOT_NEGATIVE, POSITIVE, number


class StateFeedback(AbstractController):
    """u = -K z with the true state z, in the order and units of `state_space(case)`."""

    gain: Float[Array, "actuator state"] = number(
        "unit of a command per state", "gain, a row for each actuator"
    )
    period: Float[Array, ""] | None = number(
        "s", "sampling period; at every instant if left out", POSITIVE, default=None
    )
    delay: Float[Array, ""] | None = number(
        "s", "from measurement to command", NOT_NEGATIVE, default=None
    )
    resolution: Float[Array, ""] | None = number(
        "unit of a command", "step between commands", POSITIVE, default=None
    )

    @property
    def memoryless(self) -> bool:
        return True

    def fault(self, case):
        own = sum(actuator.attachment().state_matrix.shape[0] for actuator in case.actuators)
        wanted = (len(case.actuators), 2 * case.beam.modes + own)
        if self.gain.shape != wanted:
            return f"gain must have a row for each actuator, a column for each state: {wanted}"
        return None

    def init(self, model):
        return None

    def step(self, memory, measurement, t):
        return -self.gain @ measurement.state, memory
