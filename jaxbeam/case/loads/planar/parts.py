"""Parts of planar vehicles: bodies, springs and dampers, hinges, axles.

Positions are in m along the vehicle, forward positive, from any common origin.
"""

from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, number
from jaxbeam.runtime.arrays import Array


class VehicleBody(ReprWithUnits):
    """Rigid body; without `inertia` it has a height only, like the lumped mass of an axle.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[jb.VehicleBody("car", mass=1500.0, inertia=2500.0)],
    ...             axles=[
    ...                 jb.VehicleAxle(
    ...                     "car", 1.2, suspension_stiffness=4e4, suspension_damping=3e3
    ...                 ),
    ...                 jb.VehicleAxle(
    ...                     "car", -1.5, suspension_stiffness=4e4, suspension_damping=3e3
    ...                 ),
    ...             ],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.246 mm
    """

    name: str = choice("name of the body")
    mass: Float[Array, ""] = number("kg", "mass", POSITIVE)
    inertia: Float[Array, ""] | None = number(
        "kg m^2", "moment of inertia in pitch", POSITIVE, default=None
    )
    position: Float[Array, ""] = number("m", "centre of mass, forward positive", default=0.0)


class VehicleSpring(ReprWithUnits):
    """Vertical spring and damper between two bodies at a position, and those between their pitches.

    A vertical force acts on both bodies along one line, so that they share the position.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[
    ...                 jb.VehicleBody("body", mass=8000.0),
    ...                 jb.VehicleBody("frame", mass=2000.0),
    ...             ],
    ...             springs=[
    ...                 jb.VehicleSpring(
    ...                     "body", "frame", position=0.0, stiffness=4e5, damping=1e4
    ...                 )
    ...             ],
    ...             axles=[jb.VehicleAxle("frame", 0.0, suspension_stiffness=1e6)],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.857 mm
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


class VehicleHinge(ReprWithUnits):
    """Point at which two bodies have the same height, exactly, such as a fifth wheel.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[
    ...                 jb.VehicleBody("tractor", mass=5000.0, inertia=2e4, position=0.0),
    ...                 jb.VehicleBody("trailer", mass=15000.0, inertia=8e4, position=-6.0),
    ...             ],
    ...             hinges=[jb.VehicleHinge("tractor", "trailer", position=-1.5)],
    ...             axles=[
    ...                 jb.VehicleAxle(
    ...                     "tractor", 2.0, suspension_stiffness=4e5, suspension_damping=1e4
    ...                 ),
    ...                 jb.VehicleAxle(
    ...                     "tractor", -2.0, suspension_stiffness=4e5, suspension_damping=1e4
    ...                 ),
    ...                 jb.VehicleAxle(
    ...                     "trailer", -9.0, suspension_stiffness=1e6, suspension_damping=2e4
    ...                 ),
    ...             ],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    2.753 mm
    """

    first: str = choice("name of a body")
    second: str = choice("name of another body")
    position: Float[Array, ""] = number("m", "position, forward positive")


class VehicleAxle(ReprWithUnits):
    """Axle under a body: on a suspension, on a tyre, or on both with its mass in between.

    Without a tyre it stays on the surface, where its mass is unsprung, as that of a wheelset;
    without a suspension it is part of the body, which has its mass.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[jb.VehicleBody("car", mass=1500.0, inertia=2500.0)],
    ...             axles=[
    ...                 jb.VehicleAxle(
    ...                     "car", 1.2, suspension_stiffness=4e4, suspension_damping=3e3
    ...                 ),
    ...                 jb.VehicleAxle(
    ...                     "car", -1.5, suspension_stiffness=4e4, suspension_damping=3e3
    ...                 ),
    ...             ],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.246 mm
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
