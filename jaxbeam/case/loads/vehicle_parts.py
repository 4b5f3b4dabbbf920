"""Parts of planar vehicles: bodies, axles, springs, hinges, sensors, their checks and assembly.

Positions are in m along the vehicle, forward positive, from any common origin.

A body at x (m, forwards) with height u and pitch t, positive nose up, has the height u + (s - x) t
above the point s. The extensions R q of springs and the heights N q above wheels follow from the
heights H q and pitches T q of the bodies, linear in the degrees of freedom q:

    M = H^T m H + T^T I T,   K = R^T k R + Q^T kappa Q,   C likewise,

with masses m, moments of inertia I, and rotational springs kappa between the pitches, Q q. A hinge
between two bodies removes one height (an exact constraint). On a level surface at rest

    (K + N^T k_w N) q = -g H^T m,   P = -k_w N q + g m_w

give the static loads P of wheels with springs k_w and unsprung masses m_w: sum P is the weight.
"""

import collections
from collections.abc import Iterator
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    OF_QUANTITY,
    POSITIVE,
    PROBABILITY,
    choice,
    concrete,
    count,
    is_concrete,
    number,
    part,
    suggestion,
)
from jaxbeam.case.loads.base import VehicleModel
from jaxbeam.case.sensors import BODY_QUANTITIES, QUANTITIES, Filter
from jaxbeam.case.toml_file import in_si
from jaxbeam.runtime.arrays import Array, Module, Number, solve, xp


class VehicleBody(ReprWithUnits):
    """Rigid body; without `inertia` it has a height only, like the lumped mass of an axle.

    >>> import jaxbeam as jb
    >>> print(jb.vehicles.VehicleBody("car", mass=1500.0, inertia=2500.0))
    VehicleBody(name='car', mass=1500 kg, inertia=2500 kg m^2)
    """

    name: str = choice("name of the body")
    mass: Float[Number, ""] = number("kg", "mass", POSITIVE)
    inertia: Float[Number, ""] | None = number(
        "kg m^2", "moment of inertia in pitch", POSITIVE, default=None
    )
    position: Float[Number, ""] = number("m", "centre of mass, forward positive", default=0.0)


class VehicleSpring(ReprWithUnits):
    """Vertical spring and damper between two bodies at a position, and those between their pitches.

    A vertical force acts on both bodies along one line, hence at the same position.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.vehicles.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[
    ...                 jb.vehicles.VehicleBody("body", mass=8000.0),
    ...                 jb.vehicles.VehicleBody("frame", mass=2000.0),
    ...             ],
    ...             springs=[
    ...                 jb.vehicles.VehicleSpring(
    ...                     "body", "frame", position=0.0, stiffness=4e5, damping=1e4
    ...                 )
    ...             ],
    ...             axles=[jb.vehicles.VehicleAxle("frame", 0.0, suspension_stiffness=1e6)],
    ...         )
    ...     ],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.857 mm
    """

    first: str = choice("name of a body")
    second: str = choice("name of another body")
    position: Float[Number, ""] = number("m", "position, forward positive")
    stiffness: Float[Number, ""] = number("N/m", "spring", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "damper", NOT_NEGATIVE, default=0.0)
    rotational_stiffness: Float[Number, ""] = number(
        "N m/rad", "spring between the pitches", NOT_NEGATIVE, default=0.0
    )
    rotational_damping: Float[Number, ""] = number(
        "N m s/rad", "damper between the pitches", NOT_NEGATIVE, default=0.0
    )


class VehicleHinge(ReprWithUnits):
    """Point at which two bodies have the same height, exactly, such as a fifth wheel.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.vehicles.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[
    ...                 jb.vehicles.VehicleBody("tractor", mass=5000.0, inertia=2e4, position=0.0),
    ...                 jb.vehicles.VehicleBody("trailer", mass=15e3, inertia=8e4, position=-6.0),
    ...             ],
    ...             hinges=[jb.vehicles.VehicleHinge("tractor", "trailer", position=-1.5)],
    ...             axles=[
    ...                 jb.vehicles.VehicleAxle(
    ...                     "tractor", 2.0, suspension_stiffness=4e5, suspension_damping=1e4
    ...                 ),
    ...                 jb.vehicles.VehicleAxle(
    ...                     "tractor", -2.0, suspension_stiffness=4e5, suspension_damping=1e4
    ...                 ),
    ...                 jb.vehicles.VehicleAxle(
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
    position: Float[Number, ""] = number("m", "position, forward positive")


class VehicleAxle(ReprWithUnits):
    """Axle under a body: on a suspension, on a tyre, or on both with its mass in between.

    Without a tyre it stays on the surface, where its mass is unsprung, as that of a wheelset;
    without a suspension it is part of the body, which has its mass.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[
    ...         jb.vehicles.VehicleLoad(
    ...             speed=20.0,
    ...             bodies=[jb.vehicles.VehicleBody("car", mass=1500.0, inertia=2500.0)],
    ...             axles=[
    ...                 jb.vehicles.VehicleAxle(
    ...                     "car", 1.2, suspension_stiffness=4e4, suspension_damping=3e3
    ...                 ),
    ...                 jb.vehicles.VehicleAxle(
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
    position: Float[Number, ""] = number("m", "position, forward positive")
    mass: Float[Number, ""] = number("kg", "mass", NOT_NEGATIVE, default=0.0)
    suspension_stiffness: Float[Number, ""] | None = number(
        "N/m", "spring between body and axle", POSITIVE, default=None
    )
    suspension_damping: Float[Number, ""] = number(
        "N s/m", "damper between body and axle", NOT_NEGATIVE, default=0.0
    )
    tyre_stiffness: Float[Number, ""] | None = number(
        "N/m", "spring between axle and surface", POSITIVE, default=None
    )
    tyre_damping: Float[Number, ""] = number(
        "N s/m", "damper between axle and surface", NOT_NEGATIVE, default=0.0
    )


_Bodies = tuple[VehicleBody, ...]
Axles = tuple[VehicleAxle, ...]
_Hinges = tuple[VehicleHinge, ...]


def description_errors(
    prefix: str, bodies: _Bodies, springs: tuple[VehicleSpring, ...], hinges: _Hinges, axles: Axles
) -> Iterator[str]:
    """Error messages of a vehicle's description; the first error may cause the others.

    `prefix` begins the addresses of its parts.
    """
    for key, listed in (("bodies", bodies), ("axles", axles)):
        if not listed:
            yield f"{prefix}{key} is missing; a vehicle needs bodies on axles: write [[{key}]]"
    names = [body.name for body in bodies]
    yield from _name_errors(prefix, names)
    for key, links in (("springs", springs), ("hinges", hinges)):
        for i, link in enumerate(links):
            for end in ("first", "second"):
                yield from _unknown_body(f"{prefix}{key}.{i}.{end}", getattr(link, end), names)
            if link.first == link.second:
                yield f"{prefix}{key}.{i} joins {link.first!r} to itself; name two bodies"
    for i, axle in enumerate(axles):
        yield from _unknown_body(f"{prefix}axles.{i}.body", axle.body, names)
        yield from _axle_errors(f"{prefix}axles.{i}", axle)
    yield from _order_errors(prefix, axles)
    yield from _ring_errors(prefix, names, hinges)


def _name_errors(prefix: str, names: list[str]) -> Iterator[str]:
    for name, times in collections.Counter(names).items():
        if times > 1:
            yield f"{prefix}bodies has {times} bodies of the name {name!r}; give each its own"
    for i, name in enumerate(names):
        if name.endswith("pitch") or name.startswith("axle "):
            yield (
                f"{prefix}bodies.{i}.name cannot be {name!r}, which reads as a pitch or an axle of"
                " the results; choose another"
            )


def _unknown_body(address: str, name: str, names: list[str]) -> Iterator[str]:
    if name not in names:
        yield f"{address} cannot be {name!r}, which is no body; {suggestion(name, names)}"


def _axle_errors(address: str, axle: VehicleAxle) -> Iterator[str]:
    suspended, tyred = axle.suspension_stiffness is not None, axle.tyre_stiffness is not None

    def is_zero(value):
        return is_concrete(value) and concrete(value) == 0

    if not suspended and not tyred:
        yield (
            f"{address} has neither suspension_stiffness nor tyre_stiffness; give one of them: a"
            " body does not stand on the surface without a spring"
        )
    if suspended and tyred and is_zero(axle.mass):
        yield (
            f"{address}.mass must be positive between suspension and tyre; for an axle without mass"
            " leave out one of the springs"
        )
    if tyred and not suspended and not is_zero(axle.mass):
        yield (
            f"{address}.mass belongs to {axle.body!r}, as the axle has no suspension; add it to"
            " the body's mass and inertia"
        )
    for name, present in (("suspension", suspended), ("tyre", tyred)):
        if not present and not is_zero(getattr(axle, f"{name}_damping")):
            yield f"{address}.{name}_damping would have no effect; give {name}_stiffness, too"


def _order_errors(prefix: str, axles: Axles) -> Iterator[str]:
    positions = [axle.position for axle in axles]
    if not all(map(is_concrete, positions)):
        return
    numbers = np.array([float(concrete(position)) for position in positions])
    for i in np.flatnonzero(numbers[1:] >= numbers[:-1]) + 1:
        yield (
            f"{prefix}axles.{i}.position must be below that of the axle before it,"
            f" {numbers[i - 1]:g} m; it is {numbers[i]:g} m: list the axles front first"
        )


def _ring_errors(prefix: str, names: list[str], hinges: _Hinges) -> Iterator[str]:
    group = {name: name for name in names}
    for i, hinge in enumerate(hinges):
        first, second = group.get(hinge.first), group.get(hinge.second)
        if first == second:
            yield (
                f"{prefix}hinges.{i} closes a ring of hinged bodies, which could not move; make"
                " them one body, or leave the hinge out"
            )
        group = {name: first if one == second else one for name, one in group.items()}


class VehicleSensor(ReprWithUnits, Module):
    """Sensor of the vertical motion of a body or axle of a vehicle or absorber, positive upwards.

    `absorber` is the number of an absorber, whose motion relative to the beam is its "stroke", in
    place of a vehicle. `load` is the number of the load, `vehicle` that of the vehicle in its row,
    both from 0; `body` a name of `Record.bodies` without the load, as "body" or "axle 1". At
    `position` (m) forward of the centre of mass it feels the pitch as well. Displacements are from
    static equilibrium. The other entries are those of `Sensor`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3),
    ...     loads=[jb.vehicles.VehicleLoad(model="half-truck", speed=20.0)],
    ...     vehicle_sensors=[jb.vehicles.VehicleSensor(body="axle 1", quantity="acceleration")],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(case.vehicle_sensors[0].unit)
    m/s^2
    """

    # What a sensor on the beam may have and this one has not.
    range: ClassVar[None] = None
    resolution: ClassVar[None] = None
    has_feedthrough: ClassVar[bool] = True  # there is no history of the rate of an acceleration
    bends: ClassVar[bool] = False

    load: int = count("number of the load, from 0", minimum=0, default=0)
    body: str = choice("name of the body or axle", default="body")
    quantity: str = choice("measured quantity", *BODY_QUANTITIES, default="acceleration")
    vehicle: int = count("number of the vehicle in a row, from 0", minimum=0, default=0)
    position: Float[Number, ""] = number("m", "forward of the centre of mass", default=0.0)
    absorber: int | None = count(
        "number of an absorber, from 0, in place of a load", minimum=0, default=None, kw_only=True
    )
    offset: Float[Number, ""] = number(OF_QUANTITY, "constant added", default=0.0)
    noise: Float[Number, ""] | None = number(
        OF_QUANTITY, "standard deviation of white noise", NOT_NEGATIVE, default=None
    )
    filter: Filter | None = part("filter of the signal or of its samples", Filter)
    sampling_period: Float[Number, ""] | None = number(
        "s", "time between readings; that of the run if left out", POSITIVE, default=None
    )
    delay: Float[Number, ""] | None = number(
        "s", "from motion to reading", NOT_NEGATIVE, default=None
    )
    dropout: Float[Number, ""] | None = number(
        "1", "probability that a reading is lost", PROBABILITY, default=None, kw_only=True
    )
    jitter: Float[Number, ""] | None = number(
        "s", "largest random delay of a reading", NOT_NEGATIVE, default=None, kw_only=True
    )

    def __post_init__(self):
        for name in ("offset", "noise"):
            value = getattr(self, name)
            if isinstance(value, str) and self.quantity in BODY_QUANTITIES:
                setattr(self, name, in_si(value, self.unit, name))

    @property
    def unit(self) -> str:
        """SI unit of the readings."""
        return QUANTITIES[BODY_QUANTITIES[self.quantity]].unit


Pairs = tuple[tuple[int, int], ...]


class Bodies(NamedTuple):
    """Bodies: names, masses (kg), positions of their centres of mass (m), inertias (kg m^2).

    A body without inertia (None), such as the lumped mass of an axle, has a height only.
    """

    names: tuple[str, ...]
    masses: Float[Array, " body"]
    positions: Float[Array, " body"]
    inertias: tuple[Float[Array, ""] | None, ...]


class Links(NamedTuple):
    """Springs (N/m, N m/rad) and dampers (N s/m, N m s/rad) between pairs of bodies."""

    pairs: Pairs
    positions: Float[Array, " link"]
    stiffness: Float[Array, " link"]
    damping: Float[Array, " link"]
    rotational_stiffness: Float[Array, " link"] | None = None
    rotational_damping: Float[Array, " link"] | None = None


class Hinges(NamedTuple):
    """Points (m) at which pairs of bodies have the same height."""

    pairs: Pairs
    positions: Float[Array, " hinge"]


class Wheels(NamedTuple):
    """Wheels under bodies, front first: springs (N/m), dampers (N s/m) and unsprung masses (kg)."""

    bodies: tuple[int, ...]
    positions: Float[Array, " wheel"]
    masses: Float[Array, " wheel"]
    stiffness: Float[Array, " wheel"]
    damping: Float[Array, " wheel"]


NO_HINGES = Hinges((), np.zeros(0))


def assemble(
    bodies: Bodies,
    links: Links,
    wheels: Wheels,
    gravity: Float[Array, ""],
    hinges: Hinges = NO_HINGES,
) -> VehicleModel:
    """Matrices and static wheel loads of a planar vehicle; see the module. Gravity in m/s^2.

    Static loads are not finite if the springs hold the vehicle in no equilibrium.
    """
    heights, pitches, names = _coordinates(bodies, hinges)
    inertias = xp.array([0.0 if one is None else one for one in bodies.inertias])
    ends = _incidence(links.pairs, len(bodies.names))
    under = np.eye(len(bodies.names))[list(wheels.bodies)]

    def heights_at(selection, positions):
        levers = selection * (positions[:, None] - bodies.positions[None, :])
        return selection @ heights + levers @ pitches

    extensions = heights_at(ends, links.positions)
    wheel_map = heights_at(under, wheels.positions)
    mass = heights.T @ (bodies.masses[:, None] * heights) + pitches.T @ (
        inertias[:, None] * pitches
    )
    stiffness = extensions.T @ (links.stiffness[:, None] * extensions)
    damping = extensions.T @ (links.damping[:, None] * extensions)
    rotations = ends @ pitches
    if links.rotational_stiffness is not None:
        stiffness = stiffness + rotations.T @ (links.rotational_stiffness[:, None] * rotations)
    if links.rotational_damping is not None:
        damping = damping + rotations.T @ (links.rotational_damping[:, None] * rotations)
    total = stiffness + wheel_map.T @ (wheels.stiffness[:, None] * wheel_map)
    sag = solve(total, heights.T @ bodies.masses)  # under unit gravity, downwards
    static_loads = gravity * (wheels.stiffness * (wheel_map @ sag) + wheels.masses)
    return VehicleModel(
        wheels.positions[0] - wheels.positions,
        static_loads,
        wheels.masses,
        wheels.stiffness,
        wheels.damping,
        mass,
        damping,
        stiffness,
        wheel_map,
        names,
    )


def _incidence(pairs: Pairs, body_count: int) -> Float[np.ndarray, "pair body"]:
    """1 and -1 at the two bodies of each pair."""
    one = np.eye(body_count)
    return np.array([one[first] - one[second] for first, second in pairs]).reshape(-1, body_count)


def _coordinates(bodies: Bodies, hinges: Hinges):
    """Heights and pitches of the bodies by the degrees of freedom, (body, dof), and their names."""
    names, height_columns, pitches = [], [], []
    for name, inertia in zip(bodies.names, bodies.inertias, strict=True):
        height_columns.append(len(names))
        names.append(name)
        if inertia is not None:
            names.append(f"{name} pitch")
    one = np.eye(len(names))
    for column, inertia in zip(height_columns, bodies.inertias, strict=True):
        pitches.append(np.zeros(len(names)) if inertia is None else one[column + 1])
    rows = [one[column] for column in height_columns]
    # Hinged bodies are groups with one free height, that of their first body.
    group, eliminated = list(range(len(rows))), []
    for i, (first, second) in enumerate(hinges.pairs):
        if group[first] > group[second]:
            first, second = second, first
        keep, leave = group[first], group[second]
        point = hinges.positions[i]
        difference = (
            rows[first]
            + (point - bodies.positions[first]) * pitches[first]
            - rows[second]
            - (point - bodies.positions[second]) * pitches[second]
        )
        members = [j for j, one_group in enumerate(group) if one_group == leave]
        for j in members:
            rows[j] = rows[j] + difference
            group[j] = keep
        eliminated.append(height_columns[leave])
    kept = np.array([j for j in range(len(names)) if j not in eliminated], int)
    heights = xp.stack(rows)[:, kept]
    return heights, np.array(pitches)[:, kept], tuple(names[j] for j in kept)
