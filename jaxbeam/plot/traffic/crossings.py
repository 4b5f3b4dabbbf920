"""Times with loads on the beam in figures over time: shading, and labels at entries."""

import dataclasses

import numpy as np

from jaxbeam.case.case import crossing_times
from jaxbeam.case.display.prefixes import with_prefix
from jaxbeam.case.fields import concrete
from jaxbeam.plot.style import GREY, SHADE, annotate, load_colour, text_share
from jaxbeam.simulation.record import Record

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
        return (right - left) * text_share(axes, characters + 1, FONT_SIZE)

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
