"""Figures of one run and of controllers on one case: measurements, contact forces, commands."""

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.analysis.compare import Comparison
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.plot.crossings import (
    draw_accelerations,
    draw_forces,
    draw_strokes,
    forces_vary,
    has_bodies,
    label_loads,
    shade_crossings,
)
from jaxbeam.plot.drawing import draw_schematic, shows_traffic
from jaxbeam.plot.style import (
    GREY,
    INK,
    UnitScale,
    colour,
    command_drawstyle,
    draw_limits,
    drawing_area,
    format_number,
    label_height,
    load_colour,
    margin_labels,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)
from jaxbeam.simulation.record import Record


@use_style
def plot_record(
    record: Record,
    quantity: str | None = None,
    *,
    ax: Axes | None = None,
    title: str | None = None,
    labels: Sequence[str] | None = None,
) -> Figure | SubFigure:
    """Schematic, quantities of the sensors, contact forces, bodies of vehicles, and commands.

    Each quantity has axes of its own. Dots mark peaks, shading the times with loads on the beam;
    vehicles have a row for the accelerations of their bodies (see `plot_crossings`),
    absorbers one for their strokes, controllers one for the commands. There is no row for contact
    forces where all are constant.
    With a `quantity` of the sensors only its histories are drawn.

    The whole takes the place of `ax`, histories are drawn on it. The title is that of the case if
    left out; `labels` name the sensors, in their order, in place of their names. Returns the
    figure. Raises ValueError if the case has neither sensors nor loads, for a quantity that no
    sensor measures, and for another number of labels than sensors.
    """
    case = record.case
    names = _names(case, labels)
    if quantity is not None:
        return _plot_quantity(record, quantity, names, ax, title)
    crossed = shows_traffic(case)
    quantities = list(dict.fromkeys(sensor.quantity for sensor in case.sensors))
    draw_quantity = functools.partial(_draw_quantity, names=names)
    shows_forces = forces_vary(record) or not quantities
    panels = [
        (height, draw)
        for height, draw, shown in (
            (1.2 if crossed else 0.7, lambda axes, record: draw_schematic(axes, record.case), True),
            *(
                (3.2 if i == 0 else 2.2, functools.partial(draw_quantity, quantity=name), True)
                for i, name in enumerate(quantities)
            ),
            (1.7, _with_crossings(draw_forces), case.loads and shows_forces),
            (1.5, _with_crossings(draw_accelerations), has_bodies(record)),
            (1.5, _with_crossings(draw_strokes), case.absorbers),
            (1.7, _draw_commands, case.controller is not None),
        )
        if shown
    ]
    if len(panels) == 1:
        raise ValueError("the record has nothing to draw: its case has neither sensors nor loads")
    heights = [height for height, _ in panels]
    figure = drawing_area(ax, (8, 0.7 + sum(heights)))
    rows = figure.subplots(len(panels), 1, height_ratios=heights)
    for axes, (_, draw) in zip(rows, panels, strict=True):
        draw(axes, record)
    rows[-1].set_xlabel("time (s)")
    for axes in rows[1:-1]:
        axes.tick_params(labelbottom=False)
    set_title(figure, title, case.title)
    return figure


def _names(case: Case, labels: Sequence[str] | None) -> list[str]:
    """Names of the sensors; empty for those without."""
    if labels is None:
        return [sensor.name for sensor in case.sensors]
    if len(labels) != len(case.sensors):
        raise ValueError(f"labels names {len(labels)} sensors; the case has {len(case.sensors)}")
    return list(labels)


def _plot_quantity(record, quantity, names, ax, title) -> Figure | SubFigure:
    measured = list(dict.fromkeys(sensor.quantity for sensor in record.case.sensors))
    if quantity not in measured:
        raise ValueError(
            f"no sensor measures {quantity!r}; they measure {', '.join(measured) or 'nothing'}"
        )
    figure, axes = single_axes(ax, (8, 3.6))
    _draw_quantity(axes, record, quantity, names, with_loads=True)
    axes.set_xlabel("time (s)")
    set_title(figure, title, record.case.title, ax)
    return figure


def _with_crossings(draw):
    """Function that shades the times with loads on the beam before it draws."""

    def shade_and_draw(axes, record):
        shade_crossings(axes, record)
        draw(axes, record)

    return shade_and_draw


def signed_peak(record: Record, sensor: int) -> float:
    """Peak deflection (m) at a sensor with its sign, which the record's own lacks."""
    times, history = np.asarray(record.times), np.asarray(record.deflection)[:, sensor]
    sign = np.sign(np.interp(float(record.peak_time[sensor]), times, history))
    return float(sign * record.peak_deflection[sensor])


def _draw_quantity(axes, record, quantity: str, names: list[str], with_loads: bool = False):
    """Draw the histories of the sensors of a quantity, with a dot at the larger extreme of each."""
    times, values = np.asarray(record.times), np.asarray(record.sensor_values)
    sensors = record.case.sensors
    own = [i for i, sensor in enumerate(sensors) if sensor.quantity == quantity]
    factor, unit = unit_scale(values[:, own], QUANTITIES[quantity].unit)
    extremes = [np.asarray(part) for part in record.extremes]
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks, texts = [], []
    for i in own:
        axes.plot(times, values[:, i] / factor, color=colour(i))
        low, low_time, high, high_time = (float(part[i]) for part in extremes)
        peak, when = (low, low_time) if -low > high else (high, high_time)
        peaks.append(peak / factor)
        axes.plot([when], peaks[-1:], "o", color=colour(i), markeredgecolor="white", zorder=3)
        texts.append(f"{names[i] or 'peak'} {format_number(peaks[-1])} {unit}")
    label_height(axes, quantity, unit)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.07 * (high - low))  # room for the names
    if 0 in own or with_loads:  # the first of the quantities
        label_loads(axes, record)
    margin_labels(axes, peaks, texts, [colour(i) for i in own])


def _draw_commands(axes, record):
    times, command = np.asarray(record.times), np.asarray(record.command)
    actuators = record.case.actuators
    units = {actuator.command_unit for actuator in actuators}
    style = command_drawstyle(record.case.controller)
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    reached, tints = [], []
    scale = unit_scale(command, units.pop()) if len(units) == 1 else UnitScale(1.0, "")
    words = scale.unit or ", ".join(sorted(units))
    for i, actuator in enumerate(actuators):
        axes.plot(
            times,
            command[:, i] / scale.factor,
            color=load_colour(i),
            linewidth=1.1,
            drawstyle=style,
        )
        limits = actuator.command_limits()
        if limits is None or not np.any(np.asarray(record.saturated)[:, i]):
            continue
        for limit in np.asarray(concrete(limits)):
            if np.any(np.isclose(command[:, i], limit)):
                reached.append(limit / scale.factor)
                tints.append(load_colour(i))
    label_height(axes, "command", words)
    draw_limits(axes, reached, tints, scale.unit)


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
