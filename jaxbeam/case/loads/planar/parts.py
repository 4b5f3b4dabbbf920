"""Parts of planar vehicles: bodies, springs and dampers, hinges, axles.

Positions are in m along the vehicle, forward positive, from any common origin.
"""

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, number
from jaxbeam.runtime.arrays import Array


class VehicleBody(ReprWithUnits, eqx.Module):
    """Rigid body; without `inertia` it has a height only, like the lumped mass of an axle."""

    name: str = choice("name of the body")
    mass: Float[Array, ""] = number("kg", "mass", POSITIVE)
    inertia: Float[Array, ""] | None = number(
        "kg m^2", "moment of inertia in pitch", POSITIVE, default=None
    )
    position: Float[Array, ""] = number("m", "centre of mass, forward positive", default=0.0)


class VehicleSpring(ReprWithUnits, eqx.Module):
    """Vertical spring and damper between two bodies at a position, and those between their pitches.

    A vertical force acts on both bodies along one line, so that they share the position.
    """

    first: str = choice("name of a body")
    second: str = choice("name of another body")
    position: Float[Array, ""] = number("m", "position, forward positive")
    stiffness: Float[Array, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Array, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    rotational_stiffness: Float[Array, ""] = number(
        "N m/rad", "spring between the pitches", NOT_NEGATIVE, default=0.0
    )
    rotational_damping: Float[Array, ""] = number(
        "N m s/rad", "damper between the pitches", NOT_NEGATIVE, default=0.0
    )


class VehicleHinge(ReprWithUnits, eqx.Module):
    """Point at which two bodies have the same height, exactly, such as a fifth wheel."""

    first: str = choice("name of a body")
    second: str = choice("name of another body")
    position: Float[Array, ""] = number("m", "position, forward positive")


class VehicleAxle(ReprWithUnits, eqx.Module):
    """Axle under a body: on a suspension, on a tyre, or on both with its mass in between.

    Without a tyre it stays on the surface, where its mass is unsprung, as that of a wheelset;
    without a suspension it is part of the body, which has its mass.
    """

    body: str = choice("name of the body that it carries")
    position: Float[Array, ""] = number("m", "position, forward positive")
    mass: Float[Array, ""] = number("kg", "mass", NOT_NEGATIVE, default=0.0)
    suspension_stiffness: Float[Array, ""] | None = number(
        "N/m", "spring between body and axle", POSITIVE, default=None
    )
    suspension_damping: Float[Array, ""] = number(
        "N s/m", "damper between body and axle", NOT_NEGATIVE, default=0.0
    )
    tyre_stiffness: Float[Array, ""] | None = number(
        "N/m", "spring between axle and surface", POSITIVE, default=None
    )
    tyre_damping: Float[Array, ""] = number(
        "N s/m", "damper between axle and surface", NOT_NEGATIVE, default=0.0
    )
