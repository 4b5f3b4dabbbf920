"""Figures of identified modes, of measured frequency responses, and of modes of several setups.

The interactive stabilisation diagram is a page in one file, in which modes are chosen by clicks. It
asks nothing of any server: what is chosen stands below it as the command that keeps these modes.
"""

import shlex
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.files.report import page_of, plain_numbers
from jaxbeam.plot.style import COLOURS, GREY, INK, colour, use_style
from jaxbeam.runtime.output_file import whole_file
from tuning.modal.result import ModalEstimates
from tuning.modal.subspace import possible

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
    strongest = strongest_channel(fit)
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
        with whole_file(path, overwrite=True) as partial:
            figure.savefig(partial)
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


def amplitude_spectrum(
    fit, channel: int
) -> tuple[Float[np.ndarray, " line"], Float[np.ndarray, " line"]]:
    """Frequencies (Hz) in the band of a `ModalFit`, and amplitudes of a channel in its window."""
    inside = slice(*np.searchsorted(fit.log.times, [fit.window[0], fit.window[1]]))
    values = fit.log.values[inside, channel]
    window = np.hanning(values.size)
    amplitude = np.abs(np.fft.rfft((values - values.mean()) * window)) * 2 / window.sum()
    bins = np.fft.rfftfreq(values.size, np.ptp(fit.log.times[inside]) / (values.size - 1))
    keep = (bins >= fit.band[0]) & (bins <= fit.band[1])
    return bins[keep], amplitude[keep]


def strongest_channel(fit) -> int:
    """Channel of a `ModalFit` with most energy."""
    return int(np.argmax(np.sum(fit.measured**2, axis=0)))


def _draw_spectrum(axes, fit, channel, unit):
    """Amplitude spectrum of the window, with the modes."""
    axes.semilogy(*amplitude_spectrum(fit, channel), color=INK, linewidth=0.9)
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
    _name_modes(above, fit)


def _name_modes(axes, fit):
    """Write frequency and damping ratio next to the line of each mode, on top of all else.

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


@use_style
def plot_responses(responses, path: str | Path | None = None) -> Figure:
    """Magnitude, phase and coherence of `MeasuredResponses` over frequency (Hz).

    A colour stands for each output, with a line for each force. Saved if a path is given.
    """
    figure = Figure(figsize=(9, 7))
    size, phase, coherence = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
    frequencies = responses.frequencies
    for i, (name, unit) in enumerate(zip(responses.outputs, responses.units, strict=True)):
        for j, force in enumerate(responses.forces):
            values = responses.values[:, i, j]
            size.semilogy(
                frequencies, np.abs(values), color=f"C{i % 10}", linewidth=0.9,
                linestyle=("-", "--", ":", "-.")[j % 4], label=f"{name} ({unit}) / {force} (N)",
            )  # fmt: skip
            phase.plot(
                frequencies, np.degrees(np.angle(values)), ".", color=f"C{i % 10}", markersize=1.5
            )
        coherence.plot(frequencies, responses.coherence[:, i], color=f"C{i % 10}", linewidth=0.9)
    size.set(ylabel="magnitude")
    if len(responses.outputs) * len(responses.forces) <= 10:
        size.legend(frameon=False, fontsize=8, ncols=2)
    phase.set(ylabel="phase (deg)", ylim=(-190, 190), yticks=(-180, 0, 180))
    coherence.set(ylabel="coherence", ylim=(0, 1.05), xlabel="frequency (Hz)")
    if np.all(np.isnan(responses.coherence)):
        coherence.text(
            0.5, 0.5, "one average: no coherence", transform=coherence.transAxes, ha="center"
        )
    coherence.set_xlim(frequencies[0], frequencies[-1])
    figure.suptitle(
        f"{Path(responses.source).name}: {responses.estimator} of {responses.averages} averages"
    )
    if path is not None:
        with whole_file(path, overwrite=True) as partial:
            figure.savefig(partial)
    return figure


WIDTH = 0.7  # of the space of a mode in which the setups stand next to each other


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
        with whole_file(path, overwrite=True) as partial:
            figure.savefig(partial)
    return figure


def _deviation_of_frequency(mode, mean: float):
    """Frequency of a mode relative to the mean, and half of its interval, in %."""
    return 100 * (mode.frequency / mean - 1), 100 * mode.quantile * mode.frequency_sd / mean


def _damping_in_percent(mode, _: float):
    """Damping ratio of a mode and half of its interval, in %."""
    return 100 * mode.damping_ratio, 100 * mode.quantile * mode.damping_sd


def _draw(axes, fit, value_of) -> None:
    """Draw the values of each setup, mode by mode, over the merged ones with their intervals."""
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


SCRIPTS = ("dom.js",)
SHOW = """
const [WIDTH, HEIGHT, LEFT, BOTTOM] = [1000, 460, 46, 40];
const tops = Math.max(...DATA.orders) * 1.04;
let range = DATA.band;
const chosen = new Set(DATA.chosen);
const picture = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, style: "width: 100%", role: "img",
  "aria-label": "stabilisation diagram" });
const rows = html("tbody");
const command = html("output.command", { style: "display: block; font-family: monospace" });
const heads = ["frequency (Hz)", "damping ratio (%)", "order"].map((one) => html("th", {}, one));
document.body.append(picture, command,
  html("table", {}, html("thead", {}, html("tr", {}, ...heads)), rows));
const across = (f) => LEFT + ((f - range[0]) / (range[1] - range[0])) * (WIDTH - LEFT - 10);
const up = (share) => (HEIGHT - BOTTOM) * (1 - share) + 6 * share;
const seen = (f) => f >= range[0] && f <= range[1];
const name = (i) => `${DATA.frequencies[i]} Hz, ${DATA.damping[i]} %, order ${DATA.orders[i]}`;
function pole(i) {
  const own = { cx: across(DATA.frequencies[i]), cy: up(DATA.orders[i] / tops) };
  const tint = chosen.has(i) ? "#d55e00" : DATA.stable[i] ? "#0072b2" : "#aaaaaa";
  const dot = svg("circle", { ...own, r: chosen.has(i) ? 7 : DATA.stable[i] ? 4 : 2, fill: tint,
    style: "cursor: pointer", "data-pole": i, onclick: () => toggle(i) });
  dot.append(svg("title", {}, name(i)));
  return dot;
}
function toggle(i) {
  if (!chosen.delete(i)) chosen.add(i);
  draw();
}
function draw() {
  const label = (x, y, text) => svg("text", { x, y, "font-size": 13, fill: "#555555",
    "text-anchor": "middle" }, text);
  const marks = Array.from({ length: 9 }, (_, k) => range[0] + (k / 8) * (range[1] - range[0]));
  const points = DATA.spectrum.x.map((f, k) => [f, DATA.spectrum.y[k]]).filter(([f]) => seen(f));
  const line = points.map(([f, y]) => `${across(f).toFixed(1)},${up(y).toFixed(1)}`).join(" ");
  picture.replaceChildren(
    svg("polyline", { points: line, fill: "none", stroke: "#bbbbbb" }),
    ...marks.map((f) => label(across(f), HEIGHT - 20, f.toPrecision(4))),
    label(WIDTH / 2, HEIGHT - 4, "frequency (Hz)"),
    label(16, 16, "order"),
    ...DATA.orders.map((_, i) => i).filter((i) => seen(DATA.frequencies[i])).map(pole));
  const all = [...chosen].sort((i, j) => DATA.frequencies[i] - DATA.frequencies[j]);
  rows.replaceChildren(...all.map((i) => html("tr", {},
    ...[DATA.frequencies[i], DATA.damping[i], DATA.orders[i]].map((one) =>
      html("td", {}, String(one))))));
  const words = all.map((i) => DATA.frequencies[i]).join(",");
  command.textContent = all.length ? `${DATA.command} --choose ${words}` : "click on a pole";
}
picture.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = picture.getBoundingClientRect();
  const share = ((event.clientX - box.left) / box.width * WIDTH - LEFT) / (WIDTH - LEFT - 10);
  const [middle, zoom] = [range[0] + share * (range[1] - range[0]), event.deltaY < 0 ? 0.8 : 1.25];
  range = [Math.max(DATA.band[0], middle + (range[0] - middle) * zoom),
    Math.min(DATA.band[1], middle + (range[1] - middle) * zoom)];
  draw();
}, { passive: false });
picture.addEventListener("dblclick", () => { range = DATA.band; draw(); });
draw();
"""


def diagram_page(fit) -> str:
    """Page of the stabilisation diagram of a `ModalFit`, whose modes are chosen at first.

    Raises ValueError for a fit without a diagram, as of free decays.
    """
    if not fit.diagrams:
        raise ValueError(
            f"{fit.log.source}: poles of {fit.kind} by method {fit.method} have no stabilisation"
            " diagram; choose --method covariance"
        )
    found = [
        (p.orders[k], p.frequencies[k], 100 * p.damping_ratios[k], d.stable[k])
        for d in fit.diagrams
        for p, k in [(d.poles, possible(d.poles, fit.band))]
    ]
    orders, frequencies, damping, stable = (
        np.concatenate([part[i] for part in found]) for i in range(4)
    )
    near = [
        int(np.argmin(np.where(stable, np.abs(frequencies - one), np.inf)))
        for one in fit.frequencies
    ]
    x, amplitude = amplitude_spectrum(fit, strongest_channel(fit))
    logs = np.log(np.maximum(amplitude, 1e-6 * amplitude.max()))
    band = ":".join(f"{one:.6g}" for one in fit.band)
    data = {
        "band": [float(one) for one in fit.band],
        "orders": orders.tolist(),
        "frequencies": plain_numbers(frequencies),
        "damping": [float(f"{one:.3g}") for one in damping],
        "stable": stable.tolist(),
        "chosen": near,
        "spectrum": {
            "x": plain_numbers(x),
            "y": plain_numbers((logs - logs.min()) / max(float(np.ptp(logs)), 1e-300)),
        },
        "command": f"jaxbeam modes-from-log {shlex.quote(fit.log.source)} --band {band}",
    }
    sentence = (
        "Click on a pole to choose its mode, or to leave it out; the wheel zooms, a double click"
        " shows all. The command below keeps what is chosen."
    )
    return page_of(f"{fit.log.source}: stabilisation diagram", sentence, SCRIPTS, data, SHOW)
