// Controllers side by side with the least achievable peak; and numbers of one, tuned by gradient steps.

import { ask } from "./api.js";
import { html, number, scaled } from "./dom.js";
import { addressChoice, createJob, freeChoice, labelled } from "./job.js";
import { Plot } from "./plot.js";

/** @param {import("./store.js").Store} store */
export function createControl(store) {
  const files = html("div.chips");
  const table = html("div");
  const deflections = new Plot({ title: "Deflection", unit: "m" });
  const commands = new Plot({ title: "Command", unit: "" });
  const pair = html("div.plots", { hidden: true }, deflections.element, commands.element);
  const compare = createJob(store, "Compare", async () => {
    const names = [...files.querySelectorAll("input:checked")].map((one) => /** @type {HTMLInputElement} */ (one).value);
    return { name: "compare", question: { text: store.text, names } };
  }, (state) => {
    if (state.result) comparison(state.result);
    return 0;
  });

  /** @param {any} found */
  function comparison(found) {
    const [factor, unit] = scaled(found.uncontrolled, "m");
    const share = (/** @type {number} */ value) => `${number(100 * value, 3)} %`;
    const rows = [
      ["without control", found.uncontrolled, null], ...found.rows.map((/** @type {any} */ one) => [one.name, one.peak, one]), ...(found.bound === null ? [] : [["least achievable", found.bound, null]]),
    ].map(([name, peak, one]) => html("tr", {}, html("td", {}, name), html("td.number", {}, `${number(peak / factor)} ${unit}`),
      html("td", {}, ...(one && one.share !== null ? [html("meter", { min: 0, max: 1, value: Math.max(0, one.share), "aria-label": "share of the attainable" }), ` ${share(one.share)}`] : [])),
      html("td.number", {}, one ? share(one.saturated) : ""), html("td", {}, one?.remarks ?? "")));
    table.replaceChildren(html("p", {}, found.headline), html("table.data", {}, html("thead", {}, html("tr", {}, ...["controller", "peak", "of the attainable", "at a limit", "remarks"].map((words) => html("th", {}, words)))), html("tbody", {}, ...rows)));
    pair.hidden = false;
    const runs = Object.entries(found.runs);
    const x = /** @type {any} */ (runs[0][1]).times;
    deflections.show({ x, series: runs.map(([name, run], i) => ({ name, tint: i, y: /** @type {any} */ (run).deflection })) });
    commands.options.unit = found.unit;
    const driven = runs.map(([name, run], i) => ({ name, tint: i, y: /** @type {any} */ (run).command[0], steps: true })).filter((one) => one.name !== "without" && one.y);
    commands.show({ x, series: driven });
  }

  const free = freeChoice(store, "Tune");
  const vary = addressChoice(store, "for runs that differ in");
  const spread = html("input", { value: 20, size: 3, inputmode: "decimal", autocomplete: "off" });
  const steps = html("input", { value: 30, size: 3, inputmode: "numeric", autocomplete: "off" });
  const verdict = html("div");
  const history = new Plot({ title: "Objective by step", unit: "", axis: "step" });
  history.element.hidden = true;
  const tune = createJob(store, "Tune", async () => {
    if (!free.free.size || !vary.select.value) {
      store.say("choose numbers to tune, and one in which the runs differ", true);
      return null;
    }
    return { name: "tune", question: { text: store.text, free: Object.fromEntries([...free.free].map((one) => [one, null])), vary: vary.select.value, spread: Number(spread.value) / 100, steps: Number(steps.value) } };
  }, (state) => {
    const { result, seen } = state;
    const last = result ?? seen;
    if (!last.history) return 0;
    const keep = html("button", { type: "button", onclick: () => store.change(...Object.entries(last.settings).map(([address, to]) => ({ set: address, to: Number(/** @type {number} */ (to).toPrecision(6)) }))) }, "Put it into the case");
    const words = Object.entries(last.settings).map(([address, value]) => `${address} = ${number(/** @type {number} */ (value), 5)}`).join(", ");
    verdict.replaceChildren(html("h3", {}, words, keep), html("p", {}, result ? result.verdict : `after step ${last.history.length}`));
    history.element.hidden = false;
    const objective = last.history.map((/** @type {number | null} */ one) => one ?? NaN);
    history.show({ zero: false, x: objective.map((/** @type {number} */ _, /** @type {number} */ i) => i), series: [{ name: "objective", tint: 0, y: objective }] });
    return 0;
  });

  async function show() {
    await store.attempt(async () => {
      const { names } = await ask("controllers");
      files.replaceChildren(...names.filter((/** @type {string} */ name) => name !== store.name).map((/** @type {string} */ name) => html("label.chip", {}, html("input", { type: "checkbox", value: name, checked: true }), name)));
    });
  }

  const element = html("div.control", {},
    html("h3", {}, "Compare this controller with those of the folder"), html("div.form", {}, files, compare.element), table, pair,
    html("h3", {}, "Tune by gradient steps"), html("div.form", {}, free.element, free.chips, vary.element, labelled("by ± %", spread), labelled("steps", steps), tune.element), verdict, html("div.plots", {}, history.element));
  return { element, show };
}
