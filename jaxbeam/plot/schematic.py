"""Schematic of a case: beam, ends, supports, actuators and sensors at their positions."""

import numpy as np
from matplotlib.path import Path

from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.plot.style import COLOURS, GREY, INK, annotate, colour, separate_labels

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
    style = {"markerfacecolor": "white", "markeredgecolor": INK, "markeredgewidth": 1.0} | style
    axes.plot([x], [y], marker=marker, markersize=size, clip_on=False, zorder=3, **style)


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


def draw_schematic(axes, case: Case) -> None:
    """Draw beam, supports, actuators, and sensors in their colours with their positions (m)."""
    length = float(concrete(case.beam.length))
    axes.plot([0, length], [0, 0], color=INK, linewidth=3, zorder=2)
    draw_supports(axes, case)
    for actuator in case.actuators:
        positions = actuator_positions(actuator)
        if len(positions) == 1:
            _draw_marker(axes, positions[0], 0, ACTUATOR_MARKER, 22, markeredgecolor=GREY)
        else:
            axes.plot(positions, [0, 0], color=COLOURS[4], linewidth=6, zorder=2.5)
    sensor_positions = np.array([float(concrete(sensor.position)) for sensor in case.sensors])
    for i, (x, label_position) in enumerate(
        zip(sensor_positions, separate_labels(sensor_positions, 0.08 * length), strict=True)
    ):
        axes.plot([x], [0], "o", color=colour(i), markersize=8, markeredgecolor="white", zorder=4)
        annotate(axes, f"{x:.4g} m", (label_position, 0), (0, 9), ha="center", color=colour(i))
    axes.set(xlim=(-0.02 * length, 1.02 * length), ylim=(-1, 1))
    axes.axis("off")
