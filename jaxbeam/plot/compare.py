"""Several controllers on the same case: deflection and commands, beside what is possible."""

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.analysis.compare import Comparison
from jaxbeam.case.fields import concrete
from jaxbeam.plot.record import label_loads, shade_crossings
from jaxbeam.plot.style import (
    GREY,
    INK,
    colour,
    format_number,
    margin_labels,
    set_title,
    unit_scale,
    use_style,
)

UNCONTROLLED_STYLE = {"color": GREY, "linewidth": 1.1, "linestyle": (0, (1, 1))}
BEST_STYLE = {"color": INK, "linewidth": 1.0, "linestyle": (0, (5, 2))}


@use_style
def plot_comparison(comparison: Comparison) -> Figure:
    """Deflection where it is largest without control, and the commands, of all controllers.

    Dashed: commands that attain the bound, and what comes of them. The thin line is the bound,
    which no controller stays within. Labels tell peaks, and shares of the attainable reduction.
    """
    actuators = len(comparison.case.actuators)
    heights = [4.2] + [1.9] * actuators
    figure = Figure(figsize=(9, 0.9 + sum(heights)))
    top, *below = figure.subplots(len(heights), 1, height_ratios=heights, sharex=True)
    _draw_deflection(top, comparison)
    for i, axes in enumerate(below):
        _draw_commands(axes, comparison, i)
    below[-1].set_xlabel("time (s)")
    set_title(figure, comparison.case.title)
    return figure


def _styled_runs(comparison):
    """Record and look of every run: without control, the controllers, the best."""
    controlled = enumerate(comparison.records.items())
    controlled_runs = [(word, record, {"color": colour(i)}) for i, (word, record) in controlled]
    return [
        ("no control", comparison.free, UNCONTROLLED_STYLE),
        *controlled_runs,
        ("best possible", comparison.best, BEST_STYLE),
    ]


def _draw_deflection(axes, comparison):
    sensor = int(np.argmax(np.asarray(comparison.free.peak_deflection)))
    runs = _styled_runs(comparison)
    histories = [np.asarray(record.deflection)[:, sensor] for _, record, _ in runs]
    factor, unit = unit_scale(histories[0], "m")
    shade_crossings(axes, comparison.free)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks, labels, metrics = [], [], comparison.merits
    for (word, record, look), history in zip(runs, histories, strict=True):
        axes.plot(np.asarray(record.times), history / factor, label=word, **look)
        peak = float(record.peak_deflection[sensor]) / factor
        if not np.isfinite(peak):
            peaks.append(0.0)
            labels.append(f"{word} diverges")
            continue
        when = float(record.peak_time[sensor])
        peaks.append(np.sign(np.interp(when, np.asarray(record.times), history)) * peak)
        share = f" ({metrics[word].share:.0%})" if word in metrics else ""
        labels.append(f"{word} {format_number(peaks[-1])} {unit}{share}")
        axes.plot([when], peaks[-1:], "o", color=look["color"], markeredgecolor="white", zorder=3)
    low, high = min(*peaks, 0.0), max(*peaks, 0.0)
    for bound in (-comparison.bound.peak / factor, comparison.bound.peak / factor):
        if low <= bound <= high:
            axes.axhline(bound, color=INK, linewidth=0.7)
    position = float(concrete(comparison.case.sensors[sensor].position))
    axes.set_ylabel(f"deflection at {position:.4g} m ({unit})")
    label_loads(axes, comparison.free)
    margin_labels(axes, peaks, labels, [look["color"] for _, _, look in runs])


def _draw_commands(axes, comparison, actuator):
    case = comparison.case.actuators[actuator]
    unit = type(case).__dataclass_fields__["limits"].metadata["unit"]
    shade_crossings(axes, comparison.free)
    axes.axhline(0, color=GREY, linewidth=0.8)
    for _, record, look in _styled_runs(comparison)[1:]:
        sampled = record.case.controller.period is not None
        style = "steps-post" if sampled else "default"
        command = np.asarray(record.command)[:, actuator]
        axes.plot(np.asarray(record.times), command, drawstyle=style, **(look | {"linewidth": 1.1}))
    number = f" {actuator}" if len(comparison.case.actuators) > 1 else ""
    axes.set_ylabel(f"command{number} ({unit})")
    limits = case.command_limits()
    if limits is not None:
        limit_values = np.asarray(concrete(limits)).tolist()
        for limit in limit_values:
            axes.axhline(limit, color=GREY, linewidth=0.9, linestyle=":")
        margin_labels(
            axes,
            limit_values,
            [f"limit {format_number(limit)}" for limit in limit_values],
            [GREY, GREY],
        )
