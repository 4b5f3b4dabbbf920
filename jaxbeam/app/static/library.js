// What to open: files of the folder, starters, published rigs.

import { ask } from "./api.js";
import { html } from "./dom.js";

/** @param {import("./store.js").Store} store */
export function createLibrary(store) {
  const dialog = /** @type {HTMLDialogElement} */ (document.getElementById("library"));

  /** @param {() => Promise<void>} work */
  async function choose(work) {
    if (store.unsaved && store.canUndo && !confirm("The changes are not saved. Open another case all the same?")) return;
    dialog.close();
    await store.attempt(work);
  }

  /** @param {string} name */
  const file = (name) => choose(async () => {
    const found = await ask("open", { name });
    await store.open(found.text, found.name, found.mark);
  });

  /** @param {string} name */
  const start = (name) => choose(async () => store.open((await ask("library", { name })).text));

  async function show() {
    const hello = await store.attempt(() => ask("hello"));
    if (!hello) return;
    const cards = (/** @type {any[]} */ all, /** @type {(name: string) => void} */ open) => html("div.cards", {}, ...all.map((one) => html("button.card", { type: "button", onclick: () => open(one.name) }, html("strong", {}, one.title), html("small", {}, one.name))));
    const groups = [...new Set(hello.library.map((/** @type {any} */ one) => one.group))];
    dialog.replaceChildren(
      html("header", {}, html("h2", { id: "library-title" }, "Open a case"), html("button.icon", { type: "button", "aria-label": "close", onclick: () => dialog.close() }, "×")),
      ...(hello.files.length ? [html("h3", {}, `Files in ${hello.folder}`), cards(hello.files.map((/** @type {string} */ name) => ({ name, title: name.replace(/\.toml$/, "") })), file)] : []),
      ...groups.flatMap((group) => [html("h3", {}, String(group)), cards(hello.library.filter((/** @type {any} */ one) => one.group === group), start)]),
    );
    dialog.showModal();
  }

  return { show };
}
