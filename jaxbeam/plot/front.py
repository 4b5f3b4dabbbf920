"""Pareto front of a tuning: the objective over the limit of a metric."""

from collections.abc import Mapping

from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy import ndarray

from jaxbeam.plot.style import colour, set_title, single_axes, use_style


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
