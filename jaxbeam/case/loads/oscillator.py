"""Sprung mass that travels along the beam."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, number
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.case.loads.planar.assembly import Bodies, Links, Wheels, assemble
from jaxbeam.case.loads.vehicle_checks import positive_error
from jaxbeam.runtime.arrays import Array, xp

NO_LINKS = Links((), np.zeros(0), np.zeros(0), np.zeros(0))


class Oscillator(AbstractVehicleLoad):
    """Mass on a spring and a damper; the wheel below, with or without mass, stays on the surface.

    m u'' = k (y - u) + c (y' - u') with the height y of the surface under the wheel, and the
    contact force F = P + k (y - u) + c (y' - u') + m_w y'' with P = (m + m_w) g.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.Oscillator(mass=20e3, stiffness=2e6, damping=4e4, speed=30.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.508 mm
    """

    kind: ClassVar[str] = "oscillator"

    mass: Float[Array, ""] = number("kg", "sprung mass", POSITIVE)
    stiffness: Float[Array, ""] = number("N/m", "spring", NOT_NEGATIVE)
    damping: Float[Array, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    wheel_mass: Float[Array, ""] = number(
        "kg", "unsprung mass, on the surface", NOT_NEGATIVE, default=0.0
    )

    def validate(self, address):
        reason = 'nothing else carries the mass; for one without suspension write kind = "mass"'
        return positive_error(address, self, ("stiffness",), reason) or super().validate(address)

    def vehicle(self, gravity):
        place = np.zeros(1)
        bodies = Bodies(("body",), xp.reshape(self.mass, 1), place, (None,))
        wheel = (xp.reshape(one, 1) for one in (self.wheel_mass, self.stiffness, self.damping))
        return assemble(bodies, NO_LINKS, Wheels((0,), place, *wheel), gravity)
