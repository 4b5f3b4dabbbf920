"""Figure of influence lines over the position of the load."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.sections.influence_table import InfluenceTable
from jaxbeam.case.case import Case
from jaxbeam.plot.schematic import draw_schematic
from jaxbeam.plot.style import (
    GREY,
    axis_label,
    colour,
    drawing_area,
    set_title,
    unit_scale,
    use_style,
)


@use_style
def plot_influence(
    case: Case, lines: InfluenceTable, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Schematic of the case, and its influence lines with axes for each quantity.

    They take the place of `ax`, if it is given. The title is that of the case if left out. Raises
    ValueError as `drawing_area` does.
    """
    quantities = list(dict.fromkeys(lines.quantities))
    figure = drawing_area(ax, (8, 1.0 + 2.4 * len(quantities)))
    ratios = [0.7, *(2.4 for _ in quantities)]
    top, *axes = np.atleast_1d(figure.subplots(len(ratios), 1, height_ratios=ratios))
    draw_schematic(top, case)
    for one, quantity in zip(axes, quantities, strict=True):
        index = [i for i, name in enumerate(lines.quantities) if name == quantity]
        values = lines.values[:, index]
        factor, unit = unit_scale([values], lines.units[index[0]])
        one.axhline(0, color=GREY, linewidth=0.8)
        for column, i in enumerate(index):
            tint = colour(column)
            one.plot(lines.positions, values[:, column] / factor, color=tint, label=lines.places[i])
        one.set(xlim=top.get_xlim(), ylabel=axis_label(quantity, unit))
        one.legend(loc="best", fontsize=8)
    axes[-1].set_xlabel("position of a load of 1 N (m)")
    set_title(figure, title, case.title)
    return figure
