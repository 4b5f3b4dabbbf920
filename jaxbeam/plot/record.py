"""One run: deflection at the sensors, contact forces and commands over time."""

import dataclasses

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.case.fields import concrete
from jaxbeam.case.loads import trajectory
from jaxbeam.plot.schematic import draw_schematic
from jaxbeam.plot.style import (
    ALARM,
    GREY,
    SHADE,
    colour,
    format_number,
    load_colour,
    margin_labels,
    set_title,
    unit_scale,
    use_style,
)
from jaxbeam.simulation.record import Record


@use_style
def plot_record(record: Record) -> Figure:
    """Deflection at the sensors (dots: peaks), below it contact forces, and commands if any.

    The times with loads on the beam are shaded. On top, the rig shows where the sensors are.
    Raises ValueError if the record has neither sensors nor loads.
    """
    case = record.case
    panels = [
        (height, draw)
        for height, draw, shown in (
            (0.7, _draw_schematic, True),
            (3.2, _draw_deflection, case.sensors),
            (1.7, _draw_forces, case.loads),
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


def load_windows(record: Record) -> list[tuple[int, float, float]]:
    """Each load seen in the record, by number, with its entry and exit (s), cut to the record."""
    times = np.asarray(record.times)
    trajectories = [trajectory(load, record.case.beam.length) for load in record.case.loads]
    windows = np.array(
        [[float(concrete(t)) for t in trajectory.entry_exit_times()] for trajectory in trajectories]
    ).reshape(-1, 2)
    cut = np.clip(windows, times[0], times[-1]).tolist()
    return [(i, entry, leaves) for i, (entry, leaves) in enumerate(cut) if entry < leaves]


def _draw_schematic(axes, record):
    draw_schematic(axes, record.case)


def shade_crossings(axes, record: Record) -> None:
    """Shade the times at which loads are on the beam, in axes over the time of a record."""
    times = np.asarray(record.times)
    axes.set_xlim(times[0], times[-1])
    for _, entry, exit_time in load_windows(record):
        axes.axvspan(entry, exit_time, color=SHADE, zorder=0.5, linewidth=0)
        for instant in (entry, exit_time):
            axes.axvline(instant, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), zorder=0.6)


def label_loads(axes, record: Record) -> None:
    """Write at its entry what a load is; several are numbered."""
    loads = record.case.loads
    for i, entry, _ in load_windows(record):
        label = f"load {i}" if len(loads) > 1 else _load_label(loads[i])
        axes.annotate(
            label,
            (entry, 1.0),
            xycoords=axes.get_xaxis_transform(),
            xytext=(4, -4),
            textcoords="offset points",
            va="top",
            color=load_colour(i),
            fontsize=8,
        )


def _load_label(load) -> str:
    """The numbers of a load that tell it from others, with units: "0.5 kg, 1.2 m/s"."""
    numbers = [(field, getattr(load, field.name)) for field in dataclasses.fields(load)]
    return ", ".join(
        f"{float(concrete(value)):.4g} {field.metadata['unit']}"
        for field, value in numbers
        if field.name in ("mass", "force", "speed") and value is not None
    )


def _draw_deflection(axes, record):
    times, deflection = np.asarray(record.times), np.asarray(record.deflection)
    factor, unit = unit_scale(deflection, "m")
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    peaks = []
    for i, when in enumerate(np.asarray(record.peak_time)):
        axes.plot(times, deflection[:, i] / factor, color=colour(i))
        # A record keeps the size of a peak; its sign is that of the history there.
        sign = np.sign(np.interp(when, times, deflection[:, i]))
        peaks.append(sign * float(record.peak_deflection[i]) / factor)
        axes.plot([when], peaks[-1:], "o", color=colour(i), markeredgecolor="white", zorder=3)
    axes.set_ylabel(f"deflection ({unit})")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.07 * (high - low))  # room for the names
    label_loads(axes, record)
    names = [f"peak {format_number(peak)} {unit}" for peak in peaks]
    margin_labels(axes, peaks, names, [colour(i) for i in range(len(peaks))])


def _draw_forces(axes, record):
    times, force = np.asarray(record.times), np.asarray(record.contact_force)
    on = np.isfinite(np.asarray(record.load_position))
    factor, unit = unit_scale(force[on], "N")
    shade_crossings(axes, record)
    weights = {}
    for i, load in enumerate(record.case.loads):
        contact_force = np.where(on[:, i], force[:, i], np.nan) / factor
        axes.plot(times, contact_force, color=load_colour(i), linewidth=1.1)
        weight = float(concrete(load.weight(record.case.run.gravity))) / factor
        weights.setdefault(weight, load_colour(i))
    lost = np.asarray(record.contact_lost_time)
    lost = lost[np.isfinite(lost)]
    if lost.size:
        axes.axhline(0, color=GREY, linewidth=0.8)
        axes.plot(lost, 0 * lost, "X", color=ALARM, markersize=7, zorder=3)
        axes.annotate(
            "has to pull",
            (lost.min(), 0),
            xytext=(-6, -6),
            textcoords="offset points",
            ha="right",
            va="top",
            color=ALARM,
        )
    axes.set_ylabel(f"contact force ({unit})")
    for weight, tint in weights.items():
        axes.axhline(weight, color=tint, linewidth=0.9, linestyle=":")
    names = [f"weight {format_number(weight)} {unit}" for weight in weights]
    margin_labels(axes, list(weights), names, list(weights.values()))


def _draw_commands(axes, record):
    times, command = np.asarray(record.times), np.asarray(record.command)
    actuators = record.case.actuators
    units = {type(a).__dataclass_fields__["limits"].metadata["unit"] for a in actuators}
    shade_crossings(axes, record)
    axes.axhline(0, color=GREY, linewidth=0.8)
    limit_values, names, tints = [], [], []
    for i, actuator in enumerate(actuators):
        # Commands of a sampled controller are held, not joined.
        sampled = record.case.controller.period is not None
        style = "steps-post" if sampled else "default"
        axes.plot(times, command[:, i], color=load_colour(i), linewidth=1.1, drawstyle=style)
        limits = actuator.command_limits()
        if limits is None or not np.any(np.asarray(record.saturated)[:, i]):
            continue
        for limit in np.asarray(concrete(limits)):
            if np.any(np.isclose(command[:, i], limit)):
                axes.axhline(limit, color=load_colour(i), linewidth=0.9, linestyle=":")
                limit_values.append(limit)
                names.append(f"limit {format_number(limit)}")
                tints.append(load_colour(i))
    axes.set_ylabel(f"command ({', '.join(sorted(units))})")
    margin_labels(axes, limit_values, names, tints)
