"""Parts of vehicles to draw: where bodies are, how long, one above the other, and their springs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.vehicle import VehicleLoad
from jaxbeam.case.loads.vehicle_model import VehicleModel

OVERHANG = 0.12  # of a body beyond what carries it, over the length between


class VehiclePart(NamedTuple):
    """Body of a vehicle; positions (m) are those forward of the first wheel.

    Its height above a point s is (height + (s - position) pitch) u, with rows for the degrees of
    freedom u. `level` counts from 1, that on the wheels; `ends` are its rear and front, equal for
    the lumped mass of an axle.
    """

    name: str
    position: float
    height: Float[np.ndarray, " dof"]
    pitch: Float[np.ndarray, " dof"]
    level: int
    ends: tuple[float, float]

    def lift(self, s, u):
        """Height above points s (m) for degrees of freedom u, (..., dof)."""
        return u @ self.height + (s - self.position) * (u @ self.pitch)


class DrawnVehicle(NamedTuple):
    """Parts of a vehicle, positions of its wheels (m), and springs.

    A spring is at a position, between an upper part and a lower part, or a wheel (-1 - its number).
    """

    parts: list[VehiclePart]
    wheels: Float[np.ndarray, " wheel"]
    springs: list[tuple[float, int, int]]


def drawn_vehicle(load: AbstractLoad | Absorber, gravity=9.81) -> DrawnVehicle:
    """What to draw of one vehicle of a load; parts that carry nothing else are found by springs."""
    model = load.vehicle(np.float64(gravity))
    if isinstance(load, VehicleLoad):
        names, positions, springs = _described(load)
    else:
        names, positions, springs = _inferred(model)
    wheels = -np.asarray(concrete(model.offsets))
    columns = {name: np.eye(len(model.names))[i] for i, name in enumerate(model.names)}
    none = np.zeros(len(model.names))
    pitches = [columns.get(f"{name} pitch", none) for name in names]
    heights = [columns.get(name) for name in names]
    hinges = _hinges(load, names)
    for (first, second), point in hinges * len(hinges):  # in any order
        for one, other in ((first, second), (second, first)):
            height = heights[one]
            if heights[other] is None and height is not None:
                at_hinge = height + (point - positions[one]) * pitches[one]
                heights[other] = at_hinge - (point - positions[other]) * pitches[other]
    parts = []
    for i, name in enumerate(names):
        carried_at = [s for s, upper, _ in springs if upper == i] or [positions[i]]
        carried_at += [point for pair, point in hinges if i in pair]
        span = max(carried_at) - min(carried_at)
        level = _level(i, springs)
        more = OVERHANG * span
        ends = min(carried_at) - more, max(carried_at) + more
        height = none if heights[i] is None else heights[i]
        parts.append(VehiclePart(name, positions[i], height, pitches[i], level, ends))
    return DrawnVehicle(parts, wheels, springs)


def _level(part: int, springs, depth: int = 0) -> int:
    """Level of a part: one above the highest of those that carry it."""
    below = [lower for _, upper, lower in springs if upper == part and lower >= 0]
    if not below or depth > len(springs):
        return 1
    return 1 + max(_level(lower, springs, depth + 1) for lower in below)


def _hinges(load: AbstractLoad, names: list[str]) -> list[tuple[tuple[int, int], float]]:
    """Pairs of hinged parts, and where (m)."""
    if not isinstance(load, VehicleLoad):
        return []
    origin = float(concrete(load.axles[0].position))
    return [
        ((names.index(one.first), names.index(one.second)), float(concrete(one.position)) - origin)
        for one in load.hinges
    ]


def _described(load: VehicleLoad):
    """Names and positions of the parts, and springs, of a described vehicle."""
    origin = float(concrete(load.axles[0].position))

    def place(part):
        return float(concrete(part.position)) - origin

    names, positions = [b.name for b in load.bodies], [place(b) for b in load.bodies]
    springs = []
    for i, axle in enumerate(load.axles):
        lower, body = -1 - i, names.index(axle.body)
        if axle.suspension_stiffness is not None and axle.tyre_stiffness is not None:
            names.append(f"axle {i + 1}")
            positions.append(place(axle))
            springs.append((place(axle), len(names) - 1, lower))
            lower = len(names) - 1
        springs.append((place(axle), body, lower))
    carried = {names.index(axle.body) for axle in load.axles}
    for spring in load.springs:
        if float(concrete(spring.stiffness)) == 0.0:
            continue
        pair = names.index(spring.first), names.index(spring.second)
        upper, lower = sorted(pair, key=lambda part: part in carried)
        springs.append((place(spring), upper, lower))
    return names, positions, springs


def _inferred(model: VehicleModel):
    """Names and positions of the parts, and springs, of matrices.

    The springs between the bodies of a vehicle do not feel a rotation of the whole, heights x and
    pitches 1; above the wheels the heights are then the positions of the wheels.
    """
    names = [name for name in model.names if not name.endswith(" pitch")]
    index = {name: i for i, name in enumerate(model.names)}
    columns = [index[name] for name in names]
    is_pitch = np.array([name.endswith(" pitch") for name in model.names], float)
    inner, levers = np.asarray(concrete(model.stiffness)), np.asarray(concrete(model.wheel_map))
    inner = inner / (np.max(np.abs(inner), initial=0.0) or 1.0)
    wheels = -np.asarray(concrete(model.offsets))
    matrix = np.concatenate([inner, levers])
    right = np.concatenate([np.zeros(len(is_pitch)), wheels]) - matrix @ is_pitch
    positions = np.linalg.lstsq(matrix[:, columns], right, rcond=None)[0].tolist()
    springs, on_wheels = [], set()
    for wheel, row in enumerate(levers):
        part = int(np.argmax(np.abs(row[columns])))
        on_wheels.add(part)
        springs.append((float(wheels[wheel]), part, -1 - wheel))
    for lower in sorted(on_wheels):
        for upper, name in enumerate(names):
            if upper not in on_wheels and inner[index[name], columns[lower]] != 0:
                springs.append((positions[lower], upper, lower))
    return names, positions, springs
