// Files, pictures and a report of the run, and the same run in Python and on the command line.

import { alone, ask, download } from "./api.js";
import { html } from "./dom.js";

const FILES = {
  csv: "Table of histories (CSV)", xlsx: "Table of histories (Excel)", nc: "Whole record (netCDF)", toml: "Case file (TOML)",
  png: "Picture (PNG)", svg: "Picture (SVG)", gif: "Animation (GIF)", html: "Report to print (HTML)",
};

// What needs packages that a page without a server does not load.
const BEYOND = ["xlsx", "nc", "gif"];

/** @param {import("./store.js").Store} store */
export function createTake(store) {
  const files = html("div.buttons", {}, ...Object.entries(FILES).filter(([what]) => !alone || !BEYOND.includes(what)).map(([what, words]) => html("button", { type: "button", "data-what": what, onclick: () => take(what) }, words)));
  const python = html("pre.code", { tabindex: 0, "aria-label": "Python" });
  const command = html("pre.code", { tabindex: 0, "aria-label": "command line" });
  const element = html("div.take", {}, html("h3", {}, "Files of this run"), files, ...code("Python", python), ...code("Command line", command));

  /** @param {string} what */
  function take(what) {
    store.say(`${FILES[/** @type {keyof typeof FILES} */ (what)]}: being made`);
    return store.attempt(async () => store.say(`${await download({ text: store.text, what })} is in the downloads`));
  }

  /** @param {string} title @param {any} area */
  function code(title, area) {
    const copy = html("button", { type: "button", "aria-label": `copy ${title}`, onclick: async () => {
      await navigator.clipboard.writeText(area.textContent);
      store.say(`${title}: copied`);
    } }, "Copy");
    return [html("h3", {}, title, copy), area];
  }

  async function show() {
    await store.attempt(async () => {
      const found = await ask("words", { text: store.text, name: store.name });
      python.textContent = found.python;
      command.textContent = found.command;
    });
  }
  let shown = false;
  store.on("model", () => shown && store.model.problem === null && show());
  return { element, show: () => ((shown = true), show()), hide: () => (shown = false) };
}
