"""Feedback of all sensor readings through a matrix of gains."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.controller import AbstractStaticController
from jaxbeam.case.fields import number
from jaxbeam.runtime.arrays import Array


class OutputFeedback(AbstractStaticController):
    """Linear feedback of all readings: u = K y, with a row of `gains` for each actuator.

    Gains multiply as they are: a negative gain opposes a reading. Sensors of deflection and
    velocity make it the law of the receptance method (`receptance_feedback`).
    """

    kind: ClassVar[str] = "output-feedback"
    leaves_passive_out: ClassVar[bool] = True

    gains: Float[Array, "actuator sensor"] = number(
        "command per reading", "row of gains of the sensors for each actuator"
    )

    def validate(self, case):
        wanted = len(case.actuators), len(case.sensors)
        if self.gains.shape != wanted:
            return (
                f"gains must have a row for each of {wanted[0]} actuators, with a gain for each of"
                f" {wanted[1]} sensors, not the shape {self.gains.shape}"
            )
        return None

    def command(self, state, measurement, t):
        return self.gains @ measurement.readings
