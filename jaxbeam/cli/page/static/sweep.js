// A map of peaks over one or two addresses, which fills while it is computed; a cell opens its run.

import { html, number, raised, scaled } from "./dom.js";
import { addressChoice, createJob, labelled } from "./job.js";
import { Plot } from "./plot.js";
import { rangeAbout } from "./sliders.js";

// A scale of colour that rises evenly in lightness, from dark blue to yellow (as cividis does).
const SCALE = [[0, 34, 78], [53, 69, 108], [102, 105, 112], [148, 142, 119], [200, 182, 105], [254, 232, 56]];

/** Colour of a share from 0 to 1. @param {number} share */
export function heat(share) {
  const at = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1);
  const i = Math.min(Math.floor(at), SCALE.length - 2);
  return `rgb(${SCALE[i].map((one, k) => Math.round(one + (at - i) * (SCALE[i + 1][k] - one))).join(" ")})`;
}

/** @param {import("./store.js").Store} store */
export function createSweep(store) {
  const axes = [axis(store, "Over", 24), axis(store, "and over", 12)];
  const what = html("select");
  const limit = html("input", { inputmode: "decimal", placeholder: "none", size: 8, autocomplete: "off" });
  const map = html("div.map");
  const legend = html("p.caption-line");
  const plot = new Plot({ title: "Peaks", unit: "", axis: "", seek: (x) => open(x) });
  plot.element.hidden = true;
  const words = html("pre.code", { tabindex: 0, "aria-label": "the sweep in Python and on the command line", hidden: true });
  /** @type {any} */ let sweep = null;
  /** @type {Record<string, number[]>[]} */ let rows = [];

  const job = createJob(store, "Sweep", async () => {
    const chosen = axes.filter((one) => one.address() !== "").map((one) => one.question());
    if (!chosen.length) {
      store.say("choose an address to sweep over", true);
      return null;
    }
    rows = [];
    return { name: "sweep", question: { text: store.text, axes: chosen } };
  }, (state) => {
    sweep = state.seen;
    rows.push(...sweep.found);
    words.textContent = `${sweep.words.python}\n\n# ${sweep.words.command}`;
    words.hidden = false;
    fillChoice();
    if (sweep.found.length || state.done) draw();
    return rows.length;
  });
  what.addEventListener("change", draw);
  limit.addEventListener("change", draw);
  const shown = html("div.form", { hidden: true }, labelled("Show", what), labelled("Limit", limit));
  const element = html("div.sweep", {}, html("div.form", {}, ...axes.map((one) => one.element), job.element), shown, legend, map, plot.element, words);

  function fillChoice() {
    const heads = Object.keys(rows[0] ?? {}).filter((head) => head !== "failed");
    shown.hidden = heads.length === 0;
    if (heads.length && what.childElementCount !== heads.length) what.replaceChildren(...heads.map((head) => html("option", {}, head)));
  }

  function draw() {
    if (!rows.length) return map.replaceChildren();
    const head = what.value;
    const [, name, unit] = /^(.*?)(?: \(([^()]*)\))?$/.exec(head) ?? ["", head, ""];
    const all = rows.flatMap((row) => row[head] ?? []).filter(Number.isFinite);
    const [low, high] = [Math.min(...all), Math.max(...all)];
    const [factor, shown] = scaled(Math.max(Math.abs(low), Math.abs(high)), unit ?? "");
    const most = limit.value.trim() === "" ? NaN : Number(limit.value.replace(",", ".")) * factor;
    const isWord = typeof sweep.values[sweep.rows]?.[0] === "string";
    const asLines = sweep.columns !== "" && (sweep.rows === "" || (isWord && rows.length <= 6));
    plot.element.hidden = !asLines;
    map.hidden = asLines;
    const limits = `${number(low / factor)} to ${number(high / factor)} ${shown}`;
    legend.textContent = `${name}: ${limits}${Number.isFinite(most) ? `; limit ${number(most / factor)} ${shown}` : ""}. ${asLines ? "A click" : "A cell"} opens its run.`;
    if (asLines) {
      Object.assign(plot.options, { unit: unit ?? "", axis: `${sweep.columns.split(".").pop()} (${raised(sweep.units[sweep.columns])})` });
      const series = rows.map((row, i) => ({ name: sweep.rows ? sweep.values[sweep.rows][i] : name, tint: i, y: row[head] }));
      plot.show({ x: sweep.values[sweep.columns], series, limits: Number.isFinite(most) ? [{ y: most, tint: 1, name: "limit" }] : [] });
    } else map.replaceChildren(table(head, low, high, most, factor, shown));
  }

  /** @param {string} head @param {number} low @param {number} high @param {number} most @param {number} factor @param {string} unit */
  function table(head, low, high, most, factor, unit) {
    const across = sweep.columns ? sweep.values[sweep.columns] : [null];
    const down = sweep.rows ? sweep.values[sweep.rows] : [null];
    const title = (/** @type {any} */ value, /** @type {string} */ address) => (typeof value === "string" ? value : `${number(value, 3)} ${raised(sweep.units[address] === "1" ? "" : sweep.units[address])}`);
    const cells = down.map((/** @type {any} */ row, /** @type {number} */ i) => html("tr", {}, html("th", { scope: "row" }, row === null ? "" : title(row, sweep.rows)), ...across.map((/** @type {any} */ column, /** @type {number} */ j) => {
      const value = rows[i]?.[head]?.[j];
      const known = value !== undefined;
      const failed = known && rows[i].failed?.[j] === 1;
      const where = [column === null ? "" : title(column, sweep.columns), row === null ? "" : title(row, sweep.rows)].filter(Boolean).join(", ");
      const words = !known ? "not yet" : failed ? "failed" : `${number(value / factor)} ${unit}`;
      const button = html("button.cell", { type: "button", disabled: !known, title: `${where}: ${words}`, "aria-label": `${where}: ${words}`, tabindex: i || j ? -1 : 0, "data-row": i, "data-column": j, onclick: () => choose(i, j) });
      if (known && !failed) button.style.background = heat((value - low) / (high - low || 1));
      if (known && value > most) button.classList.add("beyond");
      return html("td", {}, button);
    })));
    const head_ = html("tr", {}, html("th", {}, ""), ...across.map((/** @type {any} */ value, /** @type {number} */ j) => html("th", { scope: "col" }, across.length <= 12 || j % Math.ceil(across.length / 12) === 0 ? (value === null ? "" : title(value, sweep.columns)) : "")));
    const found = html("table", { "aria-label": head }, html("thead", {}, head_), html("tbody", {}, ...cells));
    found.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[event.key];
      const at = /** @type {HTMLElement} */ (event.target).dataset;
      if (!step || at.row === undefined) return;
      event.preventDefault();
      found.querySelector(`[data-row="${Number(at.row) + step[0]}"][data-column="${Number(at.column) + step[1]}"]`)?.focus();
    });
    return found;
  }

  /** Open the run of a cell. @param {number} i @param {number} j */
  function choose(i, j) {
    const changes = [];
    if (sweep.columns) changes.push({ set: sweep.columns, to: sweep.values[sweep.columns][j] });
    if (sweep.rows) changes.push({ set: sweep.rows, to: sweep.values[sweep.rows][i] });
    store.change(...changes.map((one) => ({ ...one, to: typeof one.to === "number" ? Number(one.to.toPrecision(8)) : one.to })));
  }

  /** Open the run at a value of the axis of lines. @param {number} x */
  function open(x) {
    const values = sweep.values[sweep.columns];
    const j = values.reduce((/** @type {number} */ best, /** @type {number} */ one, /** @type {number} */ k) => (Math.abs(one - x) < Math.abs(values[best] - x) ? k : best), 0);
    store.change({ set: sweep.columns, to: Number(values[j].toPrecision(8)) });
  }

  return { element };
}

/** @param {import("./store.js").Store} store @param {string} words @param {number} count */
function axis(store, words, count) {
  const choice = addressChoice(store, words, ["loads.0.train", "loads.0.model"]);
  const [from, to] = ["from", "to"].map(() => html("input", { size: 8, autocomplete: "off" }));
  const many = html("input", { value: count, size: 3, inputmode: "numeric", autocomplete: "off" });
  const list = html("input", { size: 30, placeholder: "HSLM-A1, HSLM-A2", autocomplete: "off" });
  const range = html("span.form", {}, labelled("from", from), labelled("to", to), labelled("values", many));
  const listed = labelled("words, separated by commas", list);
  listed.hidden = true;
  range.hidden = true;
  choice.select.addEventListener("change", () => {
    const own = store.model.numbers[choice.select.value];
    range.hidden = !own;
    listed.hidden = own !== undefined || choice.select.value === "";
    if (!own) return;
    const [low, high] = rangeAbout(own.value);
    const unit = /^(m|m\/s|kg|N|N m\^2|s)$/.test(own.unit) ? ` ${own.unit}` : "";
    [from.value, to.value] = [`${Number(low.toPrecision(4))}${unit}`, `${Number(high.toPrecision(4))}${unit}`];
  });
  return {
    element: html("div.form", {}, choice.element, range, listed),
    address: () => choice.select.value,
    question: () => (range.hidden ? { address: choice.select.value, words: list.value } : { address: choice.select.value, from: from.value, to: to.value, count: Number(many.value) }),
  };
}
