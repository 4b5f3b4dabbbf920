// The open case and what is known of it. Panels change it here, and listen to what has changed:
// "text", "model" (what the text says), "run" (a run, or a preview of one), "cursor" (a time).

import { ask, askArrays, Refusal } from "./api.js";

const IDLE = 250; // ms without a change before a whole run begins

export class Store extends EventTarget {
  text = "";
  /** @type {string | null} */ name = null;
  /** @type {string | null} */ mark = null;
  saved = "";
  /** @type {any} */ model = { tables: {}, problem: null };
  /** @type {any} */ run = null;
  /** @type {any} the scene of the run, as of a preview */ scene = null;
  /** @type {any} */ schema = null;
  cursor = 0;
  /** @type {string[]} */ #undo = [];
  /** @type {string[]} */ #redo = [];
  /** @type {{values: Record<string, number>, ranges: Record<string, [number, number]>} | null} */ #wanted = null;
  #previewing = false;
  #running = false;
  #timer = 0;
  /** @type {Promise<unknown>} */ #turns = Promise.resolve();

  /** @param {string} kind @param {any} [detail] */
  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  /** @param {string} kind @param {(detail: any) => void} work */
  on(kind, work) {
    this.addEventListener(kind, (event) => work(/** @type {CustomEvent} */ (event).detail));
  }

  /** Tell the reader something. @param {string} message @param {boolean} [wrong] */
  say(message, wrong = false) {
    this.#tell("say", { message, wrong });
  }

  /**
   * Do some work; what is refused is told.
   * @template T
   * @param {() => Promise<T>} work
   * @returns {Promise<T | undefined>}
   */
  async attempt(work) {
    try {
      return await work();
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      this.say(error.message, true);
    }
  }

  get unsaved() {
    return this.text !== this.saved;
  }

  get canUndo() {
    return this.#undo.length > 0;
  }

  get canRedo() {
    return this.#redo.length > 0;
  }

  /**
   * Open a text; of a file, with its name and mark.
   * @param {string} text @param {string | null} name @param {string | null} mark
   */
  async open(text, name = null, mark = null) {
    [this.name, this.mark, this.saved] = [name, mark, name === null ? "" : text];
    this.#undo = [];
    this.#redo = [];
    this.cursor = 0;
    this.#tell("opened");
    await this.#take(text);
  }

  /** Another text, which can be undone. @param {string} text */
  async write(text) {
    if (text === this.text) return;
    this.#undo.push(this.text);
    if (this.#undo.length > 200) this.#undo.shift();
    this.#redo = [];
    await this.#take(text);
  }

  undo() {
    return this.#inTurn(() => this.#step(this.#undo, this.#redo));
  }

  redo() {
    return this.#inTurn(() => this.#step(this.#redo, this.#undo));
  }

  /** @param {string[]} from @param {string[]} to */
  async #step(from, to) {
    const text = from.pop();
    if (text === undefined) return;
    to.push(this.text);
    await this.#take(text);
  }

  /** Do some work after what was asked before it. @param {() => Promise<void>} work */
  #inTurn(work) {
    const turn = () => this.attempt(work);
    return (this.#turns = this.#turns.then(turn, turn));
  }

  /** @param {string} text */
  async #take(text) {
    this.text = text;
    this.#tell("text");
    await this.attempt(async () => {
      const model = await ask("model", { text });
      if (text !== this.text) return;
      if (model.problem !== null) model.scene ??= this.model.scene; // the last that was right
      this.model = model;
      if (model.problem === null) this.scene = model.scene;
      this.#tell("model");
      clearTimeout(this.#timer);
      if (model.problem === null) this.#timer = setTimeout(() => this.#compute(), this.run === null ? 0 : IDLE);
    });
  }

  async #compute() {
    if (this.#running || this.#previewing) {
      this.#timer = setTimeout(() => this.#compute(), 50);
      return;
    }
    this.#running = true;
    const text = this.text;
    this.#tell("busy", true);
    await this.attempt(async () => {
      const run = await askArrays("run", { text });
      if (text !== this.text || this.#wanted !== null) return;
      this.scene = this.model.scene;
      this.#show(run, false);
    });
    this.#running = false;
    this.#tell("busy", false);
  }

  /** @param {any} run @param {boolean} preview */
  #show(run, preview) {
    this.run = run;
    this.cursor = Math.min(this.cursor, this.duration);
    this.#tell("run", { preview });
  }

  get duration() {
    return this.run?.arrays.times.data.at(-1) ?? 1;
  }

  /**
   * Change entries of the text, one call after the other: {set: address, to: value}, {remove: address}.
   * @param {...Record<string, any>} changes
   */
  change(...changes) {
    return this.#inTurn(async () => {
      let base, found;
      do {
        base = this.text;
        found = await ask("change", { text: base, changes });
      } while (base !== this.text);
      await this.write(found.text);
    });
  }

  /**
   * A run with other numbers, soon; of several that wait only the newest is computed.
   * @param {Record<string, number>} values in SI units by address
   * @param {Record<string, [number, number]>} [ranges] within which they will be moved
   */
  async preview(values, ranges = {}) {
    this.#wanted = { values, ranges };
    if (this.#previewing) return;
    this.#previewing = true;
    while (this.#wanted !== null) {
      const wanted = /** @type {Record<string, any>} */ (this.#wanted);
      const { text } = this;
      await this.attempt(async () => {
        const run = await askArrays("preview", { text, ...wanted });
        if (text !== this.text) return;
        this.scene = run.scene;
        this.#show(run, true);
      });
      if (this.#wanted === wanted) this.#wanted = null;
    }
    this.#previewing = false;
  }

  /**
   * Get ready for previews of some numbers.
   * @param {Record<string, number>} values @param {Record<string, [number, number]>} ranges
   */
  async prepare(values, ranges) {
    if (this.#previewing || this.#running || this.model.problem !== null) return;
    await ask("preview", { text: this.text, values, ranges, prepare: true }).catch(() => {});
  }

  /** Move the cursor to a time (s). @param {number} time */
  seek(time) {
    this.cursor = Math.min(Math.max(time, 0), this.duration);
    this.#tell("cursor");
  }

  /** @param {string} name */
  async save(name) {
    await this.attempt(async () => {
      const text = this.text;
      const found = await ask("save", { name, text, mark: name === this.name ? this.mark : null });
      [this.name, this.mark, this.saved] = [found.name, found.mark, text];
      this.#tell("text");
      this.say(`saved: ${name}`);
    });
  }
}
