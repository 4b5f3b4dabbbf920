// Fields of all tables of a case, made from the JSON Schema of case files: nothing is typed again.

import { html, number, raised, released } from "./dom.js";

/** @typedef {Record<string, any>} Schema */

// What a new entry has at first where its key has no default: a share of the length, or a number.
const FIRST = {
  position: (/** @type {number} */ length) => length / 2,
  start: (/** @type {number} */ length) => 0.4 * length,
  end: (/** @type {number} */ length) => 0.6 * length,
  speed: (/** @type {number} */ length) => Number(length.toPrecision(2)),
  length: (/** @type {number} */ length) => length / 2,
};

/**
 * Schema of a table of some kind.
 * @param {Schema} root @param {Schema} schema @param {any} content
 * @returns {Schema}
 */
export function tableSchema(root, schema, content) {
  if (!schema.allOf || !schema.properties?.kind?.enum) return schema;
  const choice = schema.allOf.find((/** @type {any} */ one) => one.if?.properties.kind.const === content?.kind);
  return choice ? root.$defs[choice.then.$ref.split("/").pop()] : schema;
}

/**
 * Content of a new entry: what its schema needs.
 * @param {Schema} root @param {Schema} schema @param {string} kind @param {number} length of the beam
 * @param {Record<string, string[]>} names of the library by key
 */
export function newEntry(root, schema, kind, length, names = {}) {
  const table = tableSchema(root, schema, { kind });
  /** @type {Record<string, any>} */
  const content = kind ? { kind } : {};
  const needed = new Set(table.required ?? []);
  if (table.properties?.speed) needed.add("speed");
  if (kind === "vehicle") needed.add("model");
  if (kind === "axles") needed.add("train");
  for (const key of needed) {
    if (key === "kind") continue;
    const own = table.properties[key] ?? {};
    if (names[key]?.length) content[key] = names[key][0];
    else if (own.enum) content[key] = own.enum[0];
    else if (key in FIRST) content[key] = FIRST[/** @type {keyof typeof FIRST} */ (key)](length);
    else content[key] = own.type === "array" || own.anyOf ? [1.0] : own.type === "integer" ? 1 : own.type === "string" ? "" : 1.0;
  }
  return content;
}

/**
 * A value as it is typed: a number, a text with a unit, a list; null for nothing.
 * @param {string} text @param {Schema} schema
 */
export function parsed(text, schema) {
  const trimmed = text.trim();
  if (trimmed === "") return null;
  const isText = schema.type === "string" || schema.enum;
  if (!isText && /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(trimmed)) return Number(trimmed);
  if (!isText && trimmed.startsWith("[")) {
    try {
      return JSON.parse(trimmed);
    } catch {
      return trimmed;
    }
  }
  return trimmed;
}

/** @param {any} value */
const shown = (value) => (value === undefined ? "" : typeof value === "object" ? JSON.stringify(value).replaceAll(",", ", ") : String(value));

/** @param {string} key */
const spaced = (key) => key.replaceAll("_", " ").replace(/^./, (one) => one.toUpperCase()).replace("Youngs", "Young's");

/**
 * @param {import("./store.js").Store} store
 * @param {{names: Record<string, string[]>, slide: (address: string) => void}} context
 */
export function createFields(store, context) {
  const element = html("div.fields");
  const open = new Set(["beam", "loads.0"]);

  store.on("model", released(build));
  store.on("schema", released(build));

  function build() {
    const { schema, model } = store;
    if (schema === null || (Object.keys(model.tables).length === 0 && element.childElementCount)) return;
    const active = /** @type {HTMLInputElement | null} */ (element.contains(document.activeElement) ? document.activeElement : null);
    const place = active?.dataset.address;
    const typed = active?.matches("input") && active.value !== active.getAttribute("value") ? active.value : null;
    const selected = active?.matches("input") ? /** @type {const} */ ([active.selectionStart, active.selectionEnd]) : null;
    for (const details of element.querySelectorAll("details")) details.open ? open.add(details.dataset.opens) : open.delete(details.dataset.opens);
    element.replaceChildren(
      titleField(),
      ...Object.entries(schema.properties).filter(([key]) => key !== "title").map(([key, own]) => group(key, /** @type {Schema} */ (own))),
    );
    const again = place ? /** @type {HTMLInputElement | null} */ (element.querySelector(`[data-address="${place}"]`)) : null;
    if (again && typed !== null) again.value = typed; // what is being typed stays
    again?.focus();
    if (again && selected) again.setSelectionRange(...selected);
  }

  function titleField() {
    return field("title", store.schema.properties.title, store.model.tables.title);
  }

  /** A table of the case, or a list of them. @param {string} key @param {Schema} schema */
  function group(key, schema) {
    const content = store.model.tables[key];
    const listed = schema.type === "array";
    const own = listed ? schema.items : schema;
    const count = listed ? (content?.length ?? 0) : 0;
    const body = html("div");
    if (listed) content?.forEach((/** @type {any} */ entry, /** @type {number} */ i) => body.append(section(`${key}.${i}`, own, entry, `${spaced(key.replace(/s$/, ""))} ${i}${entry.name ? ` – ${entry.name}` : entry.kind ? ` – ${entry.kind}` : ""}`, true)));
    else if (content) body.append(...table(key, own, content));
    if (listed || !content) body.append(adder(key, own, listed ? `${key}.${count}` : key));
    else if (key !== "beam" && key !== "run") body.append(html("button.quiet", { type: "button", onclick: () => store.change({ remove: key }) }, `Remove the ${key}`));
    return disclosure(key, html("span", {}, spaced(key), html("small", {}, listed ? ` ${count || ""}` : content ? "" : " none")), body);
  }

  /** @param {string} address @param {Node} title @param {Node} body */
  function disclosure(address, title, body) {
    const { problem } = store.model;
    const wrong = problem?.address === address || (problem?.address?.startsWith(`${address}.`) ?? false);
    return html("details", { open: open.has(address) || wrong, "data-opens": address }, html("summary", {}, title),
      ...(problem?.address === address ? [html("p.wrong", {}, problem.message)] : []), body);
  }

  /** @param {string} address @param {Schema} schema @param {any} content @param {string} title @param {boolean} removable */
  function section(address, schema, content, title, removable) {
    const body = html("div", {}, ...table(address, schema, content));
    if (removable) body.append(html("button.quiet", { type: "button", onclick: () => store.change({ remove: address }) }, "Remove"));
    return disclosure(address, html("span", {}, title), body);
  }

  /** Button that adds an entry, of a kind if there are kinds. @param {string} key @param {Schema} schema @param {string} address */
  function adder(key, schema, address) {
    const kinds = schema.properties?.kind?.enum;
    const choose = kinds && html("select", { "aria-label": `kind of the new entry of ${key}` }, ...kinds.map((/** @type {string} */ kind) => html("option", { selected: kind === "mass" || kind === "point" || kind === "feedback" }, kind)));
    const add = () => {
      const entry = newEntry(store.schema, schema, choose?.value ?? "", store.scene?.length ?? 1, context.names);
      open.add(key).add(address);
      store.change({ set: address, to: entry });
    };
    return html("div.adder", {}, html("button", { type: "button", onclick: add }, `Add ${spaced(key.replace(/s$/, "")).toLowerCase()}`), ...(choose ? [choose] : []));
  }

  /** Fields of a table: those that it has or needs, then the others. @param {string} address @param {Schema} schema @param {any} content @returns {Node[]} */
  function table(address, schema, content) {
    const own = tableSchema(store.schema, schema, content);
    const kinds = schema.properties?.kind?.enum;
    const entries = Object.entries(own.properties ?? {}).filter(([key]) => key !== "kind");
    const first = entries.filter(([key]) => key in content || own.required?.includes(key));
    const others = entries.filter((entry) => !first.includes(entry));
    const make = (/** @type {[string, any]} */ [key, one]) => part(`${address}.${key}`, one, content[key]);
    /** @type {Node[]} */
    const found = kinds ? [kindField(address, schema, content)] : [];
    if (own.description) found.unshift(html("p.about", {}, own.description.replaceAll("\n", " ")));
    found.push(...first.map(make));
    if (others.length) {
      const wrong = others.some(([key]) => store.model.problem?.address === `${address}.${key}`);
      found.push(html("details.more", { open: wrong || open.has(`${address}/more`), "data-opens": `${address}/more` }, html("summary", {}, `${others.length} more`), ...others.map(make)));
    }
    return found;
  }

  /** A number, a word, or a table within a table. @param {string} address @param {Schema} schema @param {any} value @returns {Node} */
  function part(address, schema, value) {
    const key = address.split(".").pop() ?? "";
    if (schema.type === "array" && schema.items?.type === "object") {
      const body = html("div");
      value?.forEach((/** @type {any} */ entry, /** @type {number} */ i) => body.append(section(`${address}.${i}`, schema.items, entry, `${i}${entry.name ? ` – ${entry.name}` : ""}`, true)));
      body.append(adder(key, schema.items, `${address}.${value?.length ?? 0}`));
      return disclosure(address, html("span", {}, spaced(key), html("small", {}, ` ${value?.length || ""}`)), body);
    }
    if (schema.type === "object") {
      const body = value ? html("div", {}, ...table(address, schema, value)) : html("div", {}, adder(key, schema, address));
      if (value) body.append(html("button.quiet", { type: "button", onclick: () => store.change({ remove: address }) }, "Remove"));
      return disclosure(address, html("span", {}, spaced(key), html("small", {}, value ? "" : " none")), body);
    }
    return field(address, schema, value);
  }

  /** @param {string} address @param {Schema} schema @param {any} content */
  function kindField(address, schema, content) {
    const kinds = schema.properties.kind.enum;
    const select = html("select", { id: `field-${address}.kind`, "data-address": `${address}.kind` }, ...kinds.map((/** @type {string} */ kind) => html("option", { selected: kind === content.kind }, kind)));
    select.addEventListener("change", () => {
      const entry = newEntry(store.schema, schema, select.value, store.scene?.length ?? 1, context.names);
      const known = tableSchema(store.schema, schema, entry).properties ?? {};
      for (const [key, value] of Object.entries(content)) if (key !== "kind" && key in known) entry[key] = value;
      store.change({ set: address, to: entry });
    });
    return html("div.field", {}, html("label", { for: select.id }, "Kind"), select);
  }

  /** @param {string} address @param {Schema} schema @param {any} value */
  function field(address, schema, value) {
    const key = address.split(".").pop() ?? "";
    const id = `field-${address}`;
    const unit = schema["x-unit"] ?? "";
    const problem = store.model.problem?.address === address ? store.model.problem : null;
    const common = { id, "data-address": address, "aria-describedby": `${id}-help`, "aria-invalid": problem ? "true" : null };
    const places = Array.isArray(schema.default) ? "" : shown(schema.default);
    const input = schema.enum
      ? html("select", common, html("option", { value: "" }, places ? `${places} (default)` : "–"), ...schema.enum.map((/** @type {string} */ word) => html("option", { selected: word === value }, word)))
      : html("input", { ...common, value: shown(value), placeholder: places, list: context.names[key] ? `names-${key}` : null, autocomplete: "off", spellcheck: "false" });
    let asked = value ?? null;
    const commit = () => { // Enter may be followed by a change of the same
      const typed = parsed(input.value, schema);
      if (JSON.stringify(typed) === JSON.stringify(asked)) return;
      asked = typed;
      store.change(typed === null ? { remove: address } : { set: address, to: typed });
    };
    input.addEventListener("change", commit);
    input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Enter" && commit());
    const slides = store.model.numbers?.[address];
    const pin = slides && html("button.pin", { type: "button", title: "move it by a slider", "aria-label": `slider for ${spaced(key)}`, onclick: () => context.slide(address) }, "⇿");
    const bounds = boundsOf(schema);
    const help = `${schema.description ?? ""}${bounds ? `; ${bounds}` : ""}`.replace(` (${unit})`, "");
    return html("div.field", {},
      html("label", { for: id, title: help }, spaced(key)),
      html("span.entry", {}, input, ...(unit ? [html("span.unit", { title: unit }, raised(unit))] : []), ...(pin ? [pin] : [])),
      html("small.help", { id: `${id}-help` }, help),
      ...(problem ? [html("p.wrong", {}, problem.message)] : []));
  }

  return { element };
}

/** Bounds of a number in words. @param {Schema} schema */
export function boundsOf(schema) {
  const one = schema.anyOf?.[0] ?? schema;
  const found = [];
  if (one.exclusiveMinimum !== undefined) found.push(`above ${number(one.exclusiveMinimum)}`);
  if (one.minimum !== undefined) found.push(`${number(one.minimum)} or more`);
  if (one.exclusiveMaximum !== undefined) found.push(`below ${number(one.exclusiveMaximum)}`);
  if (one.maximum !== undefined) found.push(`at most ${number(one.maximum)}`);
  return found.join(", ");
}
