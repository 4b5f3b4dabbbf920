// Elements in one expression; text is always text, never markup.

/** @typedef {Record<string, any>} Attributes */

const SVG = "http://www.w3.org/2000/svg";

/**
 * Set attributes; `on...` are listeners, properties that are no text are set as such.
 * @param {Element} element
 * @param {Attributes} attributes
 */
export function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === false || value === null || value === undefined) element.removeAttribute(name);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
}

/**
 * @param {string} tag as "div" or "button.primary"
 * @param {Attributes} [attributes]
 * @param {...(Node | string)} children
 * @returns {any}
 */
export function html(tag, attributes = {}, ...children) {
  const [name, ...classes] = tag.split(".");
  const element = document.createElement(name);
  if (classes.length) element.className = classes.join(" ");
  set(element, attributes);
  element.append(...children);
  return element;
}

/**
 * @param {string} tag
 * @param {Attributes} [attributes]
 * @param {...(Node | string)} children
 * @returns {any}
 */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  set(element, attributes);
  element.append(...children);
  return element;
}

let pressed = false;
/** @type {Set<() => void>} */ const waiting = new Set();

/** @param {MouseEvent} event */
function press(event) {
  pressed = event.type === "pointerdown" && event.button === 0;
  if (!pressed) setTimeout(() => { // after the click
    for (const work of pressed ? [] : waiting) waiting.delete(work) && work();
  });
}
for (const kind of /** @type {const} */ (["pointerdown", "pointerup", "pointercancel", "contextmenu"])) globalThis.addEventListener?.(kind, press, true);

/**
 * Work that waits while a button is pressed: what is drawn anew between a press and its release
 * loses the click.
 * @param {() => void} work
 */
export const released = (work) => () => pressed ? void waiting.add(work) : work();

/**
 * Tabs and their panels; only the chosen one is shown.
 * @param {string} label
 * @param {Record<string, HTMLElement>} panels by their titles
 * @param {(title: string) => void} [chosen]
 */
export function tabs(label, panels, chosen = () => {}) {
  const list = html("div.tabs", { role: "tablist", "aria-label": label });
  const titles = Object.keys(panels);
  /** @type {HTMLElement[]} */
  const buttons = titles.map((title) => {
    const id = title.toLowerCase().replace(/\W+/g, "-");
    set(panels[title], { role: "tabpanel", id: `panel-${id}`, "aria-labelledby": `tab-${id}` });
    const attributes = { role: "tab", id: `tab-${id}`, type: "button", "aria-controls": `panel-${id}` };
    return html("button", { ...attributes, onclick: () => choose(title) }, title);
  });
  list.append(...buttons);
  list.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const at = buttons.indexOf(/** @type {HTMLElement} */ (document.activeElement));
    const next = (at + step + titles.length) % titles.length;
    choose(titles[next]);
    buttons[next].focus();
  });
  /** @param {string} title */
  function choose(title) {
    titles.forEach((one, i) => {
      set(buttons[i], { "aria-selected": String(one === title), tabindex: one === title ? 0 : -1 });
      panels[one].hidden = one !== title;
    });
    chosen(title);
  }
  choose(titles[0]);
  return { list, choose };
}

const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"]];

/**
 * Factor and unit in which numbers of some size read well, as kN for 3000 N.
 * @param {number} largest
 * @param {string} unit
 * @returns {[number, string]}
 */
export function scaled(largest, unit) {
  if (!/^(m|Pa|V|N|N m|N m\^2|N\/m)$/.test(unit) || !(largest > 0)) return [1, unit === "1" ? "" : raised(unit)];
  for (const [factor, prefix] of /** @type {[number, string][]} */ (PREFIXES)) {
    if (unit === "m" && factor > 1) continue;
    if (largest >= factor * 0.9999) return [factor, prefix + raised(unit)];
  }
  return [1e-6, "µ" + raised(unit)];
}

/** A unit with raised powers. @param {string} unit */
export const raised = (unit) => unit.replace(/\^(\d)/g, (_, power) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[power]);

/**
 * A number to some digits, without an exponent where it is short.
 * @param {number} value
 * @param {number} [digits]
 */
export function number(value, digits = 4) {
  if (!Number.isFinite(value)) return "–";
  const text = Number(value.toPrecision(digits));
  return (Math.abs(text) >= 1e6 || (text !== 0 && Math.abs(text) < 1e-4))
    ? text.toExponential().replace("-", "−").replace("e+", "e")
    : String(text).replace("-", "−");
}
