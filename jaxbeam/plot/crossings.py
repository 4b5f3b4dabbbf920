"""Crossings of loads in rows below each other."""

import dataclasses

import numpy as np

from jaxbeam.case.case import crossing_times
from jaxbeam.case.display import with_prefix
from jaxbeam.case.fields import concrete
from jaxbeam.plot.drawing import drawn_vehicle
from jaxbeam.plot.style import (
    ALARM,
    GREY,
    SHADE,
    annotate,
    format_number,
    label_height,
    load_colour,
    margin_labels,
    text_fraction,
    tinted,
    unit_scale,
)
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.views import wheel_labels

MAX_CURVES = 5  # wheels or bodies of a load with a curve each; those of more are an envelope
SAME_FORCE = 1e-6  # of the static load, by which a contact force may differ from it
MAX_WEIGHTS = 4  # static loads with a line and a label each


def forces_vary(record: Record) -> bool:
    """Whether the contact force of a wheel on the beam differs from its static load.

    It does where a mass or a vehicle is on the beam, or a force is a function of time.
    """
    on = np.isfinite(np.asarray(record.load_position))
    static = np.asarray(concrete(record.loads.weight))[:, 0]
    on = on & ~record.loads.fixed
    deviation = np.where(on, np.abs(np.asarray(record.contact_force) - static), 0.0)
    return bool(np.any(deviation > SAME_FORCE * np.abs(static)))


def draw_forces(axes, record: Record) -> None:
    """Contact forces of all wheels on the beam, dotted lines at their static loads.

    Wheels of a load from dark (front) to light; of many wheels their envelope, and the curve of the
    one that falls furthest below its static load. Crosses mark forces that would have to pull.
    """
    times, force = np.asarray(record.times), np.asarray(record.contact_force)
    on = np.isfinite(np.asarray(record.load_position))
    factor, unit = unit_scale(force[on], "N")
    force = np.where(on, force, np.nan) / factor
    loads, labels = record.loads, wheel_labels(record.loads)
    static = np.asarray(concrete(loads.weight))[:, 0] / factor
    load_of_wheel, heights, names, tints = np.array(loads.load_of_wheel), [], [], []
    for load in range(len(record.case.loads)):
        wheels, tint = np.flatnonzero(load_of_wheel == load), load_colour(int(load))
        if wheels.size > MAX_CURVES and np.any(on[:, wheels]):
            worst = _draw_envelope(axes, times, force, static, wheels, tint)
            if worst is not None:
                heights.append(np.nanmin(force[:, worst]))
                names.append(f"wheel {labels[worst].split()[-1]}, most unloaded")
                tints.append(tint)
        else:
            for i, wheel in enumerate(wheels):
                shade = tinted(tint, 1 - 0.7 * i / max(1, wheels.size - 1))
                axes.plot(times, force[:, wheel], color=shade, linewidth=1.1)
            if wheels.size > 1 and np.any(on[:, wheels]):
                heights.append(np.nanmin(force[:, wheels]))
                names.append("front wheel dark, rear light")
                tints.append(tint)
        for weight in _main_values(static[wheels]):
            axes.axhline(weight, color=tint, linewidth=0.9, linestyle=":")
            if (label := f"weight {format_number(weight)} {unit}") not in names:
                heights.append(weight)
                names.append(label)
                tints.append(tint)
    _mark_losses(axes, record)
    label_height(axes, "contact force", unit)
    margin_labels(axes, heights, names, tints)


def _draw_envelope(axes, times, force, static, wheels, tint):
    """Draw the range of the forces of many wheels, and the force of the one most unloaded.

    Returns that wheel; None, without its curve, if the forces do not vary.
    """
    some = np.isfinite(force[:, wheels]).any(axis=1)
    low, high = np.full(times.shape, np.nan), np.full(times.shape, np.nan)
    low[some] = np.nanmin(force[some][:, wheels], axis=1)
    high[some] = np.nanmax(force[some][:, wheels], axis=1)
    axes.fill_between(times, low, high, color=tinted(tint, 0.3), linewidth=0)
    seen = wheels[np.isfinite(force[:, wheels]).any(axis=0) & (static[wheels] > 0)]
    ratios = np.nanmin(force[:, seen], axis=0) / static[seen] if seen.size else np.ones(1)
    if np.min(ratios) > 1 - 1e-6:
        return None
    worst = int(seen[np.argmin(ratios)])
    axes.plot(times, force[:, worst], color=tint, linewidth=1.1)
    return worst


def _main_values(values) -> list[float]:
    """Distinct values to three digits; of more than MAX_WEIGHTS the least and the largest."""
    different = sorted({float(f"{value:.3g}") for value in values})
    return different if len(different) <= MAX_WEIGHTS else [different[0], different[-1]]


def _mark_losses(axes, record) -> None:
    times = np.asarray(record.contact_lost_time)
    lost = np.flatnonzero(np.isfinite(times))
    if not lost.size:
        return
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.plot(times[lost], 0 * times[lost], "X", color=ALARM, markersize=7, zorder=3)
    if record.flights is not None:
        for flight in zip(record.flights.lift_time, record.flights.landing_time, strict=True):
            axes.plot(flight, [0, 0], color=ALARM, linewidth=3, solid_capstyle="butt")
    first = lost[np.argmin(times[lost])]
    label = wheel_labels(record.loads)[first]
    wheel = f", load {label}" if len(times) > 1 else ""
    left = times[first] > np.mean(np.asarray(record.times)[[0, -1]])
    style = {"ha": "right" if left else "left", "va": "top", "color": ALARM}
    word = "contact loss" if record.flights is None else "leaves the beam"
    annotate(axes, f"{word}{wheel}", (times[first], 0), (-6 if left else 6, -6), **style)


def has_bodies(record: Record) -> bool:
    """Whether a load of the record is a vehicle with bodies."""
    return record.body_acceleration.shape[1] > len(record.case.absorbers)


def draw_accelerations(axes, record: Record) -> None:
    """Vertical accelerations at the centres of the bodies on top of vehicles, with peaks.

    Not of axles and bogies, which shake more and carry nobody; of many vehicles the envelope.
    """
    times, acceleration = np.asarray(record.times), np.asarray(record.body_acceleration)
    loads, first, curves = record.loads, 0, []
    for group in loads.wheels.vehicles:
        load = loads.load_of_wheel[group.first_wheel]
        if load == len(record.case.loads):
            break  # absorbers, which have a row of their own
        parts = drawn_vehicle(record.case.loads[load]).parts
        top = max(part.level for part in parts)
        for part in (part for part in parts if part.level == top):
            dofs, count = len(group.names), group.count
            own = acceleration[:, first : first + dofs * count].reshape(-1, count, dofs)
            curves.append((load, part.name, own @ part.height))
        first += len(group.names) * group.count
    factor, unit = unit_scale(np.concatenate([a.ravel() for _, _, a in curves]), "m/s^2")
    axes.axhline(0, color=GREY, linewidth=0.8)
    heights, names, tints = [], [], []
    several = len({load for load, _, _ in curves}) > 1
    drawn = dict.fromkeys((load for load, _, _ in curves), 0)
    for load, name, values in curves:
        values, tint = values / factor, load_colour(load)
        shade = tinted(tint, 1 - 0.45 * min(drawn[load], 2) / 1.5)
        drawn[load] += 1
        if values.shape[1] > MAX_CURVES:
            low, high = np.min(values, axis=1), np.max(values, axis=1)
            axes.fill_between(times, low, high, color=tinted(tint, 0.35), linewidth=0)
        for i in range(values.shape[1] if values.shape[1] <= MAX_CURVES else 0):
            fade = 1 - 0.6 * i / max(1, values.shape[1] - 1)
            axes.plot(times, values[:, i], color=tinted(shade, fade), linewidth=1.1)
        peak = values.flat[np.argmax(np.abs(values))]
        heights.append(peak)
        who = f"{load} {name}" if several else name
        names.append(f"{who} {format_number(peak)} {unit}")
        tints.append(shade)
    label_height(axes, "body", unit)
    margin_labels(axes, heights, names, tints)


def draw_strokes(axes, record: Record) -> None:
    """Strokes of the absorbers, each with its largest value; dashed lines at their limits."""
    times, strokes, absorbers = record.times, np.asarray(record.stroke), record.case.absorbers
    factor, unit = unit_scale(strokes, "m")
    axes.axhline(0, color=GREY, linewidth=0.8)
    heights, names, tints = [], [], []
    for i, absorber in enumerate(absorbers):
        values, tint = strokes[:, i] / factor, load_colour(len(record.case.loads) + i)
        axes.plot(times, values, color=tint, linewidth=1.1)
        peak = values[np.argmax(np.abs(values))]
        who = f"absorber {i} " if len(absorbers) > 1 else ""
        heights.append(peak)
        names.append(f"{who}{format_number(peak)} {unit}")
        tints.append(tint)
        if absorber.max_stroke is not None:
            largest = float(concrete(absorber.max_stroke)) / factor
            for limit in (-largest, largest):
                axes.axhline(limit, color=tint, linewidth=0.9, linestyle="--")
    label_height(axes, "stroke", unit)
    margin_labels(axes, heights, names, tints)


MAX_LINES = 8  # loads with lines at entry and exit
FONT_SIZE = 8.0  # points, of labels of loads


def load_windows(record: Record) -> list[tuple[int, float, float]]:
    """Number, entry and exit (s) of each load on the beam during the record, clipped to it."""
    times = np.asarray(record.times)
    cut = np.clip(crossing_times(record.case), times[0], times[-1]).tolist()
    return [(i, entry, leaves) for i, (entry, leaves) in enumerate(cut) if entry < leaves]


def shade_crossings(axes, record: Record) -> None:
    """Set the limits of a time axis to those of a record; shade times with loads on the beam."""
    times = np.asarray(record.times)
    axes.set_xlim(times[0], times[-1])
    windows = load_windows(record)
    for _, entry, exit_time in windows:
        axes.axvspan(entry, exit_time, color=SHADE, zorder=0.5, linewidth=0)
        for instant in (entry, exit_time) if len(windows) <= MAX_LINES else ():
            axes.axvline(instant, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), zorder=0.6)


def label_loads(axes, record: Record) -> None:
    """Label each load at its entry: its mass or force and speed, or its number among several.

    Loads that enter too soon after one another for a label each have one together.
    """
    loads, windows = record.case.loads, load_windows(record)
    left, right = axes.get_xlim()

    def width(characters: int) -> float:
        return (right - left) * text_fraction(axes, characters + 1, FONT_SIZE)

    groups = _groups(windows, width(len(f"load {len(loads)}")))
    if len(groups) < len(windows):
        groups = _groups(windows, width(len(f"loads {len(loads)} to {len(loads)}")))
    for first, last, entry in groups:
        label = f"load {first}" if first == last else f"loads {first} to {last}"
        label = label if len(loads) > 1 else _load_label(loads[first])
        at_left = right - entry > width(len(label))
        style = {"ha": "left" if at_left else "right", "va": "top", "fontsize": FONT_SIZE}
        style |= {"xycoords": axes.get_xaxis_transform(), "color": load_colour(first)}
        annotate(axes, label, (entry, 1.0), (4 if at_left else -4, -4), **style)


def _groups(windows: list[tuple[int, float, float]], gap: float) -> list[tuple[int, int, float]]:
    """First and last number of the loads that enter within a gap (s), and the first entry (s)."""
    groups: list[tuple[int, int, float]] = []
    for i, entry, _ in sorted(windows, key=lambda window: window[1]):
        if groups and entry < groups[-1][2] + gap:
            first, last, start = groups[-1]
            groups[-1] = min(first, i), max(last, i), start
        else:
            groups.append((i, i, entry))
    return groups


def _load_label(load) -> str:
    """Mass or force, or name, and speed of a load, with units: "0.5 kg, 1.2 m/s"."""
    numbers = [(field, getattr(load, field.name)) for field in dataclasses.fields(load)]
    parts = [
        with_prefix(float(concrete(value)), field.metadata["unit"])
        for field, value in numbers
        if field.name in ("mass", "force", "speed") and value is not None
    ]
    if load.kind not in ("mass", "force"):
        parts.insert(0, getattr(load, "train", "") or getattr(load, "model", "") or load.kind)
    return ", ".join(parts)
