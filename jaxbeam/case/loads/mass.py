"""Mass that travels along the beam."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, number
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.vehicle_model import plain_wheels
from jaxbeam.runtime.arrays import Array


class MovingMass(AbstractLoad):
    """Mass in permanent contact with the beam: its weight and its inertia act on the beam.

    Its vertical acceleration has all convective terms, w_tt + 2 v w_xt + v^2 w_xx + a w_x
    (corrected eq. (2.3) of the thesis). Give `speed` (negative: it enters at the right end and
    travels left), `entry_time` and `deceleration`; or a table of `times` and `positions`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.MovingMass(mass=20e3, speed=30.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.647 mm
    """

    kind: ClassVar[str] = "mass"

    mass: Float[Array, ""] = number("kg", "mass", NOT_NEGATIVE)
    speed: Float[Array, ""] | None = number("m/s", "speed at entry", default=None)
    entry_time: Float[Array, ""] = number("s", "time of entry", default=0.0)
    deceleration: Float[Array, ""] = number("m/s^2", "constant deceleration", default=0.0)
    times: Float[Array, " point"] | None = number("s", "table: times", INCREASING, default=None)
    positions: Float[Array, " point"] | None = number("m", "table: positions", default=None)
    start_position: Float[Array, ""] | None = number(
        "m", "position at entry_time, before the beam", default=None
    )

    def total_mass(self, gravity):
        return self.mass

    def vehicle(self, gravity):
        return plain_wheels(self.mass * gravity, self.mass)
