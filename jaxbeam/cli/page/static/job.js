// Work that takes long: begun, followed, stopped.

import { ask } from "./api.js";
import { html, released } from "./dom.js";

const PAUSE = 200; // ms between questions

/**
 * A button that begins work, a bar of its progress, and a button that stops it.
 * @param {import("./store.js").Store} store
 * @param {string} words of the button
 * @param {() => Promise<{name: string, question: Record<string, any>} | null>} begin what to ask, or nothing
 * @param {(state: any) => number} seen takes each state; returns the number of rows that it knows
 */
export function createJob(store, words, begin, seen) {
  const start = html("button.primary", { type: "button", onclick: run }, words);
  const stop = html("button", { type: "button", hidden: true, onclick: () => number && ask("cancel", { job: number }) }, "Stop");
  const bar = html("progress", { hidden: true, "aria-label": "progress", max: 1 });
  const element = html("div.job", {}, start, stop, bar);
  /** @type {string | null} */ let number = null;

  async function run() {
    const wanted = await begin();
    if (wanted === null) return;
    start.disabled = true;
    stop.hidden = bar.hidden = false;
    bar.removeAttribute("value");
    await store.attempt(async () => {
      number = (await ask(wanted.name, wanted.question)).job;
      let known = 0;
      for (;;) {
        const state = await ask("job", { job: number, known, name: store.name });
        await new Promise((go) => released(() => go(null))());
        known = seen(state);
        const [done, total] = state.progress;
        if (state.seen?.rows !== undefined) bar.value = known / Math.max(1, state.seen.values[state.seen.rows]?.length ?? 1);
        else if (total > 0) bar.value = done / total;
        if (state.done) {
          if (state.problem) store.say(state.problem.message, state.problem.message !== "stopped");
          break;
        }
        await new Promise((go) => setTimeout(go, PAUSE));
      }
    });
    number = null;
    start.disabled = false;
    stop.hidden = bar.hidden = true;
  }

  return { element, run };
}

/**
 * A field with its label above it.
 * @param {string} words @param {any} input
 */
export function labelled(words, input) {
  input.setAttribute("aria-label", words);
  return html("label.labelled", {}, html("span", {}, words), input);
}

/**
 * A choice of the numbers of a case, or of what else has an address.
 * @param {import("./store.js").Store} store @param {string} words @param {string[]} [others]
 */
export function addressChoice(store, words, others = []) {
  const select = html("select");
  const fill = () => {
    if (!store.model.numbers) return;
    const chosen = select.value;
    const own = Object.entries(store.model.numbers).map(([address, one]) => html("option", { value: address }, `${one.words.replace(/^./, (/** @type {string} */ a) => a.toUpperCase())} (${address})`));
    select.replaceChildren(html("option", { value: "" }, "–"), ...others.map((one) => html("option", { value: one }, one)), ...own);
    if ([...select.options].some((one) => one.value === chosen)) select.value = chosen;
  };
  store.on("model", fill);
  fill();
  return { element: labelled(words, select), select };
}

/**
 * A choice of free numbers: each is a chip that a press removes.
 * @param {import("./store.js").Store} store @param {string} words @param {string[]} [others]
 */
export function freeChoice(store, words, others = []) {
  /** @type {Set<string>} */ const free = new Set();
  const choice = addressChoice(store, words, others);
  const chips = html("div.chips", { role: "group", "aria-label": `${words}: chosen` });
  const show = () => chips.replaceChildren(...[...free].map((one) => html("button.chip", { type: "button", "aria-label": `${one}: no longer free`, "data-address": one, onclick: () => {
    free.delete(one);
    show();
  } }, `${one} ×`)));
  const add = (/** @type {string} */ address) => {
    free.add(address);
    show();
  };
  choice.select.addEventListener("change", () => {
    if (choice.select.value) add(choice.select.value);
    choice.select.value = "";
  });
  return { element: choice.element, chips, free, add };
}
