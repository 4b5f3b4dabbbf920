"""Drawing of beams with supports, actuators and sensors, and of vehicles with their parts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.path import Path

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.beam import END_CONDITIONS, Beam
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import AbstractLoad, VehicleModel, wheel_distances
from jaxbeam.case.loads.vehicles import VehicleLoad
from jaxbeam.model.load_set import VehicleGroup, load_set
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    INK,
    annotate,
    colour,
    drawing_area,
    load_colour,
    separate_labels,
    set_title,
    text_fraction,
    tinted,
    unit_scale,
    use_style,
)

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


# Markers in points, below the point of the beam they support.
_HATCH_LINES = [p for y in (-0.9, -0.5, -0.1, 0.3, 0.7) for p in ((0.0, y + 0.2), (-0.4, y))]
_WALL_LINES = [(0.0, -1.0), (0.0, 1.0), *_HATCH_LINES]


def _line_segments(points) -> Path:
    """Line segments between each two consecutive points."""
    return Path(points, [Path.MOVETO, Path.LINETO] * (len(points) // 2))


PIN_MARKER = Path([(0, 0), (-0.6, -1), (0.6, -1), (0, 0)], closed=True)
SPRING_MARKER = Path(
    [(0, 0), (0, -0.2), (0.3, -0.3), (-0.3, -0.45), (0.3, -0.6), (-0.3, -0.75), (0, -0.85),
     (0, -1), (-0.5, -1), (0.5, -1)]
)  # fmt: skip
ACTUATOR_MARKER = Path(
    [(0, 0), (0, -0.4), (-0.5, -0.4), (-0.5, -1), (0.5, -1), (0.5, -0.4), (0, -0.4)]
)
LOAD_MARKER = Path.circle((0, 1), 1)
# By what an end condition holds: deflection, rotation.
END_MARKERS = {
    (True, False): PIN_MARKER,
    (True, True): _line_segments(_WALL_LINES),
    (False, True): _line_segments(
        [*((x - 0.5, y) for x, y in _WALL_LINES), (0.0, -1.0), (0.0, 1.0)]
    ),
}


def _draw_marker(axes, x, y, marker, size, **style):
    _draw_markers(axes, [x], [y], marker, markersize=size, **style)


def _draw_markers(axes, x, y, marker, **style):
    style = {"markerfacecolor": "white", "markeredgecolor": INK, "markeredgewidth": 1.0} | style
    axes.plot(x, y, marker=marker, clip_on=False, zorder=3, **style)


def draw_supports(axes, case: Case, y: int | float = 0, size: int | float = 22) -> None:
    """Draw the ends and supports of a case at height y (data units); `size` is in points."""
    length = float(concrete(case.beam.length))
    for x, end, side in ((0.0, case.beam.left_end, 1), (length, case.beam.right_end, -1)):
        marker = END_MARKERS.get(END_CONDITIONS[end])
        if marker is not None:
            _draw_marker(axes, x, y, Path(marker.vertices * (side, 1), marker.codes), size)
    for support in case.supports:
        marker_path = PIN_MARKER if support.stiffness is None else SPRING_MARKER
        fill = "white" if support.stiffness is None else "none"
        _draw_marker(
            axes, float(concrete(support.position)), y, marker_path, size, markerfacecolor=fill
        )


def actuator_positions(actuator: AbstractActuator) -> list[float]:
    """Positions (m) at which an actuator acts: one for a point actuator, two for a patch."""
    return [float(concrete(position)) for position, _, _ in actuator.displacement_map()]


def shows_traffic(case: Case) -> bool:
    """Whether the schematic shows loads or a profile: vehicles, and several wheels in a row."""
    loads = load_set(case)
    return case.profile is not None or loads.wheel_count > len(case.carried) or any(loads.on_ground)


def draw_schematic(axes, case: Case) -> None:
    """Draw beam, supports, actuators, and sensors in their colours with their positions (m).

    Vehicles, where the first of them is in the middle, and the profile, its height to no scale.
    """
    length = float(concrete(case.beam.length))
    axes.plot([0, length], [0, 0], color=INK, linewidth=3, zorder=2)
    draw_supports(axes, case)
    for actuator in case.actuators:
        positions = actuator_positions(actuator)
        if len(positions) == 1:
            _draw_marker(axes, positions[0], 0, ACTUATOR_MARKER, 22, markeredgecolor=GREY)
        else:
            axes.plot(positions, [0, 0], color=COLOURS[4], linewidth=6, zorder=2.5)
    crossed = shows_traffic(case)
    xlim = (-0.02 * length, 1.02 * length)
    ylim = (-1.0, 1.7 if crossed else 1.0)
    axes.set(xlim=xlim, ylim=ylim)
    axes.axis("off")
    if crossed:
        _draw_traffic(axes, case)
    sensor_positions = np.array([float(concrete(sensor.position)) for sensor in case.sensors])
    side = {"va": "top"} if crossed else {}  # of the beam, where no vehicle is
    for i, x in enumerate(sensor_positions):
        axes.plot([x], [0], "o", color=colour(i), markersize=8, markeredgecolor="white", zorder=4)
    texts = {
        f"{x:.4g} m": (i, x) for i, x in enumerate(sensor_positions)
    }  # of sensors at one place
    gap = 1.04 * length * text_fraction(axes, max(map(len, texts), default=0) + 2)
    # Of more sensors than there is room for labels every second or third has one.
    labelled = list(texts.items())[:: 1 + int(gap * len(texts) / length)]
    supports = [0.0, length, *(float(concrete(one.position)) for one in case.supports)]
    places = separate_labels([x for _, (_, x) in labelled], gap, (0.0, length))
    for (text, (i, _)), place in zip(labelled, places, strict=True):
        above = any(abs(place - support) < gap / 2 for support in supports)
        offset = (0, (-13 if above else -9) if crossed else 9)
        annotate(axes, text, (place, 0), offset, ha="center", color=colour(i), **side)


def surface_height(case: Case, x) -> np.ndarray:
    """Height (m) of the profile at positions x (m), zero without one."""
    if case.profile is None:
        return np.zeros(np.shape(x))
    return np.asarray(concrete(case.profile.heights(np.asarray(x, float))[0]))


def _draw_traffic(axes, case: Case) -> None:
    """Draw the profile and the vehicles above the beam."""
    length = float(concrete(case.beam.length))
    left, right = axes.get_xlim()
    x = np.linspace(left, right, 401)
    profile = surface_height(case, x)
    highest = np.max(np.abs(profile)) or 1.0
    factor = highest / 0.12
    if case.profile is not None:
        axes.plot(x, profile / factor, color=GREY, linewidth=0.9, zorder=2.2)
    loads = load_set(case)
    if loads.wheel_count == 0:
        return
    art = vehicle_art(axes, case, 7.0, 0.3)
    times = np.linspace(0, float(concrete(case.run.duration)), 2001)
    positions = np.asarray(concrete(loads.kinematics(times)[0]))
    first = art[0].wheels if art else slice(0, None)
    count = art[0].wheels_per_vehicle if art else loads.wheel_count
    middle = np.mean(positions[first][:count], axis=0)
    now = positions[:, np.argmin(np.abs(middle - length / 2))]
    for one in art:
        here = now[one.wheels]
        one.update(here, surface_height(case, here) / factor, np.zeros(one.dofs))
    plain = now[~loads.on_ground]
    plain = plain[(plain >= 0) & (plain <= length)]
    if plain.size:
        style = {"markerfacecolor": COLOURS[5], "markersize": 14, "linestyle": ""}
        _draw_markers(axes, plain, surface_height(case, plain) / factor, LOAD_MARKER, **style)


AXES_WIDTH = 540.0  # points
MAX_LABELS = 12  # wheels with their static loads


@use_style
def plot_vehicles(
    loads: Sequence[AbstractLoad],
    titles: Sequence[str] = (),
    *,
    ax: Axes | None = None,
    title: str = "",
) -> Figure | SubFigure:
    """Vehicles of loads, one below the other, with static loads under gravity of 9.81 m/s^2.

    The front is on the right; positions are those in front of the last wheel, in m. `titles` are
    those of the loads, `title` that of the figure, which takes the place of `ax`. Raises ValueError
    without loads.
    """
    if not loads:
        raise ValueError("there is nothing to draw: give at least one load")
    figure = drawing_area(ax, (8, 0.4 + 1.8 * len(loads)))
    rows = figure.subplots(len(loads), 1, squeeze=False)[:, 0]
    for i, (axes, load) in enumerate(zip(rows, loads, strict=True)):
        _draw(axes, load)
        axes.set_title(titles[i] if i < len(titles) else load.kind)
    rows[-1].set_xlabel("position (m)")
    set_title(figure, title, "")
    return figure


def _draw(axes, load: AbstractLoad) -> None:
    behind = np.asarray(concrete(wheel_distances(load, load.vehicle(np.float64(9.81)))))
    span = float(np.max(behind))
    length = span or 3.0
    positions = span - behind
    case = Case(Beam(length, 1.0, 1.0), loads=[load])
    margin = 0.2 * length if span else length
    axes.set(xlim=(-margin, span + margin), ylim=(-0.9, 1.9))
    axes.axhline(0, color=GREY, linewidth=1.0)
    loads = load_set(case)
    for art in vehicle_art(axes, case, 9.0, 0.25):
        art.update(positions, np.zeros(positions.size), np.zeros(art.dofs), facing=1.0)
    if not loads.on_ground.any():
        gap = np.min(np.abs(np.diff(positions)), initial=length)
        size = float(np.clip(2 * AXES_WIDTH * gap / (1.4 * length), 6.0, 16.0))
        style = {"markerfacecolor": COLOURS[5], "markeredgecolor": INK, "markersize": size}
        axes.plot(positions, 0 * positions, linestyle="", marker=LOAD_MARKER, **style)
    static = np.asarray(concrete(loads.weight))[:, 0]
    factor, unit = unit_scale(static, "N")
    if static.size <= MAX_LABELS:
        for position, weight in zip(positions, static, strict=True):
            text = f"{weight / factor:.4g}"
            annotate(axes, text, (position, 0), (0, -6), ha="center", va="top", fontsize=8)
        where = {"transform": axes.transAxes, "ha": "right", "va": "top"}
        axes.text(1, 1, f"static loads in {unit}", color=GREY, fontsize=8, **where)
    axes.set_yticks([])
    axes.grid(False)
    axes.spines["left"].set_visible(False)
