"""A Pareto front: what one figure of merit costs in another."""

from collections.abc import Mapping

from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray

from jaxbeam.plot.style import colour, name, styled


@styled
def plot_front(
    lines: Mapping[str, Float[ndarray, "limit 2"]], merit: str, title: str = ""
) -> Figure:
    """The objective over a merit that was limited, one line for each kind of runs.

    Raises ValueError without lines.
    """
    if not lines:
        raise ValueError("there is nothing to draw: give at least one line")
    figure = Figure(figsize=(6.0, 4.0))
    axes = figure.subplots()
    for i, (label, points) in enumerate(lines.items()):
        axes.plot(*points.T, "o-", color=colour(i), label=f"{label} runs")
    axes.set(xlabel=f"{merit}, relative to no control", ylabel="objective")
    if merit == "effort":
        axes.set_xlabel("effort, relative to the largest command")
    axes.legend()
    name(figure, title)
    return figure
