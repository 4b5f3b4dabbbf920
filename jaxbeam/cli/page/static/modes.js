// Modes of the logs that were dropped: a stabilisation diagram to click in, and shapes that move.

import { html, number, raised, svg } from "./dom.js";
import { createJob } from "./job.js";
import { ticks } from "./plot.js";

const [WIDTH, HEIGHT, LEFT, BELOW] = [760, 260, 44, 24];
const NEAR = 0.02; // relative distance of a click to a mode that it means
const PERIOD = 2000; // ms of a cycle of a shape, whatever its frequency

/**
 * @param {import("./store.js").Store} store
 * @param {Set<string>} names of the logs
 */
export function createModes(store, names) {
  const found = html("div.modes");
  /** @type {number[]} */ let chosen = [];
  let moving = 0;

  const job = createJob(store, "Find modes", async () => {
    if (names.size) return { name: "modes", question: { logs: [...names], choose: chosen } };
    store.say("drop a log first: modes are found in it", true);
    return null;
  }, (state) => {
    if (state.result) show(state.result);
    return 0;
  });

  /** Keep a mode, or leave it out, and ask again. @param {any} result @param {number} frequency */
  function choose(result, frequency) {
    const kept = chosen.length ? chosen : result.modes.map((/** @type {any} */ mode) => mode.frequency_hz);
    const others = kept.filter((/** @type {number} */ one) => Math.abs(one / frequency - 1) > NEAR);
    chosen = others.length < kept.length ? others : [...kept, frequency].sort((a, b) => a - b);
    job.run();
  }

  /** @param {any} result */
  function show(result) {
    const rows = [...result.modes, ...result.rejected].sort((a, b) => a.frequency_hz - b.frequency_hz).map((mode) => {
      const kept = mode.reason === undefined;
      const box = html("input", { type: "checkbox", checked: kept, "aria-label": `keep ${number(mode.frequency_hz)} Hz`, onchange: () => choose(result, mode.frequency_hz) });
      const half = (/** @type {number[]} */ pair, /** @type {number} */ factor) => number((factor * (pair[1] - pair[0])) / 2, 2);
      return html("tr", {}, html("td", {}, box), html("td.number", {}, `${number(mode.frequency_hz, 5)} ± ${half(mode.frequency_95_hz, 1)}`), html("td.number", {}, `${number(100 * mode.damping_ratio, 3)} ± ${half(mode.damping_95, 100)}`), html("td.number", {}, number(100 * mode.energy_share, 3)), html("td", {}, mode.reason ?? ""));
    });
    const all = html("button", { type: "button", hidden: !chosen.length, onclick: () => {
      chosen = [];
      job.run();
    } }, "Choose automatically");
    const heads = ["keep", "frequency (Hz)", "damping (%)", "energy (%)", "why not"].map((words) => html("th", { scope: "col" }, words));
    found.replaceChildren(
      html("h3", { "aria-level": 2 }, `Modes, from ${number(result.window[0])} to ${number(result.window[1])} s`, all),
      diagram(result, (frequency) => choose(result, frequency)),
      html("table.data", {}, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows)),
      ...shapes(result), html("details", {}, html("summary", {}, "What was chosen, and how to choose otherwise"), html("pre.code", {}, result.summary)));
  }

  /** Shapes side by side, swinging slowly. @param {any} result */
  function shapes(result) {
    const { names: labels, positions } = result.channels;
    const known = positions.every((/** @type {number | null} */ one) => one !== null);
    const places = known ? positions : labels.map((/** @type {string} */ _, /** @type {number} */ i) => i);
    const order = labels.length > 1 ? [...places.keys()].sort((a, b) => places[a] - places[b]) : [];
    if (!order.length) return [];
    const [low, high] = [places[order[0]], places[order[order.length - 1]]];
    const at = (/** @type {number} */ i) => 10 + (160 * (places[i] - low)) / (high - low || 1);
    const lines = result.modes.map((/** @type {any} */ mode) => ({ mode, line: svg("polyline", { class: "shape" }) }));
    const swing = (/** @type {number} */ phase) => lines.forEach((/** @type {any} */ { mode, line }) => {
      const height = (/** @type {number} */ i) => (mode.shape_real[i] ?? 0) * Math.cos(phase) - (mode.shape_imag[i] ?? 0) * Math.sin(phase);
      line.setAttribute("points", order.map((i) => `${at(i)},${40 - 30 * height(i)}`).join(" "));
    });
    swing(0);
    const mine = ++moving;
    const step = (/** @type {number} */ now) => {
      if (mine !== moving || !found.isConnected) return;
      if (found.offsetParent) swing((2 * Math.PI * now) / PERIOD);
      requestAnimationFrame(step);
    };
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) requestAnimationFrame(step);
    const title = known ? "over the positions of the sensors" : `over the channels ${order.map((i) => labels[i]).join(", ")}`;
    return [html("h3", { "aria-level": 2 }, "Shapes ", html("small", {}, title)), html("div.shapes", {}, ...lines.map((/** @type {any} */ { mode, line }) => {
      const level = svg("line", { x1: 10, x2: 170, y1: 40, y2: 40, class: "level" });
      const words = `${number(mode.frequency_hz)} Hz`;
      return html("figure", {}, svg("svg", { viewBox: "0 0 180 80", role: "img", "aria-label": `shape at ${words}` }, level, line), html("figcaption", {}, words));
    }))];
  }

  const element = html("div", {}, job.element, found);
  return { element };
}

/**
 * Stable poles by the order of the model, the spectrum, and the modes that are kept.
 * @param {any} result
 * @param {(frequency: number) => void} clicked
 */
function diagram(result, clicked) {
  const { band: [low, high], poles, spectrum, modes } = result;
  const x = (/** @type {number} */ f) => LEFT + ((WIDTH - LEFT - 8) * (f - low)) / (high - low);
  const most = Math.max(2, ...poles.map((/** @type {any} */ one) => one.order));
  const y = (/** @type {number} */ order) => HEIGHT - BELOW - ((HEIGHT - BELOW - 10) * order) / most;
  const logs = spectrum.amplitudes.map((/** @type {number} */ one) => Math.log10(Math.max(one, 1e-300)));
  const [least, largest] = [Math.min(...logs), Math.max(...logs)];
  const level = (/** @type {number} */ one) => HEIGHT - BELOW - ((HEIGHT - BELOW - 10) * (one - least)) / (largest - least || 1);
  const points = logs.map((/** @type {number} */ one, /** @type {number} */ i) => `${x(spectrum.frequencies[i])},${level(one)}`).join(" ");
  const scale = ticks(low, high, 8).map((f) => svg("text", { x: x(f), y: HEIGHT - 6, "text-anchor": "middle" }, number(f)));
  const orders = ticks(0, most, 4).map((one) => svg("text", { x: LEFT - 6, y: y(one) + 4, "text-anchor": "end" }, number(one)));
  const picture = svg("svg", { class: "diagram", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `stabilisation diagram, spectrum of ${spectrum.channel} (${raised(spectrum.unit)}); the table below has the same choice` },
    svg("polyline", { points, class: "spectrum" }), ...scale, ...orders,
    ...poles.map((/** @type {any} */ one) => svg("circle", { cx: x(one.frequency), cy: y(one.order), r: 2.4, class: "pole" })),
    ...modes.map((/** @type {any} */ mode) => svg("line", { x1: x(mode.frequency_hz), x2: x(mode.frequency_hz), y1: 6, y2: HEIGHT - BELOW, class: "mode" })));
  picture.addEventListener("click", (/** @type {MouseEvent} */ event) => {
    const box = picture.getBoundingClientRect();
    const frequency = low + ((high - low) * (((event.clientX - box.left) * WIDTH) / box.width - LEFT)) / (WIDTH - LEFT - 8);
    const all = [...poles.map((/** @type {any} */ one) => one.frequency), ...modes.map((/** @type {any} */ one) => one.frequency_hz)];
    const nearest = all.reduce((best, one) => (Math.abs(one - frequency) < Math.abs(best - frequency) ? one : best), Infinity);
    if (Math.abs(x(nearest) - x(frequency)) < 12) clicked(nearest);
  });
  return html("figure.plot", {}, html("figcaption", {}, html("strong", {}, "Stabilisation diagram"), html("span.legend", {}, html("span", {}, `spectrum of ${spectrum.channel}`), html("span", {}, "frequency (Hz), order of the model; a click on poles keeps their mode or leaves it out"))), picture);
}
