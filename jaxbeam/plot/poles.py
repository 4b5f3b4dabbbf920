"""Poles of the closed loop along a crossing."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.stability import FrozenPoles, Growth
from jaxbeam.plot.style import ALARM, GREY, INK, colour, drawing_area, set_title, use_style

# Branches with decay rates above this, relative to the largest frequency, are left out.
MAX_DECAY_RATIO = 3.0


@use_style
def plot_poles(
    poles_along_crossing: FrozenPoles,
    growth: Growth | None = None,
    title: str = "",
    *,
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Poles with frozen loads in the complex plane, and their largest real part over time.

    Dots mark the start of the crossing, shading instability of the frozen loop. With `growth`, the
    growth of deviations since the start is drawn below. The figure takes the place of `ax`.
    """
    rows = 2 if growth is None else 3
    figure = drawing_area(ax, (8.0, 4.6))
    plane, *right = figure.subplot_mosaic([["plane", str(i)] for i in range(rows - 1)]).values()
    poles = poles_along_crossing.poles
    largest_frequency = np.abs(poles.imag).max() or np.abs(poles.real).max()
    for i, branch in enumerate(poles.T):
        if (
            branch.imag.max() < -1e-9 * largest_frequency
            or branch.real.max() < -MAX_DECAY_RATIO * largest_frequency
        ):
            continue
        plane.plot(branch.real, branch.imag, color=colour(i))
        plane.plot(branch.real[0], branch.imag[0], "o", color=colour(i), markersize=4)
    plane.axvline(0, color=INK, linewidth=0.8)
    plane.axvspan(
        0, max(plane.get_xlim()[1], 0.02 * largest_frequency), color=ALARM, alpha=0.08, linewidth=0
    )
    plane.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", title="frozen poles")
    real_part_axes = right[0]
    real_part_axes.plot(
        poles_along_crossing.times, poles_along_crossing.largest_real_part, color=INK
    )
    real_part_axes.axhline(0, color=ALARM, linewidth=0.8)
    real_part_axes.fill_between(
        poles_along_crossing.times,
        0,
        np.maximum(poles_along_crossing.largest_real_part, 0),
        color=ALARM,
        alpha=0.2,
        linewidth=0,
    )
    real_part_axes.set(
        title="largest real part (1/s)",
        xlim=(poles_along_crossing.times[0], poles_along_crossing.times[-1]),
    )
    if growth is not None:
        growth_axes = right[1]
        real_part_axes.tick_params(labelbottom=False)
        growth_axes.semilogy(growth.times, np.maximum(growth.factor, 1e-4), color=colour(0))
        growth_axes.axhline(1, color=GREY, linewidth=0.8, linestyle=":")
        growth_axes.set(
            title="growth of deviations since the start", xlim=real_part_axes.get_xlim()
        )
    right[-1].set_xlabel("time (s)")
    set_title(figure, title, "")
    return figure
