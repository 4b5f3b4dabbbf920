"""Figure of one run: what the sensors measure, contact forces and commands over time."""

import dataclasses
import functools

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.case.case import crossing_times
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.plot.schematic import draw_schematic, shows_traffic
from jaxbeam.plot.style import (
    GREY,
    SHADE,
    annotate,
    axis_label,
    colour,
    command_drawstyle,
    draw_limits,
    format_number,
    load_colour,
    margin_labels,
    set_title,
    unit_scale,
    use_style,
)
from jaxbeam.plot.traffic.rows import draw_accelerations, draw_forces, has_bodies
from jaxbeam.simulation.record import Record


@use_style
def plot_record(record: Record) -> Figure:
    """Schematic, quantities of the sensors, contact forces, bodies of vehicles, and commands.

    Each quantity has axes of its own. Dots mark peaks, shading the times with loads on the beam;
    vehicles have a row for the accelerations of their bodies (see `jaxbeam.plot.traffic.rows`),
    controllers one for the commands. Raises ValueError if the case has neither sensors nor loads.
    """
    case = record.case
    crossed = shows_traffic(case)
    quantities = list(dict.fromkeys(sensor.quantity for sensor in case.sensors))
    panels = [
        (height, draw)
        for height, draw, shown in (
            (1.2 if crossed else 0.7, lambda axes, record: draw_schematic(axes, record.case), True),
            *(
                (3.2 if i == 0 else 2.2, functools.partial(_draw_quantity, quantity=name), True)
                for i, name in enumerate(quantities)
            ),
            (1.7, _with_crossings(draw_forces), case.loads),
            (1.5, _with_crossings(draw_accelerations), has_bodies(record)),
            (1.7, _draw_commands, case.controller is not None),
        )
        if shown
    ]
    if len(panels) == 1:
        raise ValueError("the record has nothing to draw: its case has neither sensors nor loads")
    heights = [height for height, _ in panels]
    figure = Figure(figsize=(8, 0.7 + sum(heights)))
    rows = figure.subplots(len(panels), 1, height_ratios=heights)
    for axes, (_, draw) in zip(rows, panels, strict=True):
        draw(axes, record)
    rows[-1].set_xlabel("time (s)")
    for axes in rows[1:-1]:
        axes.tick_params(labelbottom=False)
    set_title(figure, case.title)
    return figure


def _with_crossings(draw):
    """Function that shades the times with loads on the beam before it draws."""

    def shade_and_draw(axes, record):
        shade_crossings(axes, record)
        draw(axes, record)

    return shade_and_draw


def load_windows(record: Record) -> list[tuple[int, float, float]]:
    """Number, entry and exit (s) of each load on the beam during the record, clipped to it."""
    times = np.asarray(record.times)
    cut = np.clip(crossing_times(record.case), times[0], times[-1]).tolist()
    return [(i, entry, leaves) for i, (entry, leaves) in enumerate(cut) if entry < leaves]


def signed_peak(record: Record, sensor: int) -> float:
    """Peak deflection (m) at a sensor with its sign, which the record's own lacks."""
    times, history = np.asarray(record.times), np.asarray(record.deflection)[:, sensor]
    sign = np.sign(np.interp(float(record.peak_time[sensor]), times, history))
    return float(sign * record.peak_deflection[sensor])


def shade_crossings(axes, record: Record) -> None:
    """Set the limits of a time axis to those of a record; shade times with loads on the beam."""
    times = np.asarray(record.times)
    axes.set_xlim(times[0], times[-1])
    for _, entry, exit_time in load_windows(record):
        axes.axvspan(entry, exit_time, color=SHADE, zorder=0.5, linewidth=0)
        for instant in (entry, exit_time):
            axes.axvline(instant, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), zorder=0.6)


def label_loads(axes, record: Record) -> None:
    """Label each load at its entry: its mass or force and speed, or its number among several."""
    loads = record.case.loads
    for i, entry, _ in load_windows(record):
        label = f"load {i}" if len(loads) > 1 else _load_label(loads[i])
        annotate(
            axes,
            label,
            (entry, 1.0),
            (4, -4),
            xycoords=axes.get_xaxis_transform(),
            va="top",
            color=load_colour(i),
            fontsize=8,
        )


def _load_label(load) -> str:
    """Mass or force, or name, and speed of a load, with units: "0.5 kg, 1.2 m/s"."""
    numbers = [(field, getattr(load, field.name)) for field in dataclasses.fields(load)]
    parts = [
        f"{float(concrete(value)):.4g} {field.metadata['unit']}"
        for field, value in numbers
        if field.name in ("mass", "force", "speed") and value is not None
    ]
    if load.kind not in ("mass", "force"):
        parts.insert(0, getattr(load, "train", "") or getattr(load, "model", "") or load.kind)
    return ", ".join(parts)


def _draw_quantity(axes, record, quantity: str):
    """Draw the histories of the sensors of a quantity, with a dot at the larger extreme of each."""
    times, values = np.asarray(record.times), np.asarray(record.sensor_values)
    sensors = record.case.sensors
    own = [i for i, sensor in enumerate(sensors) if sensor.quantity == quantity]
    factor, unit = unit_scale(values[:, own], QUANTITIES[quantity].unit)
    extremes = [np.asarray(part) for part in record.extremes]
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks, names = [], []
    for i in own:
        axes.plot(times, values[:, i] / factor, color=colour(i))
        low, low_time, high, high_time = (float(part[i]) for part in extremes)
        peak, when = (low, low_time) if -low > high else (high, high_time)
        peaks.append(peak / factor)
        axes.plot([when], peaks[-1:], "o", color=colour(i), markeredgecolor="white", zorder=3)
        names.append(f"{sensors[i].name or 'peak'} {format_number(peaks[-1])} {unit}")
    axes.set_ylabel(axis_label(quantity, unit))
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.07 * (high - low))  # room for the names
    if 0 in own:  # the first of the quantities
        label_loads(axes, record)
    margin_labels(axes, peaks, names, [colour(i) for i in own])


def _draw_commands(axes, record):
    times, command = np.asarray(record.times), np.asarray(record.command)
    actuators = record.case.actuators
    units = {actuator.command_unit for actuator in actuators}
    style = command_drawstyle(record.case.controller)
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    reached, tints = [], []
    for i, actuator in enumerate(actuators):
        axes.plot(times, command[:, i], color=load_colour(i), linewidth=1.1, drawstyle=style)
        limits = actuator.command_limits()
        if limits is None or not np.any(np.asarray(record.saturated)[:, i]):
            continue
        for limit in np.asarray(concrete(limits)):
            if np.any(np.isclose(command[:, i], limit)):
                reached.append(limit)
                tints.append(load_colour(i))
    axes.set_ylabel(f"command ({', '.join(sorted(units))})")
    draw_limits(axes, reached, tints)
