"""Figure of a sweep over speed: peaks of trains, their envelope, and speeds of resonance."""

import json
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from jaxbeam.analysis.critical_speeds import (
    CriticalSpeed,
    cancellation_speeds,
    regular_spacing,
    resonance_speeds,
)
from jaxbeam.case.case import Case, address_words
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.load_set import load_set
from jaxbeam.plot.style import (
    FAINT,
    GREY,
    INK,
    LIMIT,
    UnitScale,
    annotate,
    axis_label,
    curve_style,
    draw_limits,
    drawing_area,
    format_number,
    set_title,
    unit_scale,
    use_style,
)

FAST = 20.0  # m/s: from here on speeds are in km/h
MAX_ORDER = 4  # of marked resonances and cancellations; higher ones are weak
HALO = [withStroke(linewidth=3, foreground="white")]
ENVELOPE_STYLE = {"color": FAINT, "linewidth": 6.0, "zorder": 1}
LINE = 92  # letters of a line of a title or the legend


def is_speed_sweep(peaks: xarray.DataArray, case: Case) -> bool:
    """Whether peaks (speed, ...) are those of trains or of several wheels, over one speed.

    One more dimension may have words, as names of trains.
    """
    swept = [str(dim) for dim in peaks.dims if dim != "sensor"]
    speeds = [dim for dim in swept if is_speed(dim)]
    others = [dim for dim in swept if dim not in speeds]
    if len(speeds) != 1 or len(others) > 1 or not all(is_word_axis(peaks, dim) for dim in others):
        return False
    return bool(others) or load_set(case).wheel_count > len(case.carried)


def is_speed(address: str) -> bool:
    """Whether an address is the speed of one load, or of all."""
    return address.startswith("loads.") and address.endswith(".speed")


def is_word_axis(peaks: xarray.DataArray, address: str) -> bool:
    """Whether a dimension is labelled by words."""
    return address in peaks.coords and peaks[address].dtype.kind not in "fiub"


@use_style
def plot_speed_sweep(
    peaks: xarray.DataArray,
    case: Case,
    names: Sequence[str],
    *,
    ax: Axes | None = None,
    title: str | None = None,
    limits: Mapping[str, float] | None = None,
) -> Figure | SubFigure:
    """Peaks (speed, word, sensor) over speed, in the units of the sensors, a curve for each word.

    A panel for each sensor, under its name and its largest peak, which a black dot marks, and
    speeds in km/h from 72 km/h on. Behind the curves of several words, named below, is their
    envelope. Triangles mark resonance speeds d f_1 / i of a curve, dashed lines those of the curve
    with the largest peak; dotted lines are cancellation speeds, where there is a closed form (see
    `analysis.critical_speeds`), and limits by quantity. The figure takes the place of `ax`; its
    title is that of the case if left out.
    """
    (address,) = (str(dim) for dim in peaks.dims if is_speed(str(dim)))
    others = [str(dim) for dim in peaks.dims if dim not in (address, "sensor")]
    labels = [str(word) for word in peaks[others[0]].values] if others else [""]
    cases = _cases(peaks, case, len(labels))
    if not others:
        labels = [getattr(cases[0].loads[_load_index(address)], "train", "")]
    values = peaks.transpose("sensor", *others, address).values
    values = values.reshape(peaks.sizes["sensor"], len(labels), -1)
    speeds = np.abs(peaks[address].values)
    count = len(values)
    numbers = sensor_numbers(peaks, case)
    columns = max(1, LINE // (max(12, *map(len, labels)) + 8))  # 12 letters: "cancellation"
    lines = -(-(len(labels) + 3) // columns)
    figure = drawing_area(ax, (7.6, 0.8 + 3.6 * count + 0.17 * lines))
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    entries: dict[str, Line2D] = {}
    for i, (axes, curves) in enumerate(zip(panels, values, strict=True)):
        quantity = case.sensors[numbers[i]].quantity
        factor, unit = unit_scale(curves, QUANTITIES[quantity].unit)
        axes.set_ylabel(axis_label(f"peak {quantity}", unit))
        largest, found = _draw_panel(
            axes, speeds, curves / factor, labels, cases, _load_index(address), unit
        )
        entries |= found
        name = f"{names[i]}: " if count > 1 else ""
        axes.set_title("\n".join(textwrap.wrap(name + largest, LINE)))
        if limits and quantity in limits:
            limit = limits[quantity] / factor
            axes.set_ylim(0.0, max(axes.get_ylim()[1], 1.05 * limit))
            draw_limits(axes, [limit], [LIMIT], unit)
    panels[-1].set_xlabel(axis_label(address_words(case, address), speed_scale(speeds).unit))
    if len(labels) > 1:
        curves = [Line2D([], [], label=one, **curve_style(k)) for k, one in enumerate(labels)]
        entries = dict(zip(labels, curves, strict=True)) | entries
    if entries:
        figure.legend(handles=list(entries.values()), loc="outside lower left", ncols=columns)
    set_title(figure, title, case.title)
    return figure


def speed_scale(speeds) -> UnitScale:
    """Unit in which speeds (m/s) are drawn: km/h from 72 km/h on."""
    is_fast = np.max(np.abs(speeds)) >= FAST
    return UnitScale(1 / 3.6, "km/h") if is_fast else UnitScale(1.0, "m/s")


def sensor_numbers(peaks: xarray.DataArray, case: Case) -> list[int]:
    """Numbers of the sensors of a dataset, by their labels."""
    if "sensor" not in peaks.coords:
        return list(range(peaks.sizes["sensor"]))
    labels = sensor_labels(case.sensors)
    return [labels.index(str(label)) for label in np.atleast_1d(peaks["sensor"].values)]


def _load_index(address: str) -> int:
    """Index of the load that an address names; 0 for all."""
    index = address.split(".")[1]
    return int(index) if index.isdigit() else 0


def _cases(peaks, case: Case, count: int) -> list[Case]:
    """Cases of the curves."""
    if "cases" not in peaks.coords:
        return [case] * count
    return [case_from_dict(json.loads(str(text))) for text in np.atleast_1d(peaks["cases"].values)]


def _draw_panel(axes, speeds, curves, labels, cases, load, unit):
    """Curves (word, speed) of one sensor, their envelope and marks.

    Returns the largest peak in words, and a legend of envelope, marks and lines.
    """
    factor, speed_unit = 1 / speed_scale(speeds).factor, speed_scale(speeds).unit
    order = np.argsort(speeds)
    x, curves = factor * speeds[order], curves[:, order]
    finite = np.where(np.isfinite(curves), curves, -np.inf)
    worst, at = np.unravel_index(np.argmax(finite), curves.shape)
    entries: dict[str, Line2D] = {}
    if len(labels) > 1:
        axes.plot(x, np.max(finite, axis=0), **ENVELOPE_STYLE)
        entries["envelope"] = Line2D([], [], label="envelope", **ENVELOPE_STYLE)
    limits = float(np.min(speeds)), float(np.max(speeds))
    for i, (case, y) in enumerate(zip(cases, curves, strict=True)):
        look = curve_style(i)
        axes.plot(x, y, zorder=3 if i == worst else 2, **look)
        marks = [factor * one.speed for one in _resonances(case, load, *limits)]
        axes.plot(marks, np.interp(marks, x, y), "v", markersize=5, color=look["color"],
                  markeredgecolor="white", markeredgewidth=0.6, zorder=4)  # fmt: skip
    axes.set_ylim(0.0, 1.2 * float(np.max(finite)))
    axes.set_xlim(x[0], x[-1])
    entries |= _draw_critical_speeds(axes, cases[worst], load, limits, factor)
    axes.plot(x[at], curves[worst, at], "o", markersize=6, markeredgecolor="white", color=INK,
              clip_on=False, zorder=6)  # fmt: skip
    peak = f"{format_number(curves[worst, at])} {unit} at {format_number(x[at])} {speed_unit}"
    return f"largest {peak}" + (f", {labels[worst]}" if labels[worst] else ""), entries


def _resonances(case: Case, load: int, lowest: float, highest: float) -> list[CriticalSpeed]:
    """Resonance speeds of the first mode that are marked; none for loads without spacing."""
    spacing = regular_spacing(case, load)
    if spacing is None:
        return []
    found = resonance_speeds(case, spacing, lowest, highest)
    return [one for one in found if one.order <= MAX_ORDER]


def _draw_critical_speeds(axes, case: Case, load: int, limits, factor: float) -> dict[str, Line2D]:
    """Lines at resonance speeds of a case, named above, and at those of cancellation; a legend."""
    resonances = _resonances(case, load, *limits)
    cancellations = [c for c in cancellation_speeds(case, *limits) if c.order <= 2 * MAX_ORDER + 1]
    named = [(one, "d f₁", "--", INK, 0.99) for one in resonances]
    if resonances:
        named += [(one, "2 L f₁", ":", GREY, 0.93) for one in cancellations]
    for one, words, style, tint, height in named:
        words = words if one.order == 1 else f"{words} / {one.order}"
        axes.axvline(factor * one.speed, color=tint, linestyle=style, linewidth=0.8, zorder=1)
        annotate(axes, words, (factor * one.speed, height), (3, 0), va="top", fontsize=8,
                 color=tint, path_effects=HALO, xycoords=axes.get_xaxis_transform())  # fmt: skip
    if not resonances:
        return {}
    mark = {"marker": "v", "markersize": 5, "color": INK, "linestyle": "--", "linewidth": 0.8}
    entries = {"resonance": Line2D([], [], label="resonance", **mark)}
    if cancellations:
        line = {"color": GREY, "linestyle": ":", "linewidth": 0.8}
        entries["cancellation"] = Line2D([], [], label="cancellation", **line)
    return entries
