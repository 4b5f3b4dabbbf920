"""Figures of sweeps: peaks over one or two addresses, of trains over speed, of realisations."""

import functools
import json
import textwrap
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from jaxbeam.analysis.critical_speeds import (
    CriticalSpeed,
    cancellation_speeds,
    regular_spacing,
    resonance_speeds,
)
from jaxbeam.case.case import Case, address_words, unit_at
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import QUANTITIES, sensor_labels
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.model.load_set import load_set
from jaxbeam.plot.style import (
    ALARM,
    FAINT,
    GREY,
    INK,
    LIMIT,
    LIMIT_STYLE,
    UnitScale,
    annotate,
    axis_label,
    colour,
    curve_style,
    draw_limits,
    drawing_area,
    format_number,
    limit_words,
    margin_labels,
    set_title,
    single_axes,
    unit_scale,
    use_style,
)
from jaxbeam.runtime.printer import counted
from jaxbeam.simulation.sweeps.realisations import CONFIDENCE, realisations

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


LABEL_MARGIN = 0.06  # fraction of a map at its edges where contour labels would be cut off
QUANTILE = "quantile"  # xarray's name of the dimension of fractiles
MAX_MARKED_RUNS = 40  # largest number of runs of a curve that are marked with dots


@use_style
def plot_sweep(
    dataset: xarray.Dataset,
    *,
    ax: Axes | None = None,
    title: str | None = None,
    labels: Sequence[str] | None = None,
    limits: Mapping[str, float] | None = None,
) -> Figure | SubFigure:
    """Peaks at the sensors over the swept addresses: curves for one, a map per sensor for two.

    Trains over speed are drawn as in `plot_speed_sweep`, other words as bars. Each quantity has a
    scale of its own. A dot marks the largest peak; failed runs are left out; paired runs are drawn
    over their number. A sweep over more addresses is drawn in slices:
    `plot_sweep(dataset.isel({"loads.0.mass": 0}))`. Fractiles over an address, as
    `dataset.quantile([0.5, 0.95], "profile.seed", keep_attrs=True)`, are drawn beside each other.
    `limits` by quantity (SI units), as `{"acceleration": 3.5}`, are dotted lines.

    The figure takes the place of `ax`, curves of one quantity are drawn on it. The title is that of
    the case, with what was selected, if left out; `labels` name the sensors of the dataset. Raises
    ValueError for more than two addresses, for a single run, for a dataset without peaks and the
    attribute `case`, and for another number of labels than sensors.
    """
    variables = [f"peak_{name}" for name in QUANTITIES if f"peak_{name}" in dataset]
    if not variables or "case" not in dataset.attrs:
        raise ValueError("not a sweep of jaxbeam: the dataset lacks its peaks or its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    # Each sensor has its peaks in the variable of its quantity, and NaN in the others.
    peaks = functools.reduce(lambda one, other: one.fillna(other), (dataset[n] for n in variables))
    peaks = peaks.squeeze([d for d in peaks.dims if d != "sensor" and peaks.sizes[d] == 1])
    if "sensor" not in peaks.dims:
        peaks = peaks.expand_dims("sensor")
    names = _sensor_names(peaks, case, labels)
    if QUANTILE in peaks.dims:
        levels = [_fractile_words(level) for level in peaks[QUANTILE].values]
        names = [f"{name}, {level}" for name in names for level in levels]
        peaks = _fractiles_as_sensors(peaks)
    swept = [str(dimension) for dimension in peaks.dims if dimension != "sensor"]
    with_values = [address for address in swept if address in peaks.coords]
    peaks = peaks.sortby([a for a in with_values if not is_word_axis(peaks, a)])
    if not swept:
        raise ValueError("the dataset holds a single run; a sweep is drawn over its addresses")
    if len(swept) > 2:
        raise ValueError(
            f"a sweep is drawn over one or two addresses, not {len(swept)} ({', '.join(swept)}); "
            f"select a value of the others, as in dataset.isel({{{swept[0]!r}: 0}})"
        )
    if is_speed_sweep(peaks, case):
        return plot_speed_sweep(peaks, case, names, ax=ax, title=title, limits=limits)
    words = [address for address in swept if is_word_axis(peaks, address)]
    if words and len(swept) > 1:
        raise ValueError(
            f"{words[0]} has words, which are drawn over speed only; select one, as in"
            f" dataset.isel({{{words[0]!r}: 0}})"
        )
    peaks = peaks.transpose("sensor", *swept)
    numbers = sensor_numbers(peaks, case)
    by_quantity = [
        [row for row, i in enumerate(numbers) if case.sensors[i].quantity == quantity]
        for quantity in dict.fromkeys(case.sensors[i].quantity for i in numbers)
    ]
    groups = [_quantity_peaks(peaks, numbers, rows, case, names, limits) for rows in by_quantity]
    draw = _bars if words else _curves if len(swept) == 1 else _maps
    figure = draw(groups, swept, case, ax)
    fixed_values = [
        _fixed_value(case, str(address), value.item())
        for address, value in peaks.coords.items()
        if value.ndim == 0 and address not in ("sensor", "cases")
    ]
    whole_title = "\n".join(filter(None, [case.title, ", ".join(fixed_values)]))
    set_title(figure, title, whole_title, ax)
    return figure


def _fractile_words(level: float) -> str:
    return f"{100 * level:g} % fractile"


def _fractiles_as_sensors(peaks: xarray.DataArray) -> xarray.DataArray:
    """Peaks (sensor, ...) in which each fractile of a sensor is one more sensor."""
    rest = [dimension for dimension in peaks.dims if dimension not in ("sensor", QUANTILE)]
    ordered = peaks.transpose("sensor", QUANTILE, *rest)
    count, levels = ordered.shape[:2]
    values = ordered.values.reshape(count * levels, *ordered.shape[2:])
    first = ordered.isel({QUANTILE: 0}, drop=True)
    return first.isel(sensor=np.repeat(np.arange(count), levels)).copy(data=values)


def _fixed_value(case: Case, address: str, value) -> str:
    """Name and value of a dimension that was selected."""
    if address == QUANTILE:
        return _fractile_words(value)
    words = address_words(case, address)
    if isinstance(value, str):
        return f"{words} {value}"
    factor, unit = _axis_scale(case, address, value)
    return f"{words} {value / factor:.4g} {unit}".rstrip()


def _axis_scale(case: Case, address: str, values) -> UnitScale:
    """Unit of the axis of a swept number: with a prefix, or km/h of fast speeds."""
    if is_speed(address):
        return speed_scale(values)
    unit = unit_at(case, address)
    return UnitScale(1.0, "") if unit in ("", "1") else unit_scale(values, unit)


class QuantityPeaks(NamedTuple):
    """Peaks (sensor, ...) of a quantity in the unit of its label, names and numbers of sensors."""

    label: str
    unit: str
    peaks: xarray.DataArray
    names: list[str]
    numbers: list[int]
    limits: list[float]  # of the quantity: none, or one


def _quantity_peaks(
    peaks, numbers, rows, case: Case, names: list[str], limits: Mapping[str, float] | None
) -> QuantityPeaks:
    """Peaks of the sensors of a quantity, which are some rows of all peaks."""
    own = [numbers[row] for row in rows]
    quantity = case.sensors[own[0]].quantity
    factor, unit = unit_scale(peaks[rows], QUANTITIES[quantity].unit)
    label = axis_label(f"peak {quantity}", unit)
    given = [limits[quantity] / factor] if limits and quantity in limits else []
    names = [names[row] for row in rows]
    return QuantityPeaks(label, unit, peaks[rows] / factor, names, own, given)


def _sensor_names(peaks, case: Case, labels: Sequence[str] | None) -> list[str]:
    """Names of the sensors of a dataset; without one, positions (m), or numbers if swept."""
    numbers = sensor_numbers(peaks, case)
    if labels is not None:
        if len(labels) != len(numbers):
            raise ValueError(
                f"labels names {counted(len(labels), 'sensor')}; the sweep has {len(numbers)}"
            )
        return list(labels)
    swept = any(str(address).startswith("sensors.") for address in peaks.coords)
    positions = [f"at {float(concrete(case.sensors[i].position)):.4g} m" for i in numbers]
    return [
        case.sensors[i].name or (f"sensor {i}" if swept else position)
        for i, position in zip(numbers, positions, strict=True)
    ]


def _curves(groups: list[QuantityPeaks], swept, case, ax):
    (address,) = swept
    if len(groups) == 1:
        figure, axes = single_axes(ax, (6.4, 4.0))
        rows = [axes]
    else:
        figure = drawing_area(ax, (6.4, 1.2 + 2.8 * len(groups)))
        rows = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    words, scale = "run", UnitScale(1.0, "")
    if address in groups[0].peaks.coords:
        scale = _axis_scale(case, address, groups[0].peaks[address])
        words = address_words(case, address)
    for axes, group in zip(rows, groups, strict=True):
        peaks = group.peaks
        x = peaks[address].values if address in peaks.coords else np.arange(peaks.sizes[address])
        x = x / scale.factor
        line_style = "o-" if x.size <= MAX_MARKED_RUNS else "-"
        tints, last_values = [colour(i) for i in group.numbers], []
        for tint, values in zip(tints, peaks.values, strict=True):
            axes.plot(x, values, line_style, markersize=3, color=tint)
            finite = np.flatnonzero(np.isfinite(values))
            last_values.append(values[finite[-1]] if finite.size else 0.0)
            top = finite[np.argmax(values[finite])] if finite.size else []
            axes.plot(x[top], values[top], "o", markersize=7, markeredgecolor="white", color=tint)
        axes.set_ylabel(group.label)
        axes.margins(x=0.01)
        for limit in group.limits:
            axes.axhline(limit, **LIMIT_STYLE)
        axes.set_ylim(bottom=0)
        texts = [limit_words(limit, group.unit) for limit in group.limits]
        tints += [LIMIT] * len(texts)
        margin_labels(axes, [*last_values, *group.limits], [*group.names, *texts], tints)
    rows[-1].set_xlabel(axis_label(words, scale.unit))
    return figure


def _bars(groups: list[QuantityPeaks], swept, case, ax):
    """Draw peaks over words, with a bar for each sensor at each word."""
    (address,) = swept
    labels = [str(word) for word in groups[0].peaks[address].values]
    heights = [0.9 + 0.3 * len(labels) * len(group.names) for group in groups]
    figure = drawing_area(ax, (6.4, sum(heights)))
    rows = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, group in zip(rows, groups, strict=True):
        count = len(group.names)
        bars = zip(group.peaks.values, group.names, group.numbers, strict=True)
        for i, (values, name, number) in enumerate(bars):
            places = np.arange(len(labels)) + (i - (count - 1) / 2) * 0.8 / count
            axes.barh(places, values, 0.7 / count, color=colour(number), label=name)
        for limit in group.limits:
            axes.axvline(limit, label=limit_words(limit, group.unit), **LIMIT_STYLE)
        axes.set_yticks(np.arange(len(labels)), labels)
        axes.invert_yaxis()
        axes.set(xlabel=group.label, ylabel=address_words(case, address))
        axes.legend()
    return figure


def _maps(groups: list[QuantityPeaks], swept, case, ax):
    columns = min(max(len(group.names) for group in groups), 3)
    heights = [-(-len(group.names) // columns) for group in groups]
    figure = drawing_area(ax, (1.5 + 2.9 * columns, 0.7 + 2.8 * sum(heights)))
    grid = figure.subplots(sum(heights), columns, sharex=True, sharey=True, squeeze=False)
    scales = [_axis_scale(case, address, groups[0].peaks[address]) for address in swept]
    first = 0
    for group, height in zip(groups, heights, strict=True):
        _draw_maps(figure, grid[first : first + height], group, swept, scales)
        first += height
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(address_words(case, swept[1]), scales[1].unit))
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(address_words(case, swept[0]), scales[0].unit))
    return figure


def _draw_maps(figure, grid, group: QuantityPeaks, swept, scales):
    """Maps of a quantity in the rows of a grid; equal colours are equal peaks."""
    peaks = group.peaks
    for axes in grid.flat[len(group.names) :]:
        axes.set_visible(False)
    scaled = zip(swept, scales, strict=True)
    y, x = (peaks[address].values / scale.factor for address, scale in scaled)
    highest = np.max(peaks.values, initial=0.0, where=np.isfinite(peaks.values)) or 1.0
    contour_levels = MaxNLocator(8).tick_values(0, highest)
    fill_levels = np.linspace(0, contour_levels[-1], 8 * (contour_levels.size - 1) + 1)
    filled = None
    for axes, values, title in zip(grid.flat, peaks.values, group.names, strict=False):
        axes.set_facecolor(FAINT)  # visible where runs failed
        filled = axes.contourf(x, y, values, levels=fill_levels, cmap="YlGnBu")
        drawn = axes.contour(x, y, values, levels=contour_levels[1:-1], colors=INK, linewidths=0.5)
        texts = axes.clabel(drawn, inline=False, fontsize=7, fmt="%.4g")
        for limit in group.limits:
            if np.nanmin(values) < limit < np.nanmax(values):
                axes.contour(x, y, values, levels=[limit], colors=LIMIT, linestyles=":")
        corner, size = np.array([x[0], y[0]]), np.array([np.ptp(x), np.ptp(y)])
        for text in texts:
            # A number cut off at an edge would read as another one.
            inside = (np.array(text.get_position()) - corner) / size
            text.set_visible(bool(np.all((inside > LABEL_MARGIN) & (inside < 1 - LABEL_MARGIN))))
            text.set_path_effects([withStroke(linewidth=3, foreground="white")])
        if np.any(np.isfinite(values)):
            row, column = np.unravel_index(np.nanargmax(values), values.shape)
            axes.plot(x[column], y[row], "o", color=ALARM, markeredgecolor="white", clip_on=False)
            title = f"{title}, largest {format_number(values[row, column])} {group.unit}".rstrip()
        axes.set_title(title)
        axes.grid(False)
    words = "".join(f"\n{limit_words(limit, group.unit)} dotted" for limit in group.limits)
    label = group.label + words
    bar = figure.colorbar(filled, ax=grid, ticks=contour_levels, label=label, pad=0.02)
    bar.outline.set_visible(False)


@use_style
def plot_realisations(
    dataset: xarray.Dataset,
    address: str,
    level: float = 0.95,
    *,
    ax: Axes | None = None,
    title: str | None = None,
    labels: Sequence[str] | None = None,
    limits: Mapping[str, float] | None = None,
) -> Figure | SubFigure:
    """Histogram of the peak of each sensor over the values at an address, as `profile.seed`.

    Lines mark the mean and the fractile of a level, a band the interval of the fractile, dotted
    red ones `limits` by quantity (SI units). All other addresses of the sweep must have one value.
    The title is that of the case if left out; `labels` name the sensors. Raises ValueError as
    `realisations`, and for further addresses with several values.
    """
    found = realisations(dataset, address, level)
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    others = [d for d in dataset["failed"].dims if d != address and dataset.sizes[d] > 1]
    if others:
        raise ValueError(f"a histogram is one of {address} alone; select a value of {others[0]}")
    count = len(case.sensors)
    figure = drawing_area(ax, (6.4, 0.8 + 2.2 * count))
    rows = figure.subplots(count, 1, squeeze=False)[:, 0]
    for i, (axes, sensor) in enumerate(zip(rows, case.sensors, strict=True)):
        name = f"peak_{sensor.quantity}"
        peaks = dataset[name].isel(sensor=i).values.ravel()
        peaks = peaks[np.isfinite(peaks)]
        factor, unit = unit_scale(peaks, QUANTITIES[sensor.quantity].unit)
        one = found[name].isel(sensor=i)
        at = {key: one.sel(statistic=key).values.item() / factor for key in ("mean", "fractile")}
        low, high = (one.sel(statistic=key).values.item() / factor for key in ("low", "high"))
        axes.hist(peaks / factor, bins="auto", color=colour(i), alpha=0.7)
        for style, (key, words) in zip(
            (":", "-"), (("mean", "mean"), ("fractile", f"{100 * level:g} % fractile")), strict=True
        ):
            line = f"{words} {format_number(at[key])}"
            axes.axvline(at[key], color=INK, linestyle=style, linewidth=1.2, label=line)
        if limits and sensor.quantity in limits:
            limit = limits[sensor.quantity] / factor
            axes.axvline(limit, label=limit_words(limit, unit), **LIMIT_STYLE)
        place = labels[i] if labels else sensor.name or f"at {float(sensor.position):.4g} m"
        axes.set(ylabel="runs", xlabel=axis_label(f"peak {sensor.quantity}, {place}", unit))
        is_closed = np.isfinite([low, high]).all()
        ends = f"{format_number(low)} to {format_number(high)}" if is_closed else "not closed yet"
        left, right = axes.get_xlim()
        band = {"color": INK, "alpha": 0.1, "linewidth": 0}
        words = f"its interval of {100 * CONFIDENCE:g} %: {ends}"
        axes.axvspan(max(low, left), min(high, right), label=words, **band)
        axes.set_xlim(left, right)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderpad=0.2)
    words = f"{counted(dataset.sizes[address], 'value')} of the {address_words(case, address)}"
    set_title(figure, title, "\n".join(filter(None, [case.title, words])), ax)
    return figure
