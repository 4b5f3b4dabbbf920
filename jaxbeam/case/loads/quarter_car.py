"""Quarter car: a body on a suspension, an axle on a tyre."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, number
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.case.loads.planar.assembly import Bodies, Links, Wheels, assemble
from jaxbeam.case.loads.vehicle_checks import positive_error
from jaxbeam.runtime.arrays import Array, xp


class QuarterCar(AbstractVehicleLoad):
    """Body on a suspension above an axle, which stands on a tyre; heights only.

    The tyre has no mass: the mass of the wheel belongs to the axle. P = (m_body + m_axle) g.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.QuarterCar(
    ...             speed=20.0,
    ...             body_mass=17000.0,
    ...             axle_mass=600.0,
    ...             suspension_stiffness=4e5,
    ...             suspension_damping=1e4,
    ...             tyre_stiffness=1.75e6,
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.277 mm
    """

    kind: ClassVar[str] = "quarter-car"

    body_mass: Float[Array, ""] = number("kg", "mass of the body", POSITIVE)
    axle_mass: Float[Array, ""] = number("kg", "mass of the axle", POSITIVE)
    suspension_stiffness: Float[Array, ""] = number("N/m", "spring of the body", NOT_NEGATIVE)
    suspension_damping: Float[Array, ""] = number("N s/m", "damper of the body", NOT_NEGATIVE)
    tyre_stiffness: Float[Array, ""] = number("N/m", "spring of the tyre", NOT_NEGATIVE)
    tyre_damping: Float[Array, ""] = number(
        "N s/m", "damper of the tyre", NOT_NEGATIVE, default=0.0
    )

    def validate(self, address):
        springs = ("suspension_stiffness", "tyre_stiffness")
        reason = 'nothing else carries the body; with one spring only write kind = "oscillator"'
        return positive_error(address, self, springs, reason) or super().validate(address)

    def vehicle(self, gravity):
        masses = xp.stack([self.body_mass, self.axle_mass])
        bodies = Bodies(("body", "axle"), masses, np.zeros(2), (None, None))
        place = np.zeros(1)
        suspension = (self.suspension_stiffness, self.suspension_damping)
        tyre = (self.tyre_stiffness, self.tyre_damping)
        links = Links(((0, 1),), place, *(xp.reshape(one, 1) for one in suspension))
        wheels = Wheels((1,), place, place, *(xp.reshape(one, 1) for one in tyre))
        return assemble(bodies, links, wheels, gravity)
