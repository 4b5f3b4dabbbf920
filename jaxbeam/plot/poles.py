"""Poles of the closed loop along a crossing."""

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.analysis.stability import FrozenPoles, Growth
from jaxbeam.plot.style import ALARM, GREY, INK, colour, name, styled

SHOWN = 3.0  # times as far left as the fastest pole is high: faster decay is left out


@styled
def plot_poles(found: FrozenPoles, growth: Growth | None = None, title: str = "") -> Figure:
    """Branches of the frozen poles in the complex plane, and their largest real part over time.

    A dot marks where each branch starts, shading where the frozen loop is unstable. With `growth`,
    how much deviations have grown by each time is drawn below.
    """
    rows = 2 if growth is None else 3
    figure = Figure(figsize=(8.0, 4.6))
    plane, *right = figure.subplot_mosaic([["plane", str(i)] for i in range(rows - 1)]).values()
    poles = found.poles
    high = np.abs(poles.imag).max() or np.abs(poles.real).max()
    for i, branch in enumerate(poles.T):
        if branch.imag.max() < -1e-9 * high or branch.real.max() < -SHOWN * high:
            continue
        plane.plot(branch.real, branch.imag, color=colour(i))
        plane.plot(branch.real[0], branch.imag[0], "o", color=colour(i), markersize=4)
    plane.axvline(0, color=INK, linewidth=0.8)
    plane.axvspan(0, max(plane.get_xlim()[1], 0.02 * high), color=ALARM, alpha=0.08, linewidth=0)
    plane.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)", title="frozen poles")
    top = right[0]
    top.plot(found.times, found.largest, color=INK)
    top.axhline(0, color=ALARM, linewidth=0.8)
    top.fill_between(
        found.times, 0, np.maximum(found.largest, 0), color=ALARM, alpha=0.2, linewidth=0
    )
    top.set(title="largest real part (1/s)", xlim=(found.times[0], found.times[-1]))
    if growth is not None:
        below = right[1]
        top.tick_params(labelbottom=False)
        below.semilogy(growth.times, np.maximum(growth.factor, 1e-4), color=colour(0))
        below.axhline(1, color=GREY, linewidth=0.8, linestyle=":")
        below.set(title="growth of deviations since the start", xlim=top.get_xlim())
    right[-1].set_xlabel("time (s)")
    name(figure, title)
    return figure
