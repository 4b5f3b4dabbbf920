"""Constant force that travels along the beam."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.declared_checks import validate_exactly_one
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, number
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.vehicle_model import plain_wheels
from jaxbeam.runtime.arrays import Array, xp


class MovingForce(AbstractLoad):
    """Constant force that travels along the beam: weight without inertia.

    Give the `force` in N (positive downwards), or the `mass` whose weight it is; its trajectory is
    given as for `MovingMass`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.MovingForce(force=200e3, speed=30.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.651 mm
    """

    kind: ClassVar[str] = "force"

    mass: Float[Array, ""] | None = number(
        "kg", "mass whose weight it is", NOT_NEGATIVE, default=None
    )
    force: Float[Array, ""] | None = number("N", "force, positive downwards", default=None)
    speed: Float[Array, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Array, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Array, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Array, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Array, " point"] | None = number("m", "table: positions", default=None)
    start_position: Float[Array, ""] | None = number(
        "m", "position at entry_time, before the beam", default=None
    )

    def validate(self, address):
        return validate_exactly_one(address, self, "force", "mass") or super().validate(address)

    def total_mass(self, gravity):
        return self.mass

    def vehicle(self, gravity):
        force = self.force if self.force is not None else self.mass * gravity
        return plain_wheels(force, xp.zeros(()))
