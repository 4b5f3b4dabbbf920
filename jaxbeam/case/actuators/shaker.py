"""Electrodynamic shaker as a first-order lag from voltage to force, with a suspension."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE, number
from jaxbeam.runtime.arrays import Array, xp


class Shaker(AbstractActuator):
    """Electrodynamic shaker: voltage to force through a first-order lag, with its suspension.

    z' = bandwidth (u - z), force = force_per_volt z - stiffness w - damping w': eqs (2.35) and
    (2.36) of the thesis with alpha = beta = bandwidth. A positive voltage lifts the beam. Without a
    command only the spring and damper of its suspension act.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.Shaker(0.3, stiffness=200.0, force_per_volt=5.0, limits=(-4.0, 4.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[1e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.606 mm
    """

    kind: ClassVar[str] = "shaker"

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Array, ""] = number("N/m", "suspension stiffness", NOT_NEGATIVE, default=0.0)
    damping: Float[Array, ""] = number("N s/m", "suspension damping", NOT_NEGATIVE, default=0.0)
    force_per_volt: Float[Array, ""] = number("N/V", "steady force per volt", default=4.6)
    bandwidth: Float[Array, ""] = number(
        "1/s", "bandwidth of the first-order lag", POSITIVE, default=1e4
    )
    limits: Float[Array, "2"] | None = number(
        "V", "smallest and largest voltage", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        return Attachment(
            state_matrix=-self.bandwidth[None, None],
            input_matrix=self.bandwidth[None],
            velocity_matrix=xp.zeros(1),
            output_matrix=self.force_per_volt[None],
            feedthrough=xp.zeros(()),
            stiffness=self.stiffness,
            damping=self.damping,
        )
