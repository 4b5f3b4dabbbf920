"""Figure of controllers on one case: deflections, commands, and the least achievable peak."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.compare import Comparison
from jaxbeam.case.fields import concrete
from jaxbeam.plot.crossings import label_loads, shade_crossings
from jaxbeam.plot.record import signed_peak
from jaxbeam.plot.style import (
    GREY,
    INK,
    colour,
    command_drawstyle,
    draw_limits,
    drawing_area,
    format_number,
    label_height,
    margin_labels,
    set_title,
    unit_scale,
    use_style,
)

UNCONTROLLED_STYLE = {"color": GREY, "linewidth": 1.1, "linestyle": (0, (1, 1))}
OPTIMAL_STYLE = {"color": INK, "linewidth": 1.0, "linestyle": (0, (5, 2))}


@use_style
def plot_comparison(
    comparison: Comparison, *, ax: Axes | None = None, title: str | None = None
) -> Figure | SubFigure:
    """Figure of controllers: commands, and deflection at the sensor of the largest peak.

    Dashed: the optimal commands of the bound and their response; thin line: the least achievable
    peak. Labels give peaks and, in brackets, shares of the attainable reduction. The figure takes
    the place of `ax`; its title is that of the case if left out.
    """
    actuators = len(comparison.case.actuators)
    heights = [4.2] + [1.9] * actuators
    figure = drawing_area(ax, (9, 0.9 + sum(heights)))
    top, *below = figure.subplots(len(heights), 1, height_ratios=heights, sharex=True)
    _draw_deflection(top, comparison)
    for i, axes in enumerate(below):
        _draw_compared_commands(axes, comparison, i)
    below[-1].set_xlabel("time (s)")
    set_title(figure, title, comparison.case.title)
    return figure


def _styled_runs(comparison: Comparison):
    """Name, record and line style of every run: uncontrolled, controllers, optimal commands."""
    records = enumerate(comparison.records.items())
    controlled_runs = [(name, record, {"color": colour(i)}) for i, (name, record) in records]
    return [
        ("no control", comparison.uncontrolled, UNCONTROLLED_STYLE),
        *controlled_runs,
        *([("optimal commands", comparison.optimal, OPTIMAL_STYLE)] if comparison.bound else []),
    ]


def _draw_deflection(axes, comparison: Comparison):
    sensor = int(np.argmax(np.asarray(comparison.uncontrolled.peak_deflection)))
    runs = _styled_runs(comparison)
    histories = [np.asarray(record.deflection)[:, sensor] for _, record, _ in runs]
    factor, unit = unit_scale(histories[0], "m")
    shade_crossings(axes, comparison.uncontrolled)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks, labels, metrics = [], [], comparison.metrics
    for (name, record, look), history in zip(runs, histories, strict=True):
        axes.plot(np.asarray(record.times), history / factor, label=name, **look)
        if not np.isfinite(float(record.peak_deflection[sensor])):
            peaks.append(0.0)
            labels.append(f"{name} diverges")
            continue
        peaks.append(signed_peak(record, sensor) / factor)
        share = f" ({metrics[name].share:.0%})" if name in metrics and comparison.bound else ""
        labels.append(f"{name} {format_number(peaks[-1])} {unit}{share}")
        when = float(record.peak_time[sensor])
        axes.plot([when], peaks[-1:], "o", color=look["color"], markeredgecolor="white", zorder=3)
    low, high = min(*peaks, 0.0), max(*peaks, 0.0)
    least = comparison.bound.peak / factor if comparison.bound else np.nan
    for bound in (-least, least):
        if low <= bound <= high:
            axes.axhline(bound, color=INK, linewidth=0.7)
    position = float(concrete(comparison.case.sensors[sensor].position))
    label_height(axes, f"deflection at {position:.4g} m", unit)
    label_loads(axes, comparison.uncontrolled)
    margin_labels(axes, peaks, labels, [look["color"] for _, _, look in runs])


def _draw_compared_commands(axes, comparison: Comparison, index: int):
    actuator = comparison.case.actuators[index]
    shade_crossings(axes, comparison.uncontrolled)
    axes.axhline(0, color=GREY, linewidth=0.8)
    runs = _styled_runs(comparison)[1:]
    commands = [np.asarray(record.command)[:, index] for _, record, _ in runs]
    factor, unit = unit_scale(np.concatenate(commands), actuator.command_unit)
    for command, (_, record, look) in zip(commands, runs, strict=True):
        style, command = command_drawstyle(record.case.controller), command / factor
        axes.plot(np.asarray(record.times), command, drawstyle=style, **(look | {"linewidth": 1.1}))
    number = f" {index}" if len(comparison.case.actuators) > 1 else ""
    label_height(axes, f"command{number}", unit)
    limits = actuator.command_limits()
    if limits is not None:
        draw_limits(axes, (concrete(limits) / factor).tolist(), [GREY, GREY], unit)
