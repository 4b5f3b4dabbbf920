"""Figure of identified modes: log and windows, spectrum with stabilisation diagram, fit, shapes."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.plot.style import COLOURS, GREY, INK, use_style
from jaxbeam.runtime.whole_file import whole_file
from tuning.modal.shape_plot import draw_shapes

FIT, MODE = COLOURS[:2]
NAME_WIDTH = 0.08  # of a mode in the spectrum, over that of the axes
MAX_POINTS = 4000  # of the log; a longer one is drawn as the range of each of so many pieces


@use_style
def plot_modal_fit(fit, path: str | Path | None = None, length: float | None = None) -> Figure:
    """Figure of a `ModalFit`, for the channel with most energy; saved if a path is given.

    Shapes are drawn if there are several channels, over their positions if the log has them, on a
    beam of some `length` (m).
    """
    decays = fit.fitted is not None
    shapes = len(fit.log.names) > 1 and bool(fit.modes)
    heights = (1, 1.6) + (1.3, 0.6) * decays + (1.4,) * shapes
    figure = Figure(figsize=(9, 2.3 * sum(heights)))
    rows = figure.subplots(len(heights), 1, height_ratios=heights)
    strongest = int(np.argmax(np.sum(fit.measured**2, axis=0)))
    quantity = QUANTITIES.get(fit.log.quantities[strongest])
    unit = fit.log.units[strongest] if quantity is None else quantity.unit
    _draw_log(rows[0], fit, strongest, unit)
    _draw_spectrum(rows[1], fit, strongest, unit)
    if decays:
        _draw_fit(rows[2], rows[3], fit, strongest, unit)
    if shapes:
        draw_shapes(rows[-1], fit, length)
    figure.suptitle(f"{Path(fit.log.source).name}: modes from {_kind_text(fit)}")
    if path is not None:
        with whole_file(path, overwrite=True) as beside:
            figure.savefig(beside)
    return figure


def _kind_text(fit) -> str:
    kinds = {"free decay": "a free decay", "measured force": "responses to a measured force"}
    return kinds.get(fit.kind, "ambient vibration")


def _draw_log(axes, fit, channel, unit):
    """The whole log of one channel, with the window."""
    times, values = fit.log.times, fit.log.values[:, channel]
    size = max(times.size // MAX_POINTS, 1)
    pieces = values[: times.size // size * size].reshape(-1, size)
    axes.fill_between(
        times[::size][: len(pieces)], pieces.min(axis=1), pieces.max(axis=1),
        color=GREY, linewidth=0.6, edgecolor=GREY,
    )  # fmt: skip
    for window in fit.windows:
        axes.axvspan(*window, color=FIT, alpha=0.15, linewidth=0)
    axes.text(
        fit.window[0], 0.97, f" {fit.window[0]:.2f} to {fit.window[1]:.2f} s", color=FIT,
        transform=axes.get_xaxis_transform(), va="top",
    )  # fmt: skip
    axes.set(xlabel="time (s)", ylabel=f"{fit.log.names[channel]} ({unit})")
    axes.set_xlim(times[0], times[-1])


def _draw_spectrum(axes, fit, channel, unit):
    """Amplitude spectrum of the window, with the modes."""
    inside = slice(*np.searchsorted(fit.log.times, [fit.window[0], fit.window[1]]))
    values = fit.log.values[inside, channel]
    window = np.hanning(values.size)
    amplitude = np.abs(np.fft.rfft((values - values.mean()) * window)) * 2 / window.sum()
    bins = np.fft.rfftfreq(values.size, np.ptp(fit.log.times[inside]) / (values.size - 1))
    keep = (bins >= fit.band[0]) & (bins <= fit.band[1])
    axes.semilogy(bins[keep], amplitude[keep], color=INK, linewidth=0.9)
    for mode, reason in fit.rejected:
        if reason and fit.band[0] <= mode.frequency <= fit.band[1]:
            axes.axvline(mode.frequency, color=GREY, linewidth=0.7, linestyle=":")
    for mode in fit.modes:
        axes.axvline(mode.frequency, color=MODE, linewidth=1.0)
    axes.set(xlabel="frequency (Hz)", ylabel=f"amplitude ({unit})", xlim=fit.band)
    for line in fit.lines:
        axes.axvline(line.frequency, color=GREY, linewidth=1.2, linestyle="--")
    above = axes
    if fit.diagrams:
        above = axes.twinx()
        _draw_diagram(above, fit)
    if fit.singular_values:
        above = axes.twinx()
        _draw_singular_values(above, fit)
    _name_modes(above, fit)


def _name_modes(axes, fit):
    """Frequency and damping ratio beside the line of each mode, on top of all else.

    Each is in the highest row that has room for it.
    """
    low, high = fit.band
    width = NAME_WIDTH * (high - low)
    ends: list[float] = []  # of the names in each row
    for mode in fit.modes:
        at_end = mode.frequency + width > high
        begins = mode.frequency - width if at_end else mode.frequency
        row = next((i for i, end in enumerate(ends) if end <= begins), len(ends))
        ends[row : row + 1] = [begins + width]
        axes.annotate(
            f"{mode.frequency:.2f} Hz\n{100 * mode.damping_ratio:.2f} %", (mode.frequency, 1.0),
            xycoords=axes.get_xaxis_transform(), xytext=(-3 if at_end else 3, -2 - 24 * row),
            textcoords="offset points", va="top", ha="right" if at_end else "left",
            fontsize=8, color=MODE,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.5},
        )  # fmt: skip


def _draw_diagram(axes, fit):
    """Poles of the models of each order: stable ones filled, those of noise small."""
    for diagram in fit.diagrams:
        poles, stable = diagram.poles, diagram.stable
        shown = (poles.damping_ratios > 0) & (poles.damping_ratios < 0.2)
        noise, modes = shown & ~stable, shown & stable
        axes.plot(poles.frequencies[noise], poles.orders[noise], ".", color=GREY, markersize=1.5)
        axes.plot(poles.frequencies[modes], poles.orders[modes], "o", color=FIT, markersize=2.5)
    axes.set(ylabel="order of the model", xlim=fit.band)
    axes.grid(False)


def _draw_singular_values(axes, fit):
    """Singular values of the cross-spectral matrix, the largest in colour, over the largest."""
    highest = max(part.values[:, 0].max() for part in fit.singular_values)
    for part in fit.singular_values:
        levels = 10 * np.log10(np.maximum(part.values / highest, 1e-12))
        axes.plot(part.frequencies, levels[:, 1:], color=GREY, linewidth=0.6)
        axes.plot(part.frequencies, levels[:, 0], color=FIT, linewidth=1.2)
    axes.set(ylabel="singular values (dB)", xlim=fit.band)
    axes.grid(False)


def _draw_fit(axes, residual_axes, fit, channel, unit):
    """Measured and fitted decay in the band, and the residual on the same scale."""
    measured, fitted = fit.measured[:, channel], fit.fitted[:, channel]
    axes.plot(fit.times, measured, color=GREY, linewidth=2.2, label="measured, in the band")
    axes.plot(fit.times, fitted, color=FIT, linewidth=0.9, label="fitted modes")
    axes.legend(frameon=False, loc="upper right", ncols=2)
    residual_axes.plot(fit.times, measured - fitted, color=INK, linewidth=0.8)
    residual_share = np.sum((measured - fitted) ** 2) / max(np.sum(measured**2), 1e-300)
    residual_axes.text(
        0.995, 0.97, f"residual, {100 * residual_share:.2g} % of the energy", color=INK, va="top",
        ha="right", transform=residual_axes.transAxes,
    )  # fmt: skip
    residual_axes.set_ylim(np.array(axes.get_ylim()) / 2)
    axes.set(ylabel=f"{fit.log.names[channel]} ({unit})", xlim=fit.windows[0])
    residual_axes.set(xlabel="time (s)", ylabel="residual", xlim=fit.windows[0])
