"""Checks of the description of a planar vehicle: names, axles, hinges."""

import collections
from collections.abc import Iterator

import numpy as np

from jaxbeam.case.declared_checks import suggestion
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.loads.planar.parts import VehicleAxle, VehicleBody, VehicleHinge, VehicleSpring

Bodies = tuple[VehicleBody, ...]
Axles = tuple[VehicleAxle, ...]
Hinges = tuple[VehicleHinge, ...]


def description_errors(
    prefix: str, bodies: Bodies, springs: tuple[VehicleSpring, ...], hinges: Hinges, axles: Axles
) -> Iterator[str]:
    """Errors in the description of a vehicle as messages; the first one may cause the others.

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


def _ring_errors(prefix: str, names: list[str], hinges: Hinges) -> Iterator[str]:
    group = {name: name for name in names}
    for i, hinge in enumerate(hinges):
        first, second = group.get(hinge.first), group.get(hinge.second)
        if first == second:
            yield (
                f"{prefix}hinges.{i} closes a ring of hinged bodies, which could not move; make"
                " them one body, or leave the hinge out"
            )
        group = {name: first if one == second else one for name, one in group.items()}
