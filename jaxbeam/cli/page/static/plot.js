// A plot of lines over a common axis: zoom, values under the pointer, a cursor, marks of events.
// The canvas is a picture; what the pointer reads is a line of text below it, for everyone.

import { html, number, scaled } from "./dom.js";

/**
 * @typedef {object} Series
 * @property {string} name
 * @property {number} tint number of its colour
 * @property {ArrayLike<number>} y
 * @property {boolean} [steps] whether values hold until the next
 */

/**
 * What is shown: `x` for all series; `spans` shaded parts of the axis, `events` upright lines,
 * `dots` single points and `limits` level lines.
 * @typedef {object} Content
 * @property {ArrayLike<number>} x
 * @property {Series[]} series
 * @property {{from: number, to: number, strong?: boolean}[]} [spans]
 * @property {{x: number, name: string}[]} [events]
 * @property {{x: number, y: number, tint: number, name: string}[]} [dots]
 * @property {{y: number, name: string, tint: number}[]} [limits]
 * @property {boolean} [zero] whether zero is in sight; unless false
 */

const MARGIN = { left: 58, right: 14, top: 8, bottom: 22 };

/** Round steps for about so many ticks. @param {number} low @param {number} high @param {number} count */
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  if (!(raw > 0) || !Number.isFinite(raw)) return [];
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = ([1, 2, 5].find((one) => one * power >= raw) ?? 10) * power;
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step + 0); // no minus zero
  return found;
}

/** Index of the last entry that is not above a value. @param {ArrayLike<number>} x @param {number} value */
export function indexAt(x, value) {
  let [low, high] = [0, x.length - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (x[middle] <= value) low = middle;
    else high = middle - 1;
  }
  return low;
}

export class Plot {
  /** @type {Content} */ #content = { x: [], series: [] };
  /** @type {[number, number] | null} */ #zoom = null;
  /** @type {number | null} */ #hover = null;
  #cursor = NaN;
  #drag = NaN;
  #pending = false;

  /**
   * @param {object} options
   * @param {string} options.title
   * @param {string} options.unit of the values
   * @param {string} [options.axis] words and unit of the axis
   * @param {(x: number) => void} [options.seek] the reader points at a value of the axis
   * @param {(range: [number, number] | null) => void} [options.zoomed]
   */
  constructor(options) {
    this.options = { axis: "time (s)", seek: () => {}, zoomed: () => {}, ...options };
    this.canvas = html("canvas", { tabindex: 0, role: "img", "aria-label": options.title });
    this.title = html("figcaption", {}, html("strong", {}, options.title));
    this.legend = html("span.legend");
    this.readout = html("output.readout");
    this.title.append(this.legend);
    this.element = html("figure.plot", {}, this.title, this.canvas, this.readout);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.#listen();
  }

  /** @param {Content} content */
  show(content) {
    this.#content = content;
    const { series } = content;
    this.legend.replaceChildren(
      ...(series.length > 1 ? series : []).slice(0, 12).map((one) => html("span", {}, html(`i.tint-${one.tint % 6}`), one.name)),
    );
    this.draw();
  }

  /** @param {number} x */
  setCursor(x) {
    this.#cursor = x;
    this.draw();
  }

  /** @param {[number, number] | null} range */
  setZoom(range) {
    this.#zoom = range;
    this.draw();
  }

  /** Draw at the next frame, once. */
  draw() {
    if (this.#pending) return;
    this.#pending = true;
    requestAnimationFrame(() => {
      this.#pending = false;
      this.#draw();
    });
  }

  /** @returns {[number, number]} */
  get #domain() {
    const { x } = this.#content;
    return this.#zoom ?? [x[0] ?? 0, x[x.length - 1] ?? 1];
  }

  #range() {
    const [from, to] = this.#domain;
    const { x, series, limits = [] } = this.#content;
    const [first, last] = [Math.max(0, indexAt(x, from)), Math.min(x.length - 1, indexAt(x, to) + 1)];
    let [low, high] = this.#content.zero === false ? [Infinity, -Infinity] : [0, 0];
    for (const { y } of series) {
      for (let i = first; i <= last; i++) {
        if (y[i] < low) low = y[i];
        if (y[i] > high) high = y[i];
      }
    }
    const size = high - low;
    for (const { y } of limits) { // limits far away would flatten the lines
      if (y < low && y > low - 2 * size) low = y;
      if (y > high && y < high + 2 * size) high = y;
    }
    const margin = 0.07 * (high - low || 1);
    return [low - margin, high + margin];
  }

  #geometry() {
    const { width, height } = this.canvas.getBoundingClientRect();
    const [from, to] = this.#domain;
    const [low, high] = this.#range();
    const inner = { width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    return {
      width, height, inner, from, to, low, high,
      X: (/** @type {number} */ x) => MARGIN.left + ((x - from) / (to - from || 1)) * inner.width,
      Y: (/** @type {number} */ y) => MARGIN.top + ((high - y) / (high - low || 1)) * inner.height,
      back: (/** @type {number} */ px) => from + ((px - MARGIN.left) / (inner.width || 1)) * (to - from),
    };
  }

  #draw() {
    const g = this.#geometry();
    if (!(g.inner.width > 10)) return;
    const ratio = devicePixelRatio || 1;
    [this.canvas.width, this.canvas.height] = [Math.round(g.width * ratio), Math.round(g.height * ratio)];
    const style = getComputedStyle(document.documentElement);
    const tint = (/** @type {string} */ name) => style.getPropertyValue(`--${name}`).trim();
    const c = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    c.scale(ratio, ratio);
    c.font = `11px ${style.fontFamily || "sans-serif"}`;
    this.#axes(c, g, tint);
    c.save();
    c.beginPath();
    c.rect(MARGIN.left, MARGIN.top, g.inner.width, g.inner.height);
    c.clip();
    const { events = [], dots = [], limits = [], series, x } = this.#content;
    c.lineWidth = 1;
    for (const { x: at } of events) this.#line(c, tint("alarm"), [4, 3], g.X(at), MARGIN.top, g.X(at), g.height);
    for (const one of limits) this.#line(c, tint(`c${one.tint % 6}`), [2, 3], MARGIN.left, g.Y(one.y), g.width, g.Y(one.y));
    c.lineWidth = 1.5;
    c.lineJoin = "round";
    for (const one of series) this.#curve(c, g, x, one, tint(`c${one.tint % 6}`));
    for (const one of dots) {
      c.fillStyle = tint(`c${one.tint % 6}`);
      c.beginPath();
      c.arc(g.X(one.x), g.Y(one.y), 3.5, 0, 7);
      c.fill();
    }
    c.lineWidth = 1;
    if (Number.isFinite(this.#cursor)) this.#line(c, tint("ink"), [], g.X(this.#cursor), MARGIN.top, g.X(this.#cursor), g.height);
    if (this.#hover !== null) this.#line(c, tint("grey"), [1, 2], g.X(this.#hover), MARGIN.top, g.X(this.#hover), g.height);
    if (!Number.isNaN(this.#drag) && this.#hover !== null) {
      c.fillStyle = tint("select");
      c.fillRect(g.X(this.#drag), MARGIN.top, g.X(this.#hover) - g.X(this.#drag), g.inner.height);
    }
    c.restore();
    this.#read();
  }

  /** @param {CanvasRenderingContext2D} c @param {any} g @param {(name: string) => string} tint */
  #axes(c, g, tint) {
    const bottom = MARGIN.top + g.inner.height;
    for (const { from, to, strong } of this.#content.spans ?? []) {
      c.fillStyle = tint(strong ? "shade-strong" : "shade");
      const [left, right] = [Math.max(g.X(from), MARGIN.left), Math.min(g.X(to), MARGIN.left + g.inner.width)];
      if (right > left) c.fillRect(left, MARGIN.top, right - left, g.inner.height);
    }
    const largest = Math.max(Math.abs(g.low), Math.abs(g.high));
    const [factor, unit] = scaled(largest, this.options.unit);
    this.scale = { factor, unit, rounding: 1e-9 * largest };
    c.lineWidth = 1;
    c.fillStyle = tint("quiet");
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const y of ticks(g.low / factor, g.high / factor, g.inner.height / 34)) {
      this.#line(c, tint(Math.abs(y) < 1e-12 ? "grey" : "faint"), [], MARGIN.left, g.Y(y * factor), MARGIN.left + g.inner.width, g.Y(y * factor));
      c.fillText(number(y, 6), MARGIN.left - 6, g.Y(y * factor));
    }
    c.textBaseline = "alphabetic";
    c.textAlign = "center";
    for (const x of ticks(g.from, g.to, g.inner.width / 80)) {
      if (g.X(x) > g.width - 72) continue; // the words of the axis
      c.fillText(number(x, 6), g.X(x), bottom + 14);
    }
    c.textAlign = "right";
    c.fillText(this.options.axis, g.width - MARGIN.right, bottom + 14);
    c.textAlign = "left";
    c.fillText(unit, 4, MARGIN.top + 8);
  }

  /** @param {CanvasRenderingContext2D} c @param {string} colour @param {number[]} dash @param {...number} points */
  #line(c, colour, dash, ...points) {
    c.strokeStyle = colour;
    c.setLineDash(dash);
    c.beginPath();
    c.moveTo(points[0], points[1]);
    c.lineTo(points[2], points[3]);
    c.stroke();
    c.setLineDash([]);
  }

  /** @param {CanvasRenderingContext2D} c @param {any} g @param {ArrayLike<number>} x @param {Series} one @param {string} colour */
  #curve(c, g, x, one, colour) {
    c.strokeStyle = colour;
    c.beginPath();
    let open = false;
    for (let i = Math.max(0, indexAt(x, g.from)); i < x.length; i++) {
      const [px, py] = [g.X(x[i]), g.Y(one.y[i])];
      if (!Number.isFinite(py)) open = false;
      else if (open && one.steps) (c.lineTo(px, g.Y(one.y[i - 1])), c.lineTo(px, py));
      else if (open) c.lineTo(px, py);
      else (c.moveTo(px, py), (open = true));
      if (x[i] > g.to) break;
    }
    c.stroke();
  }

  /** The values at the pointer, or else at the cursor, in words. */
  #read() {
    const { x, series, events = [] } = this.#content;
    const at = this.#hover ?? this.#cursor;
    if (!Number.isFinite(at) || !series.length || !x.length) return;
    const i = indexAt(x, at);
    const { factor, unit, rounding } = this.scale ?? { factor: 1, unit: "", rounding: 0 };
    const text = (/** @type {number} */ y) => `${number(Math.abs(y) < rounding ? 0 : y / factor)} ${unit}`;
    const values = series.slice(0, 6).map((one) => (series.length > 1 ? `${one.name} ` : "") + text(one.y[i]));
    const near = events.find((one) => Math.abs(one.x - at) < 0.01 * (this.#domain[1] - this.#domain[0]));
    this.readout.textContent = `${number(x[i])}: ${values.join(", ")}${near ? `; ${near.name}` : ""}`;
  }

  /** @param {[number, number] | null} range */
  #zoomTo(range) {
    const { x } = this.#content;
    const [least, most] = [x[0], x[x.length - 1]];
    if (range !== null) range = [Math.max(least, range[0]), Math.min(most, range[1])];
    if (range !== null && !(range[1] - range[0] < (most - least) * 0.999)) range = null;
    this.setZoom(range);
    this.options.zoomed(range);
  }

  #listen() {
    const { canvas } = this;
    const at = (/** @type {MouseEvent} */ event) => this.#geometry().back(event.clientX - canvas.getBoundingClientRect().left);
    canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
      this.#hover = Math.min(Math.max(at(event), this.#domain[0]), this.#domain[1]);
      this.draw();
    });
    canvas.addEventListener("pointerleave", () => {
      this.#hover = null;
      this.draw();
    });
    canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      this.#drag = at(event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointerup", (/** @type {PointerEvent} */ event) => {
      const [start, end] = [this.#drag, at(event)];
      this.#drag = NaN;
      const [from, to] = this.#domain;
      if (Math.abs(end - start) > 0.01 * (to - from)) this.#zoomTo([Math.min(start, end), Math.max(start, end)]);
      else this.options.seek(end);
      this.draw();
    });
    canvas.addEventListener("dblclick", () => this.#zoomTo(null));
    canvas.addEventListener("wheel", (/** @type {WheelEvent} */ event) => {
      if (!event.ctrlKey && !event.metaKey) return; // or the page would not scroll
      event.preventDefault();
      this.#zoomAround(at(event), Math.exp(event.deltaY / 300));
    }, { passive: false });
    canvas.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const [from, to] = this.#domain;
      const middle = Number.isFinite(this.#cursor) ? this.#cursor : (from + to) / 2;
      const step = (to - from) / (event.shiftKey ? 10 : 100);
      /** @type {Record<string, () => void>} */
      const keys = {
        ArrowRight: () => this.options.seek(middle + step), ArrowLeft: () => this.options.seek(middle - step),
        Home: () => this.options.seek(from), End: () => this.options.seek(to),
        "+": () => this.#zoomAround(middle, 0.7), "-": () => this.#zoomAround(middle, 1.4), "0": () => this.#zoomTo(null),
      };
      if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  /** @param {number} x @param {number} factor */
  #zoomAround(x, factor) {
    const [from, to] = this.#domain;
    this.#zoomTo([x - (x - from) * factor, x + (to - x) * factor]);
  }
}
