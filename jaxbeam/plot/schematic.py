"""The rig as a sketch: beam, ends, supports, actuators and sensors where they are."""

import numpy as np
from matplotlib.path import Path

from jaxbeam.case.case import Case
from jaxbeam.case.fields import known
from jaxbeam.plot.style import COLOURS, GREY, INK, colour, spread

# Markers hang below the point of the beam that they hold, whatever the scale of the axes.
_HATCH = [p for y in (-0.9, -0.5, -0.1, 0.3, 0.7) for p in ((0.0, y + 0.2), (-0.4, y))]
_WALL = [(0.0, -1.0), (0.0, 1.0), *_HATCH]


def _strokes(points) -> Path:
    """Separate strokes, each between two consecutive points."""
    return Path(points, [Path.MOVETO, Path.LINETO] * (len(points) // 2))


TRIANGLE = Path([(0, 0), (-0.6, -1), (0.6, -1), (0, 0)], closed=True)
SPRING = Path(
    [(0, 0), (0, -0.2), (0.3, -0.3), (-0.3, -0.45), (0.3, -0.6), (-0.3, -0.75), (0, -0.85),
     (0, -1), (-0.5, -1), (0.5, -1)]
)  # fmt: skip
DEVICE = Path([(0, 0), (0, -0.4), (-0.5, -0.4), (-0.5, -1), (0.5, -1), (0.5, -0.4), (0, -0.4)])
BALL = Path.circle((0, 1), 1)
WALLS = {
    "clamped": _strokes(_WALL),
    "guided": _strokes([*((x - 0.5, y) for x, y in _WALL), (0.0, -1.0), (0.0, 1.0)]),
}


def _hang(axes, x, y, glyph, size, **look):
    look = {"markerfacecolor": "white", "markeredgecolor": INK, "markeredgewidth": 1.0} | look
    axes.plot([x], [y], marker=glyph, markersize=size, clip_on=False, zorder=3, **look)


def draw_supports(axes, case: Case, y: int | float = 0, size: int | float = 22) -> None:
    """Draw ends and supports of a case at height y; `size` is in points."""
    length = float(known(case.beam.length))
    for x, end, side in ((0.0, case.beam.left_end, 1), (length, case.beam.right_end, -1)):
        if end == "pinned":
            _hang(axes, x, y, TRIANGLE, size)
        elif end in WALLS:
            wall = WALLS[end]
            _hang(axes, x, y, Path(wall.vertices * (side, 1), wall.codes), size)
    for support in case.supports:
        glyph = TRIANGLE if support.stiffness is None else SPRING
        fill = "white" if support.stiffness is None else "none"
        _hang(axes, float(known(support.position)), y, glyph, size, markerfacecolor=fill)


def draw_rig(axes, case: Case) -> None:
    """Draw the whole rig at height zero: sensors in their colours, named by their positions."""
    length = float(known(case.beam.length))
    axes.plot([0, length], [0, 0], color=INK, linewidth=3, zorder=2)
    draw_supports(axes, case)
    for actuator in case.actuators:
        places = [float(known(x)) for x, _, _ in actuator.stroke()]
        if len(places) == 1:
            _hang(axes, places[0], 0, DEVICE, 22, markeredgecolor=GREY)
        else:
            axes.plot(places, [0, 0], color=COLOURS[4], linewidth=6, zorder=2.5)
    where = np.array([float(known(sensor.position)) for sensor in case.sensors])
    for i, (x, place) in enumerate(zip(where, spread(where, 0.08 * length), strict=True)):
        axes.plot([x], [0], "o", color=colour(i), markersize=8, markeredgecolor="white", zorder=4)
        axes.annotate(
            f"{x:.4g} m",
            (place, 0),
            xytext=(0, 9),
            textcoords="offset points",
            ha="center",
            color=colour(i),
        )
    axes.set(xlim=(-0.02 * length, 1.02 * length), ylim=(-1, 1))
    axes.axis("off")
