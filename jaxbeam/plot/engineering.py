"""Figures that an engineer signs: assessments, influence lines, envelopes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.assessment.assessment import Assessment
from jaxbeam.analysis.sections import InfluenceTable
from jaxbeam.case.case import Case
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.plot.drawing import draw_schematic
from jaxbeam.plot.style import (
    COLOURS,
    GREY,
    LIMIT,
    annotate,
    axis_label,
    colour,
    curve_style,
    drawing_area,
    format_number,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)
from jaxbeam.simulation.record import Record

HEADROOM = 1.3  # of the axes over the largest value, for the name of the limit
WIDTH, HEIGHT, LEGEND = 9.0, 2.3, 1.3  # inches, of the figure, a row of axes, the legend


@use_style
def plot_assessment(
    found: Assessment, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Deck acceleration, and each kind of effect over that of LM71 with its factors, over speed.

    A curve for each train, the largest of all its sections; limits are dashed. They take the place
    of `ax`, if it is given. The title is that of the bridge if left out.

    Raises ValueError for an assessment without a dynamic analysis, and as `drawing_area` does.
    """
    effects = found.effects
    if effects is None:
        raise ValueError(
            "the assessment has no effects over speed: ask for the dynamic analysis (dynamic=True)"
        )
    kinds = list(dict.fromkeys(effects.quantities))
    rows = -(-len(kinds) // 2)
    figure = drawing_area(ax, (WIDTH, LEGEND + HEIGHT * rows))
    axes = np.ravel(figure.subplots(rows, 2, sharex=True, squeeze=False))
    limits = np.array(effects.limits)
    for one, kind in zip(axes, kinds, strict=False):
        own = np.array(effects.quantities) == kind
        scale = np.ones(own.sum()) if kind == "acceleration" else limits[own]
        limit = limits[own].max() if kind == "acceleration" else 1.0
        for number, curve in enumerate(effects.curves):
            values = (curve.values[:, own] / scale).max(axis=1)
            one.plot(3.6 * curve.speeds, values, label=curve.train, **curve_style(number))
        text = f"limit {limit:g} m/s²" if kind == "acceleration" else "LM71 with factors"
        line = one.axhline(limit, color=LIMIT, linestyle="--", linewidth=1.0, label=text)
        words = "deck acceleration (m/s²)" if kind == "acceleration" else f"{kind} / LM71"
        one.set_ylabel(words)
        one.set_ylim(bottom=0, top=HEADROOM * max(limit, one.get_ylim()[1]))
        one.legend(handles=[line], loc="upper left", fontsize=8)
    for one in axes[len(kinds) :]:
        one.set_visible(False)
    for one in axes[max(0, len(kinds) - 2) : len(kinds)]:
        one.set_xlabel("speed (km/h)")
        one.tick_params(labelbottom=True)
    handles = axes[0].get_lines()[:-1]
    labels = [curve.train for curve in effects.curves]
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), 5), fontsize=8
    )
    set_title(figure, title, found.title)
    return figure


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
