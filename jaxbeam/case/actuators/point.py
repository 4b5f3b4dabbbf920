"""Actuators at a point: forces, shakers with a suspension, springs and dampers."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE, number
from jaxbeam.runtime.arrays import Number, xp


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

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    limits: Float[Number, "2"] | None = number(
        "N", "smallest and largest command", INCREASING, default=None
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        no_states, zero = xp.zeros(0), xp.zeros(())
        return Attachment(
            xp.zeros((0, 0)), no_states, no_states, no_states, xp.ones(()), zero, zero
        )


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

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Number, ""] = number("N/m", "suspension stiffness", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "suspension damping", NOT_NEGATIVE, default=0.0)
    force_per_volt: Float[Number, ""] = number("N/V", "steady force per volt", default=4.6)
    bandwidth: Float[Number, ""] = number(
        "1/s", "bandwidth of the first-order lag", POSITIVE, default=1e4
    )
    limits: Float[Number, "2"] | None = number(
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

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Number, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    limits: Float[Number, "2"] | None = number(
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
