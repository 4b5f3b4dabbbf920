"""Figure of vehicles that stand on the ground: bodies, springs and static wheel loads."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.case.beam import Beam
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import AbstractLoad, wheel_distances
from jaxbeam.model.load_set import load_set
from jaxbeam.plot.schematic import LOAD_MARKER
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    INK,
    annotate,
    drawing_area,
    set_title,
    unit_scale,
    use_style,
)
from jaxbeam.plot.traffic.drawing import vehicle_art

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
