"""Feedback of the whole state with a given gain."""

from jaxtyping import Array, Float

from jaxbeam.case.fields import number
from jaxbeam.control.state_law import AbstractStateLaw


class StateFeedback(AbstractStateLaw):
    """u = -K z with the state z, in the order and units of `state_space(case, coordinates)`."""

    gain: Float[Array, "actuator state"] = number(
        "unit of a command per state", "gain, a row for each actuator"
    )

    @property
    def knows_loads(self) -> bool:
        return self.estimator is not None

    def fault(self, case):
        wanted = (len(case.actuators), self.states(case))
        if self.gain.shape != wanted:
            return f"gain must have a row for each actuator, a column for each state: {wanted}"
        return super().fault(case)

    def prepare(self, model, designed):
        return None

    def command(self, memory, estimate, measurement, t):
        return -self.gain @ estimate.state, memory
