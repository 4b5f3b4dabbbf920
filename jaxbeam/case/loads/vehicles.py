"""Vehicles: oscillators, half cars and wagons, planar vehicles from files or the library, trains.

A planar vehicle has bodies on axles, springs and hinges.
"""

import dataclasses
import functools
import os
import tomllib
from collections.abc import Sequence
from importlib import resources
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    POSITIVE,
    all_concrete,
    check_fields,
    choice,
    concrete,
    is_concrete,
    number,
    parts,
    suggestion,
)
from jaxbeam.case.loads.base import (
    AbstractRowLoad,
    AbstractVehicleLoad,
    VehicleModel,
    length_error,
    positive_error,
    static_load_error,
)
from jaxbeam.case.loads.vehicle_parts import (
    Bodies,
    Hinges,
    Links,
    VehicleAxle,
    VehicleBody,
    VehicleHinge,
    VehicleSensor,
    VehicleSpring,
    Wheels,
    assemble,
    description_errors,
)
from jaxbeam.case.tables import read_part
from jaxbeam.case.toml_file import read_toml
from jaxbeam.runtime.arrays import Array, Module, Number, block_diag, xp

__all__ = [
    "Coach",
    "HalfCar",
    "Oscillator",
    "QuarterCar",
    "TrainLoad",
    "VehicleAxle",
    "VehicleBody",
    "VehicleHinge",
    "VehicleLoad",
    "VehicleSensor",
    "VehicleSpring",
    "Wagon",
    "load_vehicle",
]


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


class PlanarVehicle(Module):
    """Vehicle of a vehicle file: its fields are the keys of the file, its parts are tables there.

    Bodies and hinges in any order, axles front first. `spacing` is the distance at which such
    vehicles follow one another.
    """

    title: str = choice("what the vehicle is", default="")
    source: str = choice("where the numbers are from", default="")
    bodies: Sequence[VehicleBody] = parts("rigid bodies", VehicleBody)
    springs: Sequence[VehicleSpring] = parts("springs between bodies", VehicleSpring)
    hinges: Sequence[VehicleHinge] = parts("hinges between bodies", VehicleHinge)
    axles: Sequence[VehicleAxle] = parts("axles, front first", VehicleAxle)
    spacing: Float[Number, ""] | None = number(
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
        if error is None and all_concrete(self):
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


def is_path(model: str) -> bool:
    """Whether the model of a vehicle is the path of a file, not a name of the library."""
    return model.endswith(".toml")


@functools.cache
def vehicle_names() -> tuple[str, ...]:
    """Names of the vehicles of the library."""
    folder = resources.files("jaxbeam.case.library") / "models"
    names = (entry.name for entry in folder.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def load_vehicle(model: str | os.PathLike) -> PlanarVehicle:
    """The validated vehicle of a file, whose name ends in .toml, or of the library.

    Raises ValueError for an unknown name, and with the file and the address for whatever is wrong
    in a file; OSError if it cannot be read.

    `model` is the name, or the path of the file.

    >>> import jaxbeam as jb
    >>> print(jb.vehicles.load_vehicle("truck-5-axle").title)
    Articulated truck: tractor with two axles, trailer with three
    """
    if isinstance(model, str) and not is_path(model):
        if model not in vehicle_names():
            raise ValueError(unknown_vehicle(model))
        return _library_vehicle(model)
    content = read_toml(model, "vehicle file")
    try:
        vehicle = read_part("", content, PlanarVehicle)
        check_vehicle(vehicle)
    except ValueError as error:
        raise ValueError(f"{model}: {str(error).lstrip('. ')}") from None
    return vehicle


def unknown_vehicle(name: str) -> str:
    """Error message for a name that the library does not have."""
    return (
        f"there is no vehicle {name!r} in the library (the name of a file ends in .toml);"
        f" {suggestion(name, vehicle_names())}"
    )


def check_vehicle(vehicle: PlanarVehicle) -> None:
    """Validate a vehicle; raises ValueError with the address of the first error."""
    check_fields("", vehicle)
    error = vehicle.validate("")
    if error is not None:
        raise ValueError(error)


@functools.cache
def _library_vehicle(name: str) -> PlanarVehicle:
    text = (resources.files("jaxbeam.case.library") / "models" / f"{name}.toml").read_text("utf-8")
    return read_part("", tomllib.loads(text), PlanarVehicle)


PER_WHEEL = ("static_loads", "wheel_masses", "contact_stiffness", "contact_damping")
MATRICES = ("mass", "damping", "stiffness")


class Coach(Module):
    """Vehicles of one kind in a train, `count` one behind the other.

    `length` over couplers is that of the vehicle file if it is left out; the wheels are in the
    middle of it.

    >>> import jaxbeam as jb
    >>> coach = jb.vehicles.Coach("manchester-wagon", count=4)
    >>> print(coach.count, "coaches of", coach.coupler_length(), "m")
    4 coaches of 25.0 m
    """

    model: str = choice("name of a vehicle of the library, or path of a vehicle file")
    count: int = fields.count("number of vehicles in a row", default=1)
    length: Float[Number, ""] | None = number("m", "length over couplers", POSITIVE, default=None)

    def vehicle(self) -> PlanarVehicle:
        """The vehicle of its file, or of the library."""
        return load_vehicle(self.model)

    def coupler_length(self) -> Float[Array, ""] | None:
        """Length over couplers (m); None if neither it nor the file gives one."""
        return self.vehicle().spacing if self.length is None else self.length


class TrainLoad(AbstractVehicleLoad):
    """Vehicles of several kinds, `coaches` from the front on, coupled without forces between them.

    They are one load with one trajectory, that of the first wheel of the train.

    >>> import jaxbeam as jb
    >>> wagons = jb.vehicles.Coach("manchester-wagon", count=2)
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.vehicles.TrainLoad(speed=50.0, coaches=[wagons])],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    7.645 mm
    """

    kind: ClassVar[str] = "train"

    coaches: Sequence[Coach] = parts("vehicles, front first", Coach)

    def validate(self, address):
        if not self.coaches:
            return f"{address}.coaches has no entry; give at least one vehicle, with its model"
        for i, coach in enumerate(self.coaches):
            own = f"{address}.coaches.{i}"
            if not is_path(coach.model) and coach.model not in vehicle_names():
                return f"{own}.model: {unknown_vehicle(coach.model)}"
            length = coach.coupler_length()
            if length is None:
                return (
                    f"{own}.length is missing, and {coach.model} has no spacing in its file; give"
                    " the length over couplers in m"
                )
            axles = coach.vehicle().axles
            wheelbase = concrete(axles[0].position - axles[-1].position)
            if is_concrete(length) and concrete(length) <= wheelbase:
                return (
                    f"{own}.length must exceed the wheelbase of {coach.model}, {wheelbase:g} m; it"
                    f" is {concrete(length):g} m"
                )
        return super().validate(address)

    def vehicle(self, gravity):
        models, behind, end = [], [], 0.0
        for coach in self.coaches:
            model, length = coach.vehicle().model(gravity), coach.coupler_length()
            overhang = (length - model.offsets[-1]) / 2
            for _ in range(coach.count):
                models.append(model)
                behind.append(end + overhang + model.offsets)
                end = end + length
        behind = [offsets - behind[0][0] for offsets in behind]
        return _coupled(models, behind)


def _coupled(models: list[VehicleModel], behind) -> VehicleModel:
    """One vehicle model of several in a row; names begin with the vehicle's number, from 1."""
    names = tuple(f"coach {i + 1} {name}" for i, one in enumerate(models) for name in one.names)
    rows, column = [], 0
    for one in models:
        size, dofs = one.wheel_map.shape
        rest = len(names) - column - dofs
        row = xp.zeros((size, column)), one.wheel_map, xp.zeros((size, rest))
        rows.append(xp.concatenate(row, axis=1))
        column += dofs
    lists = {name: xp.concatenate([getattr(one, name) for one in models]) for name in PER_WHEEL}
    matrices = {name: block_diag(*(getattr(one, name) for one in models)) for name in MATRICES}
    offsets, wheel_map = xp.concatenate(behind), xp.concatenate(rows)
    return VehicleModel(offsets=offsets, wheel_map=wheel_map, names=names, **lists, **matrices)


DESCRIPTION = ("bodies", "springs", "hinges", "axles", "spacing")
IMPLIED = {"model": DESCRIPTION}  # entries of a load that follow from another one


class VehicleLoad(AbstractRowLoad):
    """Vehicle of the library, of a vehicle file, or of tables in the case; `count` in a row.

    `model` is a name of the library or the path of a vehicle file (see `planar.files`), whose
    numbers become those of the load: `loads.0.bodies.0.mass`. Tables given with a model replace
    those of the model. The load of a file keeps the numbers, not the path.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.vehicles.VehicleLoad(model="half-truck", speed=20.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.936 mm
    """

    kind: ClassVar[str] = "vehicle"

    model: str = choice("name of a vehicle of the library, or path of a vehicle file", default="")
    bodies: Sequence[VehicleBody] = parts("rigid bodies", VehicleBody)
    springs: Sequence[VehicleSpring] = parts("springs between bodies", VehicleSpring)
    hinges: Sequence[VehicleHinge] = parts("hinges between bodies", VehicleHinge)
    axles: Sequence[VehicleAxle] = parts("axles, front first", VehicleAxle)

    def __post_init__(self):
        if not isinstance(self.model, str) or not (
            is_path(self.model) or self.model in vehicle_names()
        ):
            return  # none, or one that `validate` refuses
        vehicle = load_vehicle(self.model)
        for name in DESCRIPTION:
            value = getattr(self, name)
            if value is None or (isinstance(value, tuple | list) and not value):
                setattr(self, name, getattr(vehicle, name))
        if is_path(self.model):
            self.model = ""

    def implied_fields(self) -> tuple[str, ...]:
        """Names of the fields that follow from the model."""
        if self.model not in vehicle_names():
            return ()
        vehicle = load_vehicle(self.model)
        return tuple(
            name
            for name in DESCRIPTION
            if eqx.tree_equal(getattr(self, name), getattr(vehicle, name)) is True
        )

    def by_numbers(self):
        return dataclasses.replace(self, model="")

    def planar_vehicle(self) -> PlanarVehicle:
        """Description of one of its vehicles."""
        return PlanarVehicle(
            bodies=self.bodies, springs=self.springs, hinges=self.hinges, axles=self.axles
        )

    def validate(self, address):
        if self.model and self.model not in vehicle_names():
            return f"{address}.model: {unknown_vehicle(self.model)}"
        if not self.bodies:
            return (
                f"{address} has neither model nor bodies; name a vehicle of the library, or give a"
                " vehicle file"
            )
        error = self.planar_vehicle().validate(address) or super().validate(address)
        wheelbase = self.axles[0].position - self.axles[-1].position if self.axles else 0.0
        return error or self.overlap_error(address, wheelbase, "vehicle")

    def vehicle(self, gravity):
        return self.planar_vehicle().model(gravity)
