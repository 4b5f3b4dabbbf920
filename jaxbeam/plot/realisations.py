"""Figure of peaks over random realisations: histograms with mean, fractile and its interval."""

import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxbeam.case.case import address_words
from jaxbeam.case.display import unit_scale
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.plot.style import (
    INK,
    LIMIT_STYLE,
    axis_label,
    colour,
    drawing_area,
    format_number,
    limit_words,
    set_title,
    use_style,
)
from jaxbeam.sweeps.realisations import CONFIDENCE, realisations


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
    `jaxbeam.sweeps.realisations.realisations`, and for further addresses with several values.
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
    words = f"{dataset.sizes[address]} values of the {address_words(case, address)}"
    set_title(figure, title, "\n".join(filter(None, [case.title, words])), ax)
    return figure
