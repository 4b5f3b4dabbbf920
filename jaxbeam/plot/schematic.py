"""Schematic of a case: beam, ends, supports, actuators and sensors at their positions."""

import numpy as np
from matplotlib.path import Path

from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.load_set import load_set
from jaxbeam.plot.style import COLOURS, GREY, INK, annotate, colour, separate_labels, text_fraction
from jaxbeam.plot.traffic.drawing import vehicle_art

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
