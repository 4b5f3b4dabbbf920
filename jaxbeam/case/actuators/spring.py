"""Passive spring and damper to ground, which leaves the modes as they are."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, number
from jaxbeam.runtime.arrays import Array, xp


class SpringDamper(AbstractActuator):
    """Spring and damper from the beam to ground; it takes no command.

    Unlike an elastic support it does not enter the modes: it couples the modes of the beam without
    it, as in eq. (2.17) of the thesis, so results converge with the number of modes.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.SpringDamper(0.3, stiffness=2e3, damping=5.0)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=2.0)],
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.851 mm
    """

    kind: ClassVar[str] = "spring"

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Array, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Array, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    limits: Float[Array, "2"] | None = number(
        "1", "without effect: it takes no command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        square = xp.zeros((0, 0))
        return Attachment(
            square, no_states, no_states, no_states, zero, self.stiffness, self.damping
        )
