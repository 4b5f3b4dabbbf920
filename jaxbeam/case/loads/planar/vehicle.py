"""Planar vehicles of any bodies, springs, dampers, hinges and axles."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import POSITIVE, choice, number, parts
from jaxbeam.case.loads.planar.assembly import Bodies, Hinges, Links, Wheels, assemble
from jaxbeam.case.loads.planar.checks import description_errors
from jaxbeam.case.loads.planar.parts import (
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSpring,
)
from jaxbeam.case.loads.vehicle_checks import known_numbers, static_load_error
from jaxbeam.case.loads.vehicle_model import VehicleModel
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module


class PlanarVehicle(Module):
    """Vehicle of a vehicle file: its fields are the keys of the file, its parts are tables there.

    Bodies and hinges in any order, axles front first. `spacing` is the distance at which such
    vehicles follow one another.
    """

    title: str = choice("what the vehicle is", default="")
    source: str = choice("where the numbers are from", default="")
    bodies: tuple[VehicleBody, ...] = parts("rigid bodies", VehicleBody)
    springs: tuple[VehicleSpring, ...] = parts("springs between bodies", VehicleSpring)
    hinges: tuple[VehicleHinge, ...] = parts("hinges between bodies", VehicleHinge)
    axles: tuple[VehicleAxle, ...] = parts("axles, front first", VehicleAxle)
    spacing: Float[Array, ""] | None = number(
        "m", "distance from vehicle to vehicle in a row", POSITIVE, default=None
    )

    def validate(self, address: str) -> str | None:
        """First error in its description as a message, or None; `address` may be "".

        Refused are names that are missing or not unique, bodies that nothing holds, axles out of
        order or without suspension and tyre, hinges that close a ring, and axles without load.
        """
        prefix = f"{address}." if address else ""
        described = self.bodies, self.springs, self.hinges, self.axles
        error = next(description_errors(prefix, *described), None)
        if error is None and known_numbers(self):
            error = static_load_error(address or "the vehicle", self.model(np.ones(())))
        return error

    def model(self, gravity: Float[Array, ""]) -> VehicleModel:
        """Matrices and static wheel loads; gravity in m/s^2.

        Degrees of freedom are heights and pitches of the bodies in the order of the file, without
        the heights that hinges fix, then the heights of axles between suspension and tyre.
        """
        index = {body.name: i for i, body in enumerate(self.bodies)}
        moving = [i for i, axle in enumerate(self.axles) if _has_height(axle)]
        lumped, names = [self.axles[i] for i in moving], [f"axle {i + 1}" for i in moving]
        own = {axle: len(self.bodies) + i for i, axle in enumerate(moving)}
        bodies = Bodies(
            (*index, *names),
            _numbers([body.mass for body in (*self.bodies, *lumped)]),
            _numbers([body.position for body in (*self.bodies, *lumped)]),
            (*(body.inertia for body in self.bodies), *(None for _ in lumped)),
        )
        none = np.zeros(len(lumped))

        def of_springs(name):
            return _numbers([getattr(spring, name) for spring in self.springs])

        def with_suspensions(name):
            suspended = [getattr(axle, f"suspension_{name}") for axle in lumped]
            return xp.concatenate([of_springs(name), _numbers(suspended)])

        links = Links(
            (
                *((index[spring.first], index[spring.second]) for spring in self.springs),
                *((index[self.axles[i].body], own[i]) for i in moving),
            ),
            xp.concatenate([of_springs("position"), _numbers([axle.position for axle in lumped])]),
            with_suspensions("stiffness"),
            with_suspensions("damping"),
            xp.concatenate([of_springs("rotational_stiffness"), none]),
            xp.concatenate([of_springs("rotational_damping"), none]),
        )
        contacts = [_contact(axle) for axle in self.axles]
        wheels = Wheels(
            tuple(own.get(i, index[axle.body]) for i, axle in enumerate(self.axles)),
            _numbers([axle.position for axle in self.axles]),
            *(_numbers(column) for column in zip(*contacts, strict=True)),
        )
        hinges = Hinges(
            tuple((index[hinge.first], index[hinge.second]) for hinge in self.hinges),
            _numbers([hinge.position for hinge in self.hinges]),
        )
        return assemble(bodies, links, wheels, gravity, hinges)


def _numbers(values) -> Float[Array, " entry"]:
    return xp.stack(values) if len(values) else xp.zeros(0)


def _has_height(axle: VehicleAxle) -> bool:
    """Whether an axle moves between suspension and tyre."""
    return axle.suspension_stiffness is not None and axle.tyre_stiffness is not None


def _contact(axle: VehicleAxle):
    """Unsprung mass, spring and damper of the wheel on the surface."""
    if axle.tyre_stiffness is None:
        return axle.mass, axle.suspension_stiffness, axle.suspension_damping
    return xp.zeros_like(axle.mass), axle.tyre_stiffness, axle.tyre_damping
