"""Feedback of the whole state with a given gain."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import number
from jaxbeam.control.state_controller import AbstractStateController
from jaxbeam.control.state_law import GainLaw
from jaxbeam.runtime.arrays import Array


class StateFeedback(AbstractStateController):
    """u = -K z with the state z, in the order and units of `state_space(case, coordinates)`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.StateFeedback(gain=[[3e3, 30.0]], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.149 mm
    """

    kind: ClassVar[str] = "state"

    gain: Float[Array, "actuator state"] = number(
        "unit of a command per state", "gain, a row for each actuator"
    )

    def validate(self, case):
        shape = (len(case.driven), self.state_count(case))
        if self.gain.shape != shape:
            return f"gain must have a row for each actuator, a column for each state: {shape}"
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        return GainLaw(self.gain)
