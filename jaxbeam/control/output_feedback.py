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

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.OutputFeedback(gains=[[-2e3]], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.900 mm
    """

    kind: ClassVar[str] = "output-feedback"

    gains: Float[Array, "actuator sensor"] = number(
        "command per reading", "row of gains of the sensors for each actuator"
    )

    def validate(self, case):
        wanted = len(case.driven), len(case.sensors)
        if self.gains.shape != wanted:
            return (
                f"gains must have a row for each of {wanted[0]} actuators, with a gain for each of"
                f" {wanted[1]} sensors, not the shape {self.gains.shape}"
            )
        return None

    def command(self, state, measurement, t):
        return self.gains @ measurement.readings
