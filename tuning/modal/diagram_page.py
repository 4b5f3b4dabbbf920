"""Interactive stabilisation diagram: a page in one file, in which modes are chosen by clicks.

It asks nothing of any server: what is chosen stands below it as the command that keeps these modes.
"""

import shlex

import numpy as np

from jaxbeam.files.interactive import page_of, plain_numbers
from tuning.modal.plot import amplitude_spectrum, strongest_channel
from tuning.modal.stabilisation import possible

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
