"""Ideal force at a point, equal to the command."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.fields import INCREASING, ON_BEAM, number
from jaxbeam.runtime.arrays import Array, xp


class PointForce(AbstractActuator):
    """Ideal point force: a command of 1 N pushes the beam up with 1 N.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[2e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.900 mm
    """

    kind: ClassVar[str] = "point"

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    limits: Float[Array, "2"] | None = number(
        "N", "smallest and largest command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        return Attachment(
            xp.zeros((0, 0)), no_states, no_states, no_states, xp.ones(()), zero, zero
        )
