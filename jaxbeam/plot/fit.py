"""Fit of a model to logs: measured and fitted signals, and residuals."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.plot.style import (
    GREY,
    INK,
    annotate,
    colour,
    drawing_area,
    format_number,
    set_title,
    unit_scale,
    use_style,
)


@dataclasses.dataclass(frozen=True)
class FitPanel:
    """One log in the figure of a fit: measured and fitted samples in the SI `unit`.

    Samples that are not `valid` were left out of the fit; without it all were used.
    """

    title: str
    times: Float[np.ndarray, " time"]
    measured: Float[np.ndarray, "time channel"]
    fitted: Float[np.ndarray, "time channel"]
    names: Sequence[str]
    unit: str = "m"
    valid: Bool[np.ndarray, "time channel"] | None = None


@use_style
def plot_fit(
    panels: Sequence[FitPanel], title: str = "", *, ax: Axes | None = None
) -> Figure | SubFigure:
    """Measured (dots) and fitted signals (lines) and residuals, a column a log.

    Residuals of a log share one scale, and are labelled with their standard deviations. Samples
    that were left out are grey crosses, and count in neither. The figure takes the place of `ax`.
    Raises ValueError without panels.
    """
    if not panels:
        raise ValueError("there is nothing to draw: give at least one log")
    channels = max(panel.measured.shape[1] for panel in panels)
    figure = drawing_area(ax, (max(7.0, 1.2 + 3.6 * len(panels)), 3.6 + 0.8 * channels))
    grid = figure.subplots(
        1 + channels,
        len(panels),
        squeeze=False,
        sharex="col",
        height_ratios=[3.2] + channels * [0.8],
    )
    for column, panel in zip(grid.T, panels, strict=True):
        _draw(column, panel)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    grid[0, 0].legend(once.values(), once, loc="best", handlelength=1.2, markerscale=3)
    set_title(figure, title, "")
    return figure


def _draw(column, panel):
    """Draw the signals of a log in the top axes, and the residual of each channel below."""
    top, *residual_axes = column
    used = np.ones(panel.measured.shape, bool) if panel.valid is None else panel.valid
    residual = np.where(used, panel.measured - panel.fitted, np.nan)
    deviation = np.nanstd(residual, axis=0)
    factor, unit = unit_scale(panel.measured, panel.unit)
    residual_factor, residual_unit = unit_scale(deviation, panel.unit)
    residual_limit = 1.15 * np.nanmax(np.abs(residual)) / residual_factor or 1.0
    for i, strip in enumerate(residual_axes):
        if i >= len(panel.names):
            strip.axis("off")
            continue
        dots = {"markersize": 1.8, "color": colour(i), "markeredgewidth": 0}
        measured = panel.measured[:, i] / factor
        kept, left_out = (np.where(part, measured, np.nan) for part in (used[:, i], ~used[:, i]))
        top.plot(panel.times, kept, "o", label="measured", **dots)
        top.plot(panel.times, panel.fitted[:, i] / factor, color=INK, linewidth=0.9, label="fitted")
        if not used[:, i].all():
            top.plot(panel.times, left_out, "x", color=GREY, markersize=3, label="left out")
        strip.plot(panel.times, residual[:, i] / residual_factor, "o", **dots)
        strip.axhline(0, color=INK, linewidth=0.7)
        strip.set(ylim=(-residual_limit, residual_limit))
        strip.set_ylabel(panel.names[i], color=colour(i))
        annotate(
            strip,
            f"residual sd {format_number(deviation[i] / residual_factor)} {residual_unit}",
            (1.0, 1.0),
            (-2, 0),
            xycoords="axes fraction",
            ha="right",
            va="bottom",
            color=GREY,
            fontsize=8,
        )
    top.set_title(panel.title)
    top.set_ylabel(f"measured and fitted ({unit})")
    top.set_xlim(panel.times[0], panel.times[-1])
    residual_axes[len(panel.names) - 1].set_xlabel("time (s)")
    residual_axes[len(panel.names) - 1].tick_params(labelbottom=True)
