"""Figures of the uncertainty of fitted parameters: profiles and posterior."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.plot.style import COLOURS, FAINT, INK, use_style
from tuning.fit.uncertainty.posterior import Posterior
from tuning.fit.uncertainty.profile import Profile

PANELS_PER_ROW = 3


@use_style
def plot_profiles(profiles: Sequence[Profile]) -> Figure:
    """Figure of the deviance of each parameter, with its critical value and the interval."""
    figure, panels = _panels(len(profiles))
    for axes, found in zip(panels, profiles, strict=False):
        axes.plot(found.values, found.deviance, "o-", color=INK, markersize=3, linewidth=1)
        axes.axhline(found.critical_deviance, color=COLOURS[1], linewidth=1)
        for end in found.interval:
            if np.isfinite(end):
                axes.axvline(end, color=COLOURS[1], linewidth=0.8, linestyle=":")
        if np.all(np.isfinite(found.linear_interval)):
            axes.axvspan(*found.linear_interval, color=FAINT, alpha=0.6, linewidth=0)
        axes.set(
            title=found.address,
            ylabel="rise of $-2\\,\\ln L$",
            ylim=(0, 2 * found.critical_deviance),
        )
        axes.set_xlabel("" if found.unit == "1" else found.unit)
    return figure


@use_style
def plot_posterior(posterior: Posterior) -> Figure:
    """Figure of histograms of the draws of each parameter, a line for each chain, and intervals."""
    figure, panels = _panels(len(posterior.addresses))
    for i, axes in enumerate(panels):
        draws = posterior.draws[..., i]
        bin_edges = np.linspace(draws.min(), draws.max(), 31)
        for j, chain in enumerate(draws):
            axes.hist(
                chain, bin_edges, histtype="step", density=True, color=COLOURS[j % len(COLOURS)]
            )
        axes.axvspan(*posterior.intervals[i], color=FAINT, alpha=0.6, linewidth=0)
        axes.set(title=posterior.addresses[i], yticks=[])
    return figure


def _panels(count: int):
    """A figure with so many panels, and its axes."""
    rows = -(-count // PANELS_PER_ROW)
    figure = Figure(figsize=(3.2 * min(count, PANELS_PER_ROW), 2.4 * rows))
    grid = figure.subplots(rows, min(count, PANELS_PER_ROW), squeeze=False).ravel()
    for axes in grid[count:]:
        axes.axis("off")
    return figure, grid[:count]
