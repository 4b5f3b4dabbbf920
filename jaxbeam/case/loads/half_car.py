"""Half car: a body that bounces and pitches on any number of axles."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.case.loads.planar.assembly import Bodies, Links, Wheels, assemble
from jaxbeam.case.loads.vehicle_checks import (
    known_numbers,
    length_error,
    positive_error,
    static_load_error,
)
from jaxbeam.runtime.arrays import Array, xp

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
    ...         jb.HalfCar(
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

    body_mass: Float[Array, ""] = number("kg", "mass of the body", POSITIVE)
    body_inertia: Float[Array, ""] = number(
        "kg m^2", "moment of inertia of the body in pitch", POSITIVE
    )
    axle_positions: Float[Array, " axle"] = number(
        "m", "axles forward of the body's centre of mass, front first"
    )
    axle_masses: Float[Array, " axle"] = number("kg", "masses of the axles", POSITIVE)
    suspension_stiffness: Float[Array, " axle"] = number("N/m", "springs of the body", NOT_NEGATIVE)
    suspension_damping: Float[Array, " axle"] = number("N s/m", "dampers of the body", NOT_NEGATIVE)
    tyre_stiffness: Float[Array, " axle"] = number("N/m", "springs of the tyres", NOT_NEGATIVE)
    tyre_damping: Float[Array, " axle"] = number("N s/m", "dampers of the tyres", NOT_NEGATIVE)

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
        if error is None and known_numbers(self):
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
