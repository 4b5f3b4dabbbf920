"""Figure of a sweep: peak deflection at each sensor over one or two addresses."""

import json

import numpy as np
import xarray
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from jaxbeam.case.case import Case, unit_at
from jaxbeam.case.fields import concrete
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.plot.speed_sweep import is_speed_sweep, is_word_axis, plot_speed_sweep
from jaxbeam.plot.style import (
    ALARM,
    FAINT,
    INK,
    colour,
    format_number,
    margin_labels,
    set_title,
    unit_scale,
    use_style,
)

LABEL_MARGIN = 0.06  # share of a map at its edges where contour labels would be cut off
MAX_MARKED_RUNS = 40  # largest number of runs of a curve that are marked with dots


@use_style
def plot_sweep(dataset: xarray.Dataset) -> Figure:
    """Peak deflection over the swept addresses: curves for one, a map per sensor for two.

    Trains over speed are drawn as in `plot_speed_sweep`, other words as bars. A dot marks the
    largest peak; failed runs are left out; paired runs are drawn over their number. A sweep over
    more addresses is drawn in slices: `plot_sweep(dataset.isel({"loads.0.mass": 0}))`.
    Raises ValueError for more than two addresses, for a single run, and for a dataset without
    `peak_deflection` and the attribute `case`.
    """
    if "peak_deflection" not in dataset or "case" not in dataset.attrs:
        raise ValueError("not a sweep of jaxbeam: the dataset lacks peak_deflection or its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    peaks = dataset["peak_deflection"]
    peaks = peaks.squeeze([d for d in peaks.dims if d != "sensor" and peaks.sizes[d] == 1])
    swept = [str(dimension) for dimension in peaks.dims if dimension != "sensor"]
    with_values = [address for address in swept if address in peaks.coords]
    peaks = peaks.sortby([a for a in with_values if not is_word_axis(peaks, a)])
    if "sensor" not in peaks.dims:
        peaks = peaks.expand_dims("sensor")
    if not swept:
        raise ValueError("the dataset holds a single run; a sweep is drawn over its addresses")
    if len(swept) > 2:
        raise ValueError(
            f"a sweep is drawn over one or two addresses, not {len(swept)} ({', '.join(swept)}); "
            f"select a value of the others, as in dataset.isel({{{swept[0]!r}: 0}})"
        )
    if is_speed_sweep(peaks, case):
        return plot_speed_sweep(peaks, case)
    words = [address for address in swept if is_word_axis(peaks, address)]
    if words and len(swept) > 1:
        raise ValueError(
            f"{words[0]} has words, which are drawn over speed only; select one, as in"
            f" dataset.isel({{{words[0]!r}: 0}})"
        )
    factor, unit = unit_scale(peaks, "m")
    peaks = peaks.transpose("sensor", *swept) / factor
    if words:
        figure = _bars(peaks, swept, unit, case)
    else:
        figure = (_curves if len(swept) == 1 else _maps)(peaks, swept, unit, case)
    fixed_values = [
        _fixed_value(case, str(address), value.item())
        for address, value in peaks.coords.items()
        if value.ndim == 0 and address not in ("sensor", "cases")
    ]
    set_title(figure, "\n".join(filter(None, [case.title, ", ".join(fixed_values)])))
    return figure


def _fixed_value(case: Case, address: str, value) -> str:
    """Address and value of a dimension that was selected."""
    if isinstance(value, str):
        return f"{address} = {value}"
    return f"{address} = {value:.4g} {_unit(case, address)}".rstrip()


def _unit(case: Case, address: str) -> str:
    """SI unit of the number at an address; empty if it has none."""
    unit = unit_at(case, address)
    return "" if unit == "1" else unit


def _axis_label(case: Case, address: str) -> str:
    unit = _unit(case, address)
    return f"{address} ({unit})" if unit else address


def _sensor_names(peaks, case):
    """Names of the sensors: their positions (m), or their numbers if positions are swept."""
    if "sensor" not in peaks.coords:
        return [f"sensor {i}" for i in range(peaks.sizes["sensor"])]
    numbers = [int(str(label).split(":")[0]) for label in peaks["sensor"].values]
    swept = any(str(address).startswith("sensors.") for address in peaks.coords)
    return [
        f"sensor {i}" if swept else f"at {float(concrete(case.sensors[i].position)):.4g} m"
        for i in numbers
    ]


def _curves(peaks, swept, unit, case):
    (address,) = swept
    figure = Figure(figsize=(6.4, 4))
    axes = figure.subplots()
    x = peaks[address].values if address in peaks.coords else np.arange(peaks.sizes[address])
    line_style = "o-" if x.size <= MAX_MARKED_RUNS else "-"
    last_values = []
    for i, values in enumerate(peaks.values):
        axes.plot(x, values, line_style, markersize=3, color=colour(i))
        finite = np.flatnonzero(np.isfinite(values))
        last_values.append(values[finite[-1]] if finite.size else 0.0)
        top = finite[np.argmax(values[finite])] if finite.size else []
        axes.plot(x[top], values[top], "o", markersize=7, markeredgecolor="white", color=colour(i))
    axes.set(xlabel=_axis_label(case, address), ylabel=f"peak deflection ({unit})")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    margin_labels(
        axes, last_values, _sensor_names(peaks, case), [colour(i) for i in range(len(last_values))]
    )
    return figure


def _bars(peaks, swept, unit, case):
    """Peaks of words, a bar for each sensor beside each word."""
    (address,) = swept
    labels, count = [str(word) for word in peaks[address].values], peaks.sizes["sensor"]
    figure = Figure(figsize=(6.4, 0.9 + 0.3 * len(labels) * count))
    axes = figure.subplots()
    for i, (values, name) in enumerate(zip(peaks.values, _sensor_names(peaks, case), strict=True)):
        places = np.arange(len(labels)) + (i - (count - 1) / 2) * 0.8 / count
        axes.barh(places, values, 0.7 / count, color=colour(i), label=name)
    axes.set_yticks(np.arange(len(labels)), labels)
    axes.invert_yaxis()
    axes.set(xlabel=f"peak deflection ({unit})", ylabel=address)
    axes.legend()
    return figure


def _maps(peaks, swept, unit, case):
    count = peaks.sizes["sensor"]
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(1.5 + 2.9 * columns, 0.7 + 2.8 * rows))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    y, x = (peaks[address].values for address in swept)
    # One scale for all sensors: equal colours and lines mean equal deflections.
    highest = np.max(peaks.values, initial=0.0, where=np.isfinite(peaks.values)) or 1.0
    contour_levels = MaxNLocator(8).tick_values(0, highest)
    fill_levels = np.linspace(0, contour_levels[-1], 8 * (contour_levels.size - 1) + 1)
    names = _sensor_names(peaks, case)
    filled = None
    for axes, values, title in zip(grid.flat, peaks.values, names, strict=False):
        axes.set_facecolor(FAINT)  # visible where runs failed
        filled = axes.contourf(x, y, values, levels=fill_levels, cmap="YlGnBu")
        drawn = axes.contour(x, y, values, levels=contour_levels[1:-1], colors=INK, linewidths=0.5)
        texts = axes.clabel(drawn, inline=False, fontsize=7, fmt="%.4g")
        corner, size = np.array([x[0], y[0]]), np.array([np.ptp(x), np.ptp(y)])
        for text in texts:
            # A number cut off at an edge would read as another one.
            inside = (np.array(text.get_position()) - corner) / size
            text.set_visible(bool(np.all((inside > LABEL_MARGIN) & (inside < 1 - LABEL_MARGIN))))
            text.set_path_effects([withStroke(linewidth=3, foreground="white")])
        if np.any(np.isfinite(values)):
            row, column = np.unravel_index(np.nanargmax(values), values.shape)
            axes.plot(x[column], y[row], "o", color=ALARM, markeredgecolor="white", clip_on=False)
            title = f"{title}, largest {format_number(values[row, column])} {unit}"
        axes.set_title(title)
        axes.grid(False)
    for axes in grid[-1]:
        axes.set_xlabel(_axis_label(case, swept[1]))
    for axes in grid[:, 0]:
        axes.set_ylabel(_axis_label(case, swept[0]))
    bar = figure.colorbar(
        filled, ax=grid, ticks=contour_levels, label=f"peak deflection ({unit})", pad=0.02
    )
    bar.outline.set_visible(False)
    return figure
