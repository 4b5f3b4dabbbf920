"""Railway wagons: a body on two bogies with two wheelsets each."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.loads.planar.assembly import Bodies, Links, Wheels, assemble
from jaxbeam.case.loads.row import AbstractRowLoad
from jaxbeam.case.loads.vehicle_checks import positive_error
from jaxbeam.runtime.arrays import Array, xp


class Wagon(AbstractRowLoad):
    """Wagon of ten degrees of freedom: heights and pitches of body and bogies, four wheelsets.

    Wheelsets stay on the rail, where their height is that of the rail. The secondary suspension is
    between body and bogie, the primary one between bogie and wheelset; numbers are those of a whole
    bogie and of a whole wheelset, of both rails. The centre of mass is midway between the bogies.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.Wagon(
    ...             speed=50.0,
    ...             body_mass=32e3,
    ...             body_inertia=2e6,
    ...             bogie_mass=2600.0,
    ...             bogie_inertia=1400.0,
    ...             wheelset_mass=1800.0,
    ...             primary_stiffness=2.4e6,
    ...             primary_damping=8e3,
    ...             secondary_stiffness=8.6e5,
    ...             secondary_damping=4e4,
    ...             bogie_distance=19.0,
    ...             wheelset_distance=2.5,
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    5.678 mm
    """

    kind: ClassVar[str] = "wagon"

    body_mass: Float[Array, ""] = number("kg", "mass of the body", POSITIVE)
    body_inertia: Float[Array, ""] = number("kg m^2", "pitch inertia of the body", POSITIVE)
    bogie_mass: Float[Array, ""] = number("kg", "mass of a bogie without wheelsets", POSITIVE)
    bogie_inertia: Float[Array, ""] = number("kg m^2", "pitch inertia of a bogie", POSITIVE)
    wheelset_mass: Float[Array, ""] = number("kg", "mass of a wheelset", NOT_NEGATIVE)
    primary_stiffness: Float[Array, ""] = number("N/m", "springs of a wheelset", NOT_NEGATIVE)
    primary_damping: Float[Array, ""] = number("N s/m", "dampers of a wheelset", NOT_NEGATIVE)
    secondary_stiffness: Float[Array, ""] = number(
        "N/m", "springs between body and bogie", NOT_NEGATIVE
    )
    secondary_damping: Float[Array, ""] = number(
        "N s/m", "dampers between body and bogie", NOT_NEGATIVE
    )
    bogie_distance: Float[Array, ""] = number("m", "distance between bogie centres", POSITIVE)
    wheelset_distance: Float[Array, ""] = number("m", "distance of wheelsets of a bogie", POSITIVE)

    def validate(self, address):
        springs = ("primary_stiffness", "secondary_stiffness")
        error = positive_error(address, self, springs, "nothing else carries the body")
        if error is not None:
            return error
        long, short = self.bogie_distance, self.wheelset_distance
        if is_concrete(long) and is_concrete(short) and concrete(short) >= concrete(long):
            return (
                f"{address}.wheelset_distance must be below the distance between bogie centres,"
                f" {concrete(long):g} m; it is {concrete(short):g} m"
            )
        error = super().validate(address)
        return error or self.overlap_error(address, long + short, "wagon")

    def vehicle(self, gravity):
        arm, half = self.bogie_distance / 2, self.wheelset_distance / 2
        zero = xp.zeros_like(arm)
        bodies = Bodies(
            ("body", "front bogie", "rear bogie"),
            xp.stack([self.body_mass, self.bogie_mass, self.bogie_mass]),
            xp.stack([zero, arm, -arm]),
            (self.body_inertia, self.bogie_inertia, self.bogie_inertia),
        )
        pair, four = np.ones(2), np.ones(4)
        secondary = (self.secondary_stiffness * pair, self.secondary_damping * pair)
        links = Links(((0, 1), (0, 2)), xp.stack([arm, -arm]), *secondary)
        places = xp.stack([arm + half, arm - half, -arm + half, -arm - half])
        primary = (self.primary_stiffness * four, self.primary_damping * four)
        wheels = Wheels((1, 1, 2, 2), places, self.wheelset_mass * four, *primary)
        return assemble(bodies, links, wheels, gravity)
