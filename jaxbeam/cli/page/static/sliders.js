// Sliders for numbers of the case. While one moves the run follows; released, it changes the text.

import { html, number, released, scaled } from "./dom.js";

// Numbers that have a slider at first, the first few that a case has.
const USUAL = [/^loads\.0\.speed$/, /^loads\.0\.(mass|force|weight|body_mass)$/, /^controller\.(gains?|[a-z_]*weight)(\.0)?$/, /^beam\.(flexural_rigidity|youngs_modulus)$/, /^beam\.damping_ratio$/];
const STEPS = 200;

/**
 * Range of a slider about a value: half to twice of it, zero to one for nothing.
 * @param {number} value
 * @returns {[number, number]}
 */
export function rangeAbout(value) {
  if (value === 0) return [0, 1];
  return value > 0 ? [value / 2, 2 * value] : [2 * value, value / 2];
}

/** @param {import("./store.js").Store} store */
export function createSliders(store) {
  const element = html("div.sliders", { role: "group", "aria-label": "numbers to move" });
  /** @type {Set<string> | null} */ let chosen = null;
  /** @type {Map<string, {row: any, input: any, output: any, low: number, high: number, unit: string, factor: number}>} */
  const rows = new Map();

  store.on("opened", () => {
    chosen = null;
    rows.clear();
  });
  store.on("model", released(build));

  function build() {
    const { numbers } = store.model;
    if (!numbers) return;
    chosen ??= new Set(USUAL.map((one) => Object.keys(numbers).find((address) => one.test(address))).filter((one) => one !== undefined).slice(0, 4));
    for (const address of rows.keys()) if (!numbers[address] || !chosen.has(address)) rows.delete(address);
    for (const address of chosen) if (numbers[address]) update(address, numbers[address]);
    element.replaceChildren(...[...rows.values()].map(({ row }) => row));
  }

  /** @param {string} address @param {{value: number, unit: string, words: string}} own */
  function update(address, own) {
    const known = rows.get(address);
    if (known && own.value >= known.low && own.value <= known.high) {
      if (document.activeElement !== known.input || Number(known.input.value) !== position(known, own.value)) known.input.value = position(known, own.value);
      return label(known, own.value);
    }
    rows.set(address, make(address, own));
  }

  /** @param {{low: number, high: number}} range @param {number} value */
  const position = (range, value) => Math.round(((value - range.low) / (range.high - range.low)) * STEPS);

  /** @param {any} known @param {number} value */
  function label(known, value) {
    known.output.textContent = `${number(value / known.factor)} ${known.unit}`;
    known.input.setAttribute("aria-valuetext", known.output.textContent);
  }

  /** @param {string} address @param {{value: number, unit: string, words: string}} own */
  function make(address, own) {
    const [low, high] = rangeAbout(own.value);
    const [factor, whole] = scaled(Math.abs(own.value), own.unit);
    const unit = whole.length > 12 ? "" : whole; // that of a gain is a sentence
    const input = html("input", { type: "range", min: 0, max: STEPS, id: `slider-${address}`, "data-address": address });
    const output = html("output", { for: input.id });
    const remove = html("button.icon", { type: "button", "aria-label": `remove the slider of ${own.words}`, onclick: () => {
      chosen?.delete(address);
      build();
    } }, "×");
    const row = html("div.slider", {}, html("label", { for: input.id, title: address }, own.words), output, remove, input);
    const known = { row, input, output, low, high, factor, unit };
    input.value = position(known, own.value);
    const value = () => Number((low + (Number(input.value) / STEPS) * (high - low)).toPrecision(4));
    const question = (/** @type {number} */ at) => store.preview({ [address]: at }, { [address]: [low, high] });
    input.addEventListener("pointerenter", () => store.prepare({ [address]: own.value }, { [address]: [low, high] }));
    input.addEventListener("input", () => {
      label(known, value());
      question(value());
    });
    input.addEventListener("change", () => store.change({ set: address, to: value() }));
    label(known, own.value);
    return known;
  }

  /** Give a number a slider. @param {string} address */
  function slide(address) {
    chosen ??= new Set();
    chosen.add(address);
    build();
    rows.get(address)?.input.focus();
  }

  return { element, slide };
}
