"""Several controllers on the same case: deflection and commands, beside what is possible."""

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.analysis.compare import Comparison
from jaxbeam.case.fields import known
from jaxbeam.plot.record import name_loads, shade
from jaxbeam.plot.style import GREY, INK, colour, digits, margin_labels, name, scale, styled

FREE = {"color": GREY, "linewidth": 1.1, "linestyle": (0, (1, 1))}
BEST = {"color": INK, "linewidth": 1.0, "linestyle": (0, (5, 2))}


@styled
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
    name(figure, comparison.case.title)
    return figure


def _runs(comparison):
    """Record and look of every run: without control, the controllers, the best."""
    controlled = enumerate(comparison.records.items())
    looks = [(word, record, {"color": colour(i)}) for i, (word, record) in controlled]
    return [
        ("no control", comparison.free, FREE),
        *looks,
        ("best possible", comparison.best, BEST),
    ]


def _draw_deflection(axes, comparison):
    sensor = int(np.argmax(np.asarray(comparison.free.peak_deflection)))
    runs = _runs(comparison)
    histories = [np.asarray(record.deflection)[:, sensor] for _, record, _ in runs]
    factor, unit = scale(histories[0], "m")
    shade(axes, comparison.free)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks, words, merits = [], [], comparison.merits
    for (word, record, look), history in zip(runs, histories, strict=True):
        axes.plot(np.asarray(record.times), history / factor, label=word, **look)
        peak = float(record.peak_deflection[sensor]) / factor
        if not np.isfinite(peak):
            peaks.append(0.0)
            words.append(f"{word} diverges")
            continue
        when = float(record.peak_time[sensor])
        peaks.append(np.sign(np.interp(when, np.asarray(record.times), history)) * peak)
        share = f" ({merits[word].share:.0%})" if word in merits else ""
        words.append(f"{word} {digits(peaks[-1])} {unit}{share}")
        axes.plot([when], peaks[-1:], "o", color=look["color"], markeredgecolor="white", zorder=3)
    low, high = min(*peaks, 0.0), max(*peaks, 0.0)
    for least in (-comparison.bound.peak / factor, comparison.bound.peak / factor):
        if low <= least <= high:
            axes.axhline(least, color=INK, linewidth=0.7)
    place = float(known(comparison.case.sensors[sensor].position))
    axes.set_ylabel(f"deflection at {place:.4g} m ({unit})")
    name_loads(axes, comparison.free)
    margin_labels(axes, peaks, words, [look["color"] for _, _, look in runs])


def _draw_commands(axes, comparison, actuator):
    case = comparison.case.actuators[actuator]
    unit = type(case).__dataclass_fields__["limits"].metadata["unit"]
    shade(axes, comparison.free)
    axes.axhline(0, color=GREY, linewidth=0.8)
    for _, record, look in _runs(comparison)[1:]:
        held = record.case.controller.period is not None
        style = "steps-post" if held else "default"
        command = np.asarray(record.command)[:, actuator]
        axes.plot(np.asarray(record.times), command, drawstyle=style, **(look | {"linewidth": 1.1}))
    number = f" {actuator}" if len(comparison.case.actuators) > 1 else ""
    axes.set_ylabel(f"command{number} ({unit})")
    limits = case.command_limits()
    if limits is not None:
        ends = np.asarray(known(limits)).tolist()
        for limit in ends:
            axes.axhline(limit, color=GREY, linewidth=0.9, linestyle=":")
        margin_labels(axes, ends, [f"limit {digits(limit)}" for limit in ends], [GREY, GREY])
