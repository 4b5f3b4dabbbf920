"""Figure of an envelope: smallest and largest values of a quantity along the beam."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.plot.schematic import draw_schematic
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    annotate,
    axis_label,
    format_number,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)
from jaxbeam.simulation.record import Record


@use_style
def plot_envelope(
    record: Record,
    quantity: str = "moment",
    positions=None,
    *,
    ax: Axes | None = None,
    title: str | None = None,
    **parameters,
) -> Figure | SubFigure:
    """Schematic of the case, and the envelope of a quantity over the length of the beam.

    Dots mark the smallest and the largest value, with the time of each. `positions` (m) and
    `parameters` (`fibre_distance`, `section_modulus`) are those of `Record.envelope`, which says
    what is raised. On `ax` the envelope is drawn without the schematic. The title is that of the
    case if left out.
    """
    found = record.envelope(quantity, positions, **parameters)
    x, smallest, largest = (
        np.asarray(part) for part in (found.positions, found.smallest, found.largest)
    )
    factor, unit = unit_scale([smallest, largest], QUANTITIES[quantity].unit)
    if ax is None:
        figure = Figure(figsize=(8, 4.2))
        top, axes = figure.subplots(2, 1, height_ratios=[0.7, 3.2])
        draw_schematic(top, record.case)
        limits = top.get_xlim()
    else:
        figure, axes = single_axes(ax, (8, 3.5))
        limits = x[0], x[-1]
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.fill_between(x, smallest / factor, largest / factor, color=COLOURS[5], alpha=0.35)
    times = (np.asarray(found.smallest_time), np.asarray(found.largest_time))
    marks = ((smallest, np.argmin, -12), (largest, np.argmax, 4))
    for (values, extreme, offset), tint, time in zip(marks, COLOURS, times, strict=False):
        axes.plot(x, values / factor, color=tint)
        i = int(extreme(values))
        axes.plot(x[[i]], values[[i]] / factor, "o", color=tint, markeredgecolor="white", zorder=3)
        text = f"{format_number(values[i] / factor)} {unit} at {x[i]:.4g} m, {time[i]:.4g} s"
        side = "right" if x[i] > (x[0] + x[-1]) / 2 else "left"
        shift = (4 if side == "left" else -4, offset)
        annotate(axes, text, (x[i], values[i] / factor), shift, color=tint, fontsize=8, ha=side)
    axes.margins(y=0.12)
    axes.set(xlim=limits, xlabel="position (m)", ylabel=axis_label(quantity, unit))
    set_title(figure, title, record.case.title, ax)
    return figure
