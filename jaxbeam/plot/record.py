"""Figure of one run: measurements, contact forces, commands."""

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

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
from jaxbeam.runtime.printer import counted
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
        raise ValueError(
            f"labels names {counted(len(labels), 'sensor')}; the case has {len(case.sensors)}"
        )
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
