"""Mode shapes on the beam with the sensor places, and their MAC matrix."""

import numpy as np

from jaxbeam.plot.style import COLOURS, GREY, INK, colour
from tuning.modal.result import ModalEstimates

LONG = 60  # letters of all names of channels, above which they stand upright
LINES = ("-", "--", ":")  # of modes whose colours are the same


def draw_shapes(axes, fit: ModalEstimates, length: float | None = None) -> None:
    """Draw mode shapes over the positions of the sensors (m), and their MAC matrix.

    Without positions they are drawn over the channels. Bars are 95 % intervals of real parts;
    hollow markers are imaginary parts, which vanish for a shape without complexity. `length` is
    that of the beam (m).
    """
    axes.set_axis_off()
    left, right = axes.inset_axes([0.0, 0.1, 0.66, 0.78]), axes.inset_axes([0.76, 0.1, 0.24, 0.78])
    known = all(position is not None for position in fit.channels.positions)
    count = len(fit.channels.names)
    places = np.array(fit.channels.positions, float) if known else np.arange(count, dtype=float)
    along = np.argsort(places)
    for k, mode in enumerate(fit.modes):
        order = along[np.isfinite(mode.shape[along])]
        tint, line = colour(k), LINES[k // len(COLOURS) % len(LINES)]
        deviation = np.sqrt(np.maximum(np.diag(mode.shape_covariance)[:count], 0.0))
        left.errorbar(
            places[order], mode.shape.real[order], mode.quantile * deviation[order], color=tint,
            marker="o", markersize=4, linewidth=1.0, linestyle=line, capsize=2,
            label=f"{mode.frequency:.2f} Hz",
        )  # fmt: skip
        left.plot(
            places[order], mode.shape.imag[order], "o", color=tint, markersize=4, fillstyle="none"
        )
    left.axhline(0.0, color=GREY, linewidth=0.8)
    left.set_ylabel("mode shape")
    if known:
        left.set_xlabel("position (m)")
        if length is not None:
            left.set_xlim(0.0, length)
            left.plot([0.0, length], [0.0, 0.0], color=INK, linewidth=2.5)
    else:
        names = fit.channels.names
        left.set_xticks(places, names, rotation=90 if sum(map(len, names)) > LONG else 0)
    left.legend(
        frameon=False, fontsize=7, ncols=6, loc="lower left", bbox_to_anchor=(-0.02, 1.0),
        handletextpad=0.4, columnspacing=1.2,
    )  # fmt: skip
    right.imshow(fit.mac, cmap="Blues", vmin=0.0, vmax=1.0)
    right.grid(False)
    ticks = np.arange(len(fit.modes))
    labels = [f"{mode.frequency:.1f}" for mode in fit.modes]
    right.set_xticks(ticks, labels, rotation=90, fontsize=7)
    right.set_yticks(ticks, labels, fontsize=7)
    right.set_title("MAC", fontsize=9)
