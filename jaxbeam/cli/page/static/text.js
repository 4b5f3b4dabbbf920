// The text of the case beside its fields: whatever is typed is read a moment later.

import { html } from "./dom.js";

/** @param {import("./store.js").Store} store */
export function createText(store) {
  const lines = html("pre.lines", { "aria-hidden": "true" });
  const area = html("textarea", { spellcheck: "false", autocomplete: "off", wrap: "off", "aria-label": "case file, TOML", "aria-describedby": "text-problem" });
  const problem = html("p.wrong", { id: "text-problem" });
  const element = html("div.text", {}, html("div.editor", {}, lines, area), problem);
  let timer = 0;

  area.addEventListener("input", () => {
    number();
    clearTimeout(timer);
    timer = setTimeout(() => store.write(area.value), 350);
  });
  area.addEventListener("blur", () => {
    clearTimeout(timer);
    store.write(area.value);
  });
  area.addEventListener("scroll", () => (lines.scrollTop = area.scrollTop));

  store.on("text", () => {
    if (area.value === store.text) return;
    const place = area.scrollTop;
    area.value = store.text;
    area.scrollTop = place;
    number();
  });
  store.on("model", () => {
    const found = store.model.problem;
    problem.textContent = found?.message ?? "";
    area.setAttribute("aria-invalid", String(found !== null));
    number(found?.line ?? null);
  });

  /** Number the lines, and mark one. @param {number | null} [marked] */
  function number(marked = null) {
    const count = area.value.split("\n").length;
    lines.replaceChildren(...Array.from({ length: count }, (_, i) => html(i + 1 === marked ? "b" : "span", {}, `${i + 1}\n`)));
    lines.scrollTop = area.scrollTop;
  }

  return { element };
}
