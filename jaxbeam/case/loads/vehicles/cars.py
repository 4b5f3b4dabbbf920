"""Simple vehicles: oscillators, quarter and half cars, wagons."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, all_concrete, concrete, is_concrete, number
from jaxbeam.case.loads.base import (
    AbstractRowLoad,
    AbstractVehicleLoad,
    length_error,
    positive_error,
    static_load_error,
)
from jaxbeam.case.loads.vehicles.assembly import Bodies, Links, Wheels, assemble
from jaxbeam.runtime.arrays import Number, xp

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

    mass: Float[Number, ""] = number("kg", "sprung mass", POSITIVE)
    stiffness: Float[Number, ""] = number("N/m", "spring", NOT_NEGATIVE)
    damping: Float[Number, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    wheel_mass: Float[Number, ""] = number(
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

    body_mass: Float[Number, ""] = number("kg", "mass of the body", POSITIVE)
    axle_mass: Float[Number, ""] = number("kg", "mass of the axle", POSITIVE)
    suspension_stiffness: Float[Number, ""] = number("N/m", "spring of the body", NOT_NEGATIVE)
    suspension_damping: Float[Number, ""] = number("N s/m", "damper of the body", NOT_NEGATIVE)
    tyre_stiffness: Float[Number, ""] = number("N/m", "spring of the tyre", NOT_NEGATIVE)
    tyre_damping: Float[Number, ""] = number(
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


PER_AXLE = (
    "axle_masses",
    "suspension_stiffness",
    "suspension_damping",
    "tyre_stiffness",
    "tyre_damping",
)


class HalfCar(AbstractVehicleLoad):
    """Body with bounce and pitch, on a suspension, an axle and a tyre at each of two or more axles.

    Lists are over the axles, front first; positions are forward of the body's centre of mass.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.vehicles.HalfCar(
    ...             speed=20.0,
    ...             body_mass=16600.0,
    ...             body_inertia=95765.0,
    ...             axle_positions=[2.4, -2.4],
    ...             axle_masses=[700.0, 1100.0],
    ...             suspension_stiffness=[4e5, 1e6],
    ...             suspension_damping=[1e4, 1e4],
    ...             tyre_stiffness=[1.75e6, 3.5e6],
    ...             tyre_damping=[0.0, 0.0],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    3.000 mm
    """

    kind: ClassVar[str] = "half-car"

    body_mass: Float[Number, ""] = number("kg", "mass of the body", POSITIVE)
    body_inertia: Float[Number, ""] = number(
        "kg m^2", "moment of inertia of the body in pitch", POSITIVE
    )
    axle_positions: Float[Number, " axle"] = number(
        "m", "axles forward of the body's centre of mass, front first"
    )
    axle_masses: Float[Number, " axle"] = number("kg", "masses of the axles", POSITIVE)
    suspension_stiffness: Float[Number, " axle"] = number(
        "N/m", "springs of the body", NOT_NEGATIVE
    )
    suspension_damping: Float[Number, " axle"] = number(
        "N s/m", "dampers of the body", NOT_NEGATIVE
    )
    tyre_stiffness: Float[Number, " axle"] = number("N/m", "springs of the tyres", NOT_NEGATIVE)
    tyre_damping: Float[Number, " axle"] = number("N s/m", "dampers of the tyres", NOT_NEGATIVE)

    def validate(self, address):
        if len(self.axle_positions) < 2:
            return (
                f"{address}.axle_positions needs two axles or more to carry a body that pitches;"
                ' with one write kind = "quarter-car"'
            )
        error = length_error(address, self, "axle_positions", PER_AXLE)
        springs = ("suspension_stiffness", "tyre_stiffness")
        reason = "without its spring the axle carries nothing; leave the axle out"
        error = error or positive_error(address, self, springs, reason) or self._order(address)
        if error is None and all_concrete(self):
            error = static_load_error(address, self.vehicle(np.ones(())))
        return error or super().validate(address)

    def _order(self, address: str) -> str | None:
        if not is_concrete(self.axle_positions):
            return None
        positions = concrete(self.axle_positions)
        wrong = np.flatnonzero(positions[1:] >= positions[:-1])
        if not wrong.size:
            return None
        i = int(wrong[0]) + 1
        return (
            f"{address}.axle_positions.{i} must be below the entry before it,"
            f" {positions[i - 1]:g} m; it is {positions[i]:g} m: list the axles front first,"
            " forward positive"
        )

    def vehicle(self, gravity):
        axles = len(self.axle_positions)
        names = ("body", *(f"axle {i + 1}" for i in range(axles)))
        body_mass = xp.reshape(self.body_mass, 1)
        bodies = Bodies(
            names,
            xp.concatenate([body_mass, self.axle_masses]),
            xp.concatenate([np.zeros(1), self.axle_positions]),
            (self.body_inertia, *(None for _ in range(axles))),
        )
        axle_bodies = tuple(range(1, axles + 1))
        suspension = (self.suspension_stiffness, self.suspension_damping)
        links = Links(tuple((0, i) for i in axle_bodies), self.axle_positions, *suspension)
        tyres = (self.tyre_stiffness, self.tyre_damping)
        wheels = Wheels(axle_bodies, self.axle_positions, np.zeros(axles), *tyres)
        return assemble(bodies, links, wheels, gravity)


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
    ...         jb.vehicles.Wagon(
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

    body_mass: Float[Number, ""] = number("kg", "mass of the body", POSITIVE)
    body_inertia: Float[Number, ""] = number("kg m^2", "pitch inertia of the body", POSITIVE)
    bogie_mass: Float[Number, ""] = number("kg", "mass of a bogie without wheelsets", POSITIVE)
    bogie_inertia: Float[Number, ""] = number("kg m^2", "pitch inertia of a bogie", POSITIVE)
    wheelset_mass: Float[Number, ""] = number("kg", "mass of a wheelset", NOT_NEGATIVE)
    primary_stiffness: Float[Number, ""] = number("N/m", "springs of a wheelset", NOT_NEGATIVE)
    primary_damping: Float[Number, ""] = number("N s/m", "dampers of a wheelset", NOT_NEGATIVE)
    secondary_stiffness: Float[Number, ""] = number(
        "N/m", "springs between body and bogie", NOT_NEGATIVE
    )
    secondary_damping: Float[Number, ""] = number(
        "N s/m", "dampers between body and bogie", NOT_NEGATIVE
    )
    bogie_distance: Float[Number, ""] = number("m", "distance between bogie centres", POSITIVE)
    wheelset_distance: Float[Number, ""] = number("m", "distance of wheelsets of a bogie", POSITIVE)

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
