// The page: bar, model, stage and panels, put together.

import { alone, ask, download } from "./api.js";
import { createControl } from "./control.js";
import { html, tabs } from "./dom.js";
import { createFields } from "./fields.js";
import { createEnvelopes, createHistories } from "./histories.js";
import { createIdentify } from "./identify.js";
import { createLibrary } from "./library.js";
import { createSliders } from "./sliders.js";
import { createStage } from "./stage.js";
import { Store } from "./store.js";
import { createSweep } from "./sweep.js";
import { createTake } from "./take.js";
import { createText } from "./text.js";

const store = new Store();
const place = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));

/** @type {Record<string, string[]>} */ const names = {};
const sliders = createSliders(store);
const stage = createStage(store);
const library = createLibrary(store);
const text = createText(store);
const fields = createFields(store, { names, slide: sliders.slide });

// Model: fields and text, beside each other where there is room.
const wide = matchMedia("(min-width: 1700px)");
const forText = html("div");
const model = tabs("model", { Fields: fields.element, "Case file": forText });
place("model").append(model.list, fields.element, forText);
const placeText = () => {
  (wide.matches ? place("text") : forText).append(text.element);
  if (wide.matches) model.choose("Fields");
  model.list.hidden = wide.matches;
};
wide.addEventListener("change", placeText);
placeText();

place("stage").append(stage.element);
place("sliders").append(sliders.element);

/** @type {Record<string, {element: HTMLElement, show?: () => void, hide?: () => void}>} */
const panels = {
  Histories: createHistories(store),
  Envelopes: createEnvelopes(store),
  // What needs JAX and threads is not there without a server.
  ...(alone ? {} : { Sweep: createSweep(store), Identify: createIdentify(store), Control: createControl(store) }),
  "Take away": createTake(store),
};
const results = tabs("results", Object.fromEntries(Object.entries(panels).map(([title, panel]) => [title, panel.element])), (title) => {
  for (const [one, panel] of Object.entries(panels)) (one === title ? panel.show : panel.hide)?.();
});
place("panels").append(results.list, ...Object.values(panels).map((panel) => panel.element));

// Bar
const button = (/** @type {string} */ words, /** @type {() => void} */ work, /** @type {string} */ keys) => html("button", { type: "button", title: keys, onclick: work }, words);
const title = html("h1");
const file = html("span.file");
const undo = button("Undo", () => store.undo(), "Ctrl+Z");
const redo = button("Redo", () => store.redo(), "Ctrl+Shift+Z");
const theme = html("button", { type: "button", title: "light or dark", "aria-label": "light or dark" }, "◐");
place("bar").append(
  html("img", { src: "static/icon.svg", alt: "", width: 26, height: 26 }), title, file,
  html("nav", { "aria-label": "case" }, button("Open", library.show, "Ctrl+O"), button("Vehicles", library.showVehicles, "vehicles and trains of the library"), button("Save", save, "Ctrl+S"), undo, redo, theme),
);

function save() {
  const name = store.name ?? prompt("Name of the file in the folder", "case.toml");
  if (name) return store.save(name).then(() => (alone && !store.unsaved ? download({ text: store.text, what: "toml" }) : null));
}

theme.addEventListener("click", () => {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const shown = document.documentElement.dataset.theme ?? (dark ? "dark" : "light");
  document.documentElement.dataset.theme = shown === "dark" ? "light" : "dark";
  store.dispatchEvent(new CustomEvent("cursor"));
});

const status = place("status");
let hiding = 0;
store.on("say", ({ message, wrong }) => {
  status.textContent = message;
  status.className = wrong ? "wrong" : "";
  clearTimeout(hiding);
  if (!wrong) hiding = setTimeout(() => (status.textContent = ""), 6000);
});
store.on("busy", (busy) => document.body.classList.toggle("busy", busy));

function bar() {
  title.textContent = store.model.tables.title || "Untitled";
  document.title = `${title.textContent} – jaxbeam`;
  file.textContent = `${store.name ?? "not saved"}${store.unsaved && store.name ? " •" : ""}`;
  [undo.disabled, redo.disabled] = [!store.canUndo, !store.canRedo];
}
let ofModel = "";
results.list.addEventListener("click", () => store.say(ofModel, true)); // no longer what another panel has said
store.on("text", bar);
store.on("model", () => {
  bar();
  const { problem, plausibility } = store.model;
  const message = problem?.message ?? plausibility.warnings[0] ?? "";
  if (message) store.say(message, true);
  else if (status.textContent === ofModel) store.say(""); // what others have said stays
  ofModel = message;
});

addEventListener("keydown", (event) => {
  const typing = /** @type {HTMLElement} */ (event.target).matches("input:not([type=range]), textarea, select");
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if (key === "s") save();
    else if (key === "o") library.show();
    else if (typing) return;
    else if (key === "z") event.shiftKey ? store.redo() : store.undo();
    else if (key === "y") store.redo();
    else return;
    event.preventDefault();
  } else if (key === " " && !typing && /** @type {HTMLElement} */ (event.target).matches("body, canvas, .load")) {
    event.preventDefault();
    stage.toggle();
  }
});
addEventListener("beforeunload", (event) => {
  if (store.unsaved && store.canUndo) event.preventDefault();
});

await store.attempt(async () => {
  const hello = await ask("hello");
  Object.assign(names, hello.names);
  for (const [key, values] of Object.entries(names)) document.body.append(html("datalist", { id: `names-${key}` }, ...values.map((value) => html("option", { value }))));
  if (hello.opened) {
    const found = await ask("open", { name: hello.opened });
    await store.open(found.text, found.name, found.mark);
  } else {
    await store.open((await ask("library", { name: "laboratory-rig" })).text);
    library.show();
  }
  store.schema = await ask("schema");
  store.dispatchEvent(new CustomEvent("schema"));
});
document.body.dataset.ready = "true";
