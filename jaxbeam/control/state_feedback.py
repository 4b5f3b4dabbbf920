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
    def design_depends_on_loads(self) -> bool:
        return self.estimator is not None

    def validate(self, case):
        shape = (len(case.actuators), self.state_count(case))
        if self.gain.shape != shape:
            return f"gain must have a row for each actuator, a column for each state: {shape}"
        return super().validate(case)

    def prepare(self, plant, design_plant):
        return None

    def command(self, memory, estimate, measurement, t):
        return -self.gain @ estimate.state, memory
