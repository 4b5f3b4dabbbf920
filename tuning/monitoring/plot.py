"""Figure of the modes of a structure over time, with the control chart."""

import os
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.plot.style import ALARM, GREY, LIMIT_STYLE, colour, use_style
from jaxbeam.runtime.output_file import whole_file
from tuning.monitoring.chart import ControlChart
from tuning.monitoring.tracks import ModeTrack

MAX_PANELS = 8  # modes; the lowest of more
QUANTILE = 1.96


@use_style
def plot_monitoring(
    count: int,
    all_tracks: Sequence[ModeTrack],
    chart: ControlChart | None,
    path: str | os.PathLike | None = None,
) -> Figure:
    """Tracks over so many logs, a panel for each with what conditions explain, and the chart.

    It is saved to `path` if given.
    """
    tracks = all_tracks[:MAX_PANELS]
    panels = max(len(tracks) + (chart is not None), 1)
    figure = Figure(figsize=(8.0, 1.0 + 1.7 * panels))
    axes = np.atleast_1d(figure.subplots(panels, sharex=True))
    logs = np.arange(count)
    for number, (own, track) in enumerate(zip(axes, tracks, strict=False)):
        if chart is not None and number in chart.used:
            fit = chart.regressions[chart.used.index(number)]
            half = QUANTILE * fit.deviation * np.sqrt(1 + fit.leverage)
            low, high = fit.predicted * np.exp(-half), fit.predicted * np.exp(half)
            own.fill_between(logs, low, high, color=GREY, alpha=0.25, linewidth=0)
        own.plot(logs, track.frequencies, ".", color=colour(number), markersize=4)
        own.set_ylabel("frequency (Hz)")
        own.set_title(f"mode {number + 1}")
    if chart is not None:
        own = axes[len(tracks)]
        own.plot(logs, chart.statistic, ".", color=GREY, markersize=4)
        here = chart.alarm
        own.plot(logs[here], chart.statistic[here], "o", color=ALARM, markersize=4, label="alarm")
        own.axhline(chart.limit, **LIMIT_STYLE, label="limit")
        own.axvline(chart.baseline - 0.5, color=GREY, linewidth=0.8, label="end of the baseline")
        own.set_yscale("log")
        own.set_ylabel("Hotelling's $T^2$")
        own.set_title("control chart of what conditions do not explain")
        own.legend(ncols=3, fontsize=7)
    axes[-1].set_xlabel("log")
    if path is not None:
        with whole_file(path, overwrite=True) as partial:
            figure.savefig(partial)
    return figure
