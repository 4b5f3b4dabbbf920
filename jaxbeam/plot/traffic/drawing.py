"""Drawing of beams and vehicles, and of the parts that they are made of."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.path import Path

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import AbstractLoad, VehicleModel
from jaxbeam.case.loads.vehicles.vehicle import VehicleLoad
from jaxbeam.model.load_set import VehicleGroup, load_set
from jaxbeam.plot.style import GREY, INK, load_colour, tinted

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
    """Parts, wheels and springs to draw of one vehicle of a load, described or by matrices."""
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
    """Pairs of hinged parts, and positions (m) of the hinges."""
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


WHEEL_MARKER = Path.circle((0, 1), 1)
# Heights in diameters of a wheel.
SPRING, FRAME, BODY = 0.7, 0.5, 1.6
ROOM = 1.2  # length of a spring over its largest change
ZIGZAG = np.array([0.0, 0.2, 0.3, 0.5, 0.7, 0.8, 1.0]), np.array([0, 0, 1, -1, 1, 0, 0.0])


class VehicleArt:
    """Drawing of the vehicles of one load; `update` moves it.

    `wheels` is the index of its wheels, `dofs` the number of its degrees of freedom. `wheel_size`
    is the diameter of a wheel in points, `wheel_height` that in units of the vertical axis,
    `least_length` the length (m) of bodies that have none, such as the lumped mass of an axle.
    """

    def __init__(
        self, axes, case: Case, group: VehicleGroup, number, wheel_size, wheel_height, least_length
    ):
        load = case.carried[number]
        direction = float(concrete(load.trajectory(case.beam.length).direction()))
        self._vehicle = drawn_vehicle(load)
        self.wheels, self.wheels_per_vehicle = group.wheels, group.wheels_per_vehicle
        self.dofs = group.count * len(group.names)
        self._direction, self._unit, self._least = direction, wheel_height, least_length
        self._gaps = [SPRING * wheel_height, SPRING * wheel_height]
        tint = load_colour(number)
        style = {"edgecolors": INK, "linewidths": 0.9, "zorder": 2.7}
        self._boxes = axes.add_collection(
            PolyCollection([], facecolors=tinted(tint, 0.35), **style), autolim=False
        )
        self._springs = axes.add_collection(
            LineCollection([], colors=GREY, linewidths=0.8, zorder=2.6), autolim=False
        )
        (self._wheels,) = axes.plot([], [], linestyle="", marker=WHEEL_MARKER, zorder=2.8)
        # A marker is twice as large as its radius is.
        self._wheels.set(markersize=2 * wheel_size, color=tinted(tint, 0.75), markeredgecolor=INK)
        for artist in (self._boxes, self._springs, self._wheels):
            artist.set_in_layout(False)

    @property
    def height(self) -> float:
        """Height of the tallest vehicle in units of the vertical axis."""
        parts = self._vehicle.parts
        return max(self._base(part.level) + self._thickness(part) for part in parts)

    def make_room(self, surface, displacements) -> float:
        """Draw springs long enough for their largest changes of length; returns those together.

        The height of the surface under all wheels, (time, wheel), displacements (time, dof), and
        the result are in units of the vertical axis.
        """
        vehicle, times = self._vehicle, displacements.shape[0]
        u = displacements.reshape(times, -1, vehicle.parts[0].height.size)
        under = surface.reshape(times, u.shape[1], -1)
        strokes = [0.0, 0.0]  # on wheels, and between bodies
        for s, upper, lower in vehicle.springs:
            below = under[..., -1 - lower] if lower < 0 else vehicle.parts[lower].lift(s, u)
            stroke = np.max(np.abs(vehicle.parts[upper].lift(s, u) - below))
            strokes[int(lower >= 0)] = max(strokes[int(lower >= 0)], float(stroke))
        needed = [ROOM * stroke for stroke in strokes]
        self._gaps = [max(gap, room) for gap, room in zip(self._gaps, needed, strict=True)]
        return sum(needed)

    def update(self, positions, surface, displacements, follow=np.zeros_like, facing=None) -> None:
        """Draw at positions (m) of all wheels, heights of the surface under them, and bodies.

        Heights of the surface and displacements (by degree of freedom) are in units of the axis;
        `follow` are heights at positions on the beam that are added to those of the bodies;
        `facing` is 1 for a front on the right, else that of its trajectory.
        """
        self._follow = follow
        self._direction = self._direction if facing is None else facing
        self._wheels.set_data(positions, surface)
        count = self._vehicle.wheels.size
        boxes, lines = [], []
        vehicles = np.reshape(positions, (-1, count)), np.reshape(surface, (-1, count))
        motion = np.reshape(displacements, (vehicles[0].shape[0], -1))
        for first, heights, u in zip(vehicles[0][:, 0], vehicles[1], motion, strict=True):
            boxes += [self._box(part, first, u) for part in self._vehicle.parts]
            lines += [self._spring(*spring, first, heights, u) for spring in self._vehicle.springs]
        self._boxes.set_verts(boxes)
        self._springs.set_segments(lines)

    def _base(self, level: int) -> float:
        """Height of the lower side of a part above the surface."""
        on_wheels, between = self._gaps
        return self._unit + on_wheels + (level - 1) * (self._unit * FRAME + between)

    def _thickness(self, part) -> float:
        highest = part.level == max(other.level for other in self._vehicle.parts)
        return self._unit * (BODY if highest else FRAME)

    def _bottom(self, part, s, first, u):
        """Height of the lower side of a part at positions s (m) along the vehicle."""
        follow = self._follow(np.asarray(first + self._direction * s, float))
        return self._base(part.level) + part.lift(s, u) + follow

    def _ends(self, part):
        rear, front = part.ends
        least = self._least * (1.6 if part.level > 1 or len(self._vehicle.parts) == 1 else 1.0)
        more = max(0.0, least - (front - rear)) / 2
        return np.array([rear - more, front + more])

    def _box(self, part, first, u):
        ends = self._ends(part)
        bottom, x = self._bottom(part, ends, first, u), first + self._direction * ends
        top = bottom + self._thickness(part)
        return [(x[0], bottom[0]), (x[1], bottom[1]), (x[1], top[1]), (x[0], top[0])]

    def _spring(self, s, upper, lower, first, heights, u):
        high = self._bottom(self._vehicle.parts[upper], s, first, u)
        if lower >= 0:
            part = self._vehicle.parts[lower]
            low = self._bottom(part, s, first, u) + self._thickness(part)
        else:
            low = heights[-1 - lower] + self._unit
        along, across = ZIGZAG
        x = first + self._direction * s + 0.2 * self._least * across
        return np.column_stack([x, low + (high - low) * along])


def vehicle_art(axes, case: Case, wheel_size, wheel_height) -> list[VehicleArt]:
    """Drawings of the loads of a case that are vehicles; see `VehicleArt`."""
    loads, length = load_set(case), float(concrete(case.beam.length))
    return [
        VehicleArt(
            axes,
            case,
            group,
            loads.load_of_wheel[group.first_wheel],
            wheel_size,
            wheel_height,
            0.025 * length,
        )
        for group in loads.wheels.vehicles
    ]
