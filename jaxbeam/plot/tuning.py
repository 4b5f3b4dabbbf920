"""Figures of tunings: objective over the steps, and Pareto fronts."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy import ndarray

from jaxbeam.plot.style import (
    GREY,
    INK,
    SHADE,
    colour,
    drawing_area,
    set_title,
    single_axes,
    use_style,
)


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
        _draw(axes, panel)
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


def _draw(axes, panel):
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
