// What the sensors measure over time, contact forces and commands; and envelopes along the beam.

import { ask, column } from "./api.js";
import { html } from "./dom.js";
import { Plot } from "./plot.js";

/** @param {import("./store.js").Store} store */
export function createHistories(store) {
  const verdict = html("p.verdict");
  const grid = html("div.plots");
  const element = html("div", {}, verdict, grid);
  /** @type {Map<string, Plot>} */ const plots = new Map();

  store.on("run", build);
  store.on("cursor", () => plots.forEach((plot) => plot.setCursor(store.cursor)));
  store.on("opened", () => {
    plots.clear();
    grid.replaceChildren();
  });

  function build() {
    const { run, scene } = store;
    verdict.textContent = run.verdict;
    verdict.classList.toggle("alarm", run.lost.length > 0 || run.diverged !== null);
    const { times, sensors, contact, strokes, commands, saturated } = run.arrays;
    const x = times.data;
    const spans = onBeam(run.crossing, store.duration);
    const events = run.lost.map((/** @type {any} */ one) => ({ x: one.time, name: `contact of load ${run.wheels[one.wheel]} lost` }));
    const quantities = [...new Set(scene.sensors.map((/** @type {any} */ one) => one.quantity))];
    const wanted = [];
    for (const quantity of quantities) {
      const own = scene.sensors.map((/** @type {any} */ one, /** @type {number} */ i) => ({ ...one, i })).filter((/** @type {any} */ one) => one.quantity === quantity);
      const series = own.map((/** @type {any} */ one) => ({ name: one.label, tint: one.i, y: column(sensors, one.i) }));
      const dots = own.flatMap((/** @type {any} */ one) => ["smallest", "largest"].map((side) => ({ x: run.extremes[`${side}_time`][one.i], y: run.extremes[side][one.i], tint: one.i, name: side })));
      wanted.push({ title: own.length === 1 ? `${capital(String(quantity))}, ${own[0].label}` : capital(String(quantity)), unit: own[0].unit, content: { x, series, spans, dots, events } });
    }
    if (contact.shape[1]) {
      const series = run.shownWheels.map((/** @type {number} */ wheel, /** @type {number} */ i) => ({ name: `load ${run.wheels[wheel]}`, tint: i, y: column(contact, i) }));
      const title = run.hiddenWheels ? `Contact force, first ${series.length} of ${series.length + run.hiddenWheels} wheels` : "Contact force";
      wanted.push({ title, unit: "N", content: { x, series, spans, events } });
    }
    if (strokes.shape[1]) {
      const series = Array.from({ length: strokes.shape[1] }, (_, i) => ({ name: `absorber ${i}`, tint: i, y: column(strokes, i) }));
      wanted.push({ title: "Stroke of absorbers", unit: "m", content: { x, series, spans } });
    }
    if (commands.shape[1] && scene.controller !== null) {
      const unit = scene.actuators.find((/** @type {any} */ one) => one.unit !== "1")?.unit ?? "";
      const series = Array.from({ length: commands.shape[1] }, (_, i) => ({ name: `actuator ${i}`, tint: i, y: column(commands, i), steps: true }));
      const limits = run.limits.flatMap((/** @type {number[] | null} */ one, /** @type {number} */ i) => (one ?? []).map((y) => ({ y, tint: i, name: "limit" })));
      wanted.push({ title: "Command", unit, content: { x, series, limits, spans: [...spans, ...atLimit(saturated, x)] } });
    }
    for (const { title, unit, content } of wanted) {
      let plot = plots.get(title);
      if (plot === undefined) {
        plot = new Plot({ title, unit, seek: (at) => store.seek(at), zoomed: (range) => plots.forEach((one) => one.setZoom(range)) });
        plots.set(title, plot);
      }
      plot.show(content);
      plot.setCursor(store.cursor);
    }
    const titles = wanted.map(({ title }) => title);
    for (const title of [...plots.keys()]) if (!titles.includes(title)) plots.delete(title);
    const shown = titles.map((title) => /** @type {Plot} */ (plots.get(title)).element);
    if (shown.length !== grid.childElementCount || shown.some((one, i) => one !== grid.children[i])) grid.replaceChildren(...shown);
  }

  return { element };
}

/** @param {string} text */
const capital = (text) => text.replace(/^./, (one) => one.toUpperCase());

/**
 * Times during which a load is on the beam.
 * @param {[number, number][]} crossing of each wheel @param {number} duration
 */
export function onBeam(crossing, duration) {
  /** @type {{from: number, to: number}[]} */ const found = [];
  for (const [enter, leave] of [...crossing].sort((a, b) => a[0] - b[0])) {
    const [from, to] = [Math.max(0, enter), Math.min(duration, leave)];
    const last = found.at(-1);
    if (!(to > from)) continue;
    if (last && from <= last.to) last.to = Math.max(last.to, to);
    else found.push({ from, to });
  }
  return found;
}

/** Times during which a command is at a limit. @param {any} saturated @param {ArrayLike<number>} x */
function atLimit(saturated, x) {
  const [rows, columns] = saturated.shape;
  /** @type {{from: number, to: number, strong: boolean}[]} */ const found = [];
  for (let i = 0; i < rows; i++) {
    let any = false;
    for (let j = 0; j < columns; j++) any ||= saturated.data[i * columns + j] > 0;
    if (!any) continue;
    const last = found.at(-1);
    if (last && i > 0 && last.to === x[i]) last.to = x[Math.min(i + 1, rows - 1)];
    else found.push({ from: x[i], to: x[Math.min(i + 1, rows - 1)], strong: true });
  }
  return found;
}

/** @param {import("./store.js").Store} store */
export function createEnvelopes(store) {
  const plots = { moment: new Plot({ title: "Bending moment", unit: "N m", axis: "x (m)" }), shear: new Plot({ title: "Shear force", unit: "N", axis: "x (m)" }) };
  const element = html("div", {}, html("div.plots", {}, plots.moment.element, plots.shear.element));
  let known = "";
  let shown = false;
  store.on("run", ({ preview }) => {
    if (!preview && shown) compute();
  });

  async function compute() {
    if (known === store.text || store.run === null) return;
    await store.attempt(async () => {
      const text = store.text;
      const found = await ask("envelopes", { text });
      known = text;
      const places = store.scene.supports.map((/** @type {any} */ one, /** @type {number} */ i) => ({ x: one.position, name: `support ${i}` }));
      for (const [quantity, plot] of Object.entries(plots)) {
        const [x, smallest, largest] = found[quantity];
        plot.show({ x, series: [{ name: "largest", tint: 0, y: largest }, { name: "smallest", tint: 1, y: smallest }], events: places });
      }
    });
  }

  return { element, show: () => (shown = true, compute()), hide: () => (shown = false) };
}
