"""Figure of the modes of several setups: what each says, and the merged shapes."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.plot.style import GREY, colour, use_style
from jaxbeam.runtime.whole_file import whole_file
from tuning.modal.shape_plot import draw_shapes

WIDTH = 0.7  # of the space of a mode in which the setups stand beside each other


@use_style
def plot_setups(fit, path: str | Path | None = None, length: float | None = None) -> Figure:
    """Figure of a `MultiSetupFit`: frequencies and damping ratios of each setup, merged shapes.

    Bars are 95 % intervals, grey boxes those of the merged modes. It is saved if a path is given;
    `length` (m) is that of the beam.
    """
    figure = Figure(figsize=(9, 7.5))
    axes = figure.subplot_mosaic([["left", "right"], ["shapes"] * 2], height_ratios=(1, 1.3))
    left, right = axes["left"], axes["right"]
    _draw(left, fit, _deviation_of_frequency)
    _draw(right, fit, _damping_in_percent)
    left.set_ylabel("frequency over the mean - 1 (%)")
    right.set_ylabel("damping ratio (%)")
    right.set_ylim(bottom=0.0)
    left.legend(frameon=False, fontsize=7, title="setup", title_fontsize=7, ncols=2)
    draw_shapes(axes["shapes"], fit, length)
    figure.suptitle(f"modes of {len(fit.setups)} setups")
    if path is not None:
        with whole_file(path, overwrite=True) as beside:
            figure.savefig(beside)
    return figure


def _deviation_of_frequency(mode, mean: float):
    """Frequency of a mode beside the mean, and half of its interval, in %."""
    return 100 * (mode.frequency / mean - 1), 100 * mode.quantile * mode.frequency_sd / mean


def _damping_in_percent(mode, _: float):
    """Damping ratio of a mode and half of its interval, in %."""
    return 100 * mode.damping_ratio, 100 * mode.quantile * mode.damping_sd


def _draw(axes, fit, value_of) -> None:
    """Values of each setup, mode by mode, over those merged with their intervals."""
    count, means = len(fit.setups), fit.frequencies
    step = WIDTH / max(count, 1)
    for place, (merged, mean) in enumerate(zip(fit.modes, means, strict=True)):
        middle, half = value_of(merged, mean)
        axes.fill_between(
            [place - WIDTH / 2, place + WIDTH / 2], middle - half, middle + half, color=GREY,
            alpha=0.3, linewidth=0,
        )  # fmt: skip
    for k, setup in enumerate(fit.setups):
        rows = [
            (place + (k - (count - 1) / 2) * step, *value_of(setup.modes[pairs[k]], mean))
            for place, (pairs, mean) in enumerate(zip(fit.pairs, means, strict=True))
            if k in pairs
        ]
        x, y, half = np.array(rows, float).reshape(-1, 3).T
        axes.errorbar(
            x, y, half, color=colour(k), fmt="o", markersize=3, linewidth=1.0, capsize=2,
            label=f"{k + 1}",
        )  # fmt: skip
    labels = [f"{frequency:.1f}" for frequency in fit.frequencies]
    axes.set_xticks(range(len(labels)), labels, rotation=90 if len(labels) > 6 else 0, fontsize=7)
    axes.set_xlabel("mode (Hz)")
