"""Mode shapes of a beam."""

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.along_beam import positions_along
from jaxbeam.model.modes import Modes, modes as find_modes
from jaxbeam.plot.schematic import draw_supports
from jaxbeam.plot.style import (
    FAINT,
    GREY,
    INK,
    annotate,
    colour,
    format_number,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)

FEW_MODES = 10


@use_style
def plot_modes(
    case: Case,
    modes: Modes | None = None,
    *,
    ax: Axes | None = None,
    title: str | None = None,
) -> Figure | SubFigure:
    """Mode shapes of a case, one above the other, with frequencies (Hz) and damping ratios.

    Shapes are scaled to the same height. `modes` are computed from the case, and the title is
    its own, if left out. They are drawn on `ax` if it is given.
    """
    modes = find_modes(case) if modes is None else modes
    length = float(concrete(case.beam.length))
    x = np.asarray(positions_along(case, 401))
    shapes = np.asarray(modes.shapes(jnp.asarray(x)))
    shapes = 0.36 * shapes / np.max(np.abs(shapes), axis=0)
    count = shapes.shape[1]
    height = 0.8 if count <= FEW_MODES else 0.45  # inches, of a mode
    figure, axes = single_axes(ax, (7, 1.1 + height * count))
    for i, (frequency, ratio) in enumerate(
        zip(modes.frequencies, modes.damping_ratios, strict=True)
    ):
        shape = shapes[:, i] - i
        axes.plot([0, length], [-i, -i], color=GREY, linewidth=0.8, zorder=1)
        axes.fill_between(x, -i, shape, color=colour(0), alpha=0.12, linewidth=0)
        axes.plot(x, shape, color=colour(0), linewidth=1.8)
        draw_supports(axes, case, y=-i, size=17)
        annotate(
            axes,
            f"{_frequency_text(float(frequency))}\ndamping {100 * float(ratio):.3g} %",
            (1.0, -i),
            (12, 0),
            xycoords=axes.get_yaxis_transform(),
            va="center",
            color=INK,
        )
    axes.set(xlabel="position (m)", ylabel="mode", xlim=(0, length), ylim=(0.6 - count, 0.55))
    axes.set_yticks(-np.arange(count), [str(i + 1) for i in range(count)])
    axes.tick_params(axis="y", length=0, pad=10)
    axes.spines["left"].set_visible(False)
    axes.grid(False, axis="y")
    axes.grid(True, axis="x", color=FAINT)
    set_title(figure, title, case.title, ax)
    return figure


def _frequency_text(frequency: float) -> str:
    factor, unit = unit_scale(frequency, "Hz")
    return f"{format_number(frequency / factor, 4)} {unit}"
