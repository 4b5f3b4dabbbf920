"""Figures of fits and tunings: measured and fitted signals, objective over steps, Pareto fronts."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy import ndarray

from jaxbeam.plot.style import (
    GREY,
    INK,
    SHADE,
    annotate,
    colour,
    drawing_area,
    format_number,
    set_title,
    single_axes,
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
        _draw_signals(column, panel)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    grid[0, 0].legend(once.values(), once, loc="best", handlelength=1.2, markerscale=3)
    set_title(figure, title, "")
    return figure


def _draw_signals(column, panel):
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


@dataclasses.dataclass(frozen=True)
class TuningPanel:
    """Set of runs in the figure of a tuning, with labels and peaks (m); `least_peak` may be NaN."""

    title: str
    labels: Sequence[str]
    uncontrolled: Float[np.ndarray, " run"]
    before: Float[np.ndarray, " run"]
    after: Float[np.ndarray, " run"]
    least_peak: Float[np.ndarray, " run"]


@use_style
def plot_tuning(
    panels: Sequence[TuningPanel],
    history: Float[np.ndarray, "step start"],
    title: str = "",
    *,
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Peaks of every run relative to no control, and the objective over the steps of the search.

    Shading: below the least achievable peak, the bound on any controller. The figure takes the
    place of `ax`. Raises ValueError without panels.
    """
    if not panels:
        raise ValueError("there is nothing to draw: give at least one panel")
    max_runs = max(len(panel.labels) for panel in panels)
    figure = drawing_area(ax, (max(7.0, 4.2 * len(panels)), 3.4 + 0.26 * max_runs))
    grid = figure.add_gridspec(2, len(panels), height_ratios=[1.2 + 0.22 * max_runs, 1.2])
    above = [figure.add_subplot(grid[0, i]) for i in range(len(panels))]
    for axes, panel in zip(above, panels, strict=True):
        _draw_peaks(axes, panel)
    handles, labels = above[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", ncols=3, handlelength=1.2)
    left, right = min(a.get_xlim()[0] for a in above), max(a.get_xlim()[1] for a in above)
    for axes in above:
        axes.set_xlim(left, right)
    below = figure.add_subplot(grid[1, :])
    below.plot(history, color=GREY, linewidth=0.7)
    below.plot(np.fmin.accumulate(np.nanmin(history, axis=1)), color=INK, linewidth=1.4)
    below.set(xlabel="step", ylabel="objective", title="search: every start, and the best so far")
    set_title(figure, title, "")
    return figure


def _draw_peaks(axes, panel):
    """Draw a line a run, from its peak before to that after, over the least achievable peak."""
    rows = np.arange(len(panel.labels))
    percent_factor = 100 / panel.uncontrolled
    axes.hlines(
        rows, panel.before * percent_factor, panel.after * percent_factor, color=GREY, linewidth=1.0
    )
    axes.plot(
        panel.before * percent_factor, rows, "o", color=colour(1), label="before", markersize=5
    )
    axes.plot(panel.after * percent_factor, rows, "o", color=colour(0), label="after", markersize=5)
    if np.isfinite(panel.least_peak).all():
        axes.plot(
            panel.least_peak * percent_factor,
            rows,
            "|",
            color=INK,
            label="least achievable",
            markersize=10,
        )
        axes.barh(rows, panel.least_peak * percent_factor, height=0.9, color=SHADE, zorder=0)
    lowest = np.nanmin([panel.least_peak, panel.after, panel.before], axis=0) * percent_factor
    axes.set_xlim(
        max(0.0, 0.9 * np.nanmin(lowest)), 1.02 * max(100.0, (panel.before * percent_factor).max())
    )
    axes.axvline(100, color=GREY, linewidth=0.8, linestyle=":")
    axes.set_yticks(rows, panel.labels)
    axes.invert_yaxis()
    axes.set(xlabel="peak, % of that without control", title=panel.title)


@use_style
def plot_pareto_front(
    fronts: Mapping[str, Float[ndarray, "limit 2"]],
    metric: str,
    title: str = "",
    *,
    ax: Axes | None = None,
) -> Figure | SubFigure:
    """Objective over the limited metric, a line for training and for held-out runs.

    It is drawn on `ax` if it is given. Raises ValueError without lines.
    """
    if not fronts:
        raise ValueError("there is nothing to draw: give at least one line")
    figure, axes = single_axes(ax, (6.0, 4.0))
    for i, (label, points) in enumerate(fronts.items()):
        axes.plot(*points.T, "o-", color=colour(i), label=f"{label} runs")
    axes.set(xlabel=f"{metric}, relative to no control", ylabel="objective")
    if metric == "effort":
        axes.set_xlabel("effort, relative to the largest command")
    axes.legend()
    set_title(figure, title, "", ax)
    return figure
