// What to open: files of the folder, starters, published rigs; and vehicles and trains to let cross.

import { ask } from "./api.js";
import { html, number, svg } from "./dom.js";
import { drawVehicle } from "./vehicle.js";

const WIDTH = 200, HEIGHT = 56, WHEEL = 7;

/** @param {number} count */
const axles = (count) => `${count} ${count === 1 ? "axle" : "axles"}`;

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

  /**
   * A dialog with groups of cards.
   * @param {string} title @param {Record<string, HTMLElement[]>} groups
   */
  function open(title, groups) {
    dialog.replaceChildren(
      html("header", {}, html("h2", { id: "library-title" }, title), html("button.icon", { type: "button", "aria-label": "close", onclick: () => dialog.close() }, "×")),
      ...Object.entries(groups).filter(([, cards]) => cards.length).flatMap(([name, cards]) => [html("h3", {}, name), html("div.cards", {}, ...cards)]));
    dialog.showModal();
  }

  /** @param {string} name @param {string} words @param {() => void} work @param {Node | null} [picture] */
  function card(name, words, work, picture = null) {
    return html("button.card", { type: "button", onclick: work }, ...(picture ? [picture] : []), html("strong", {}, name), html("small", {}, words));
  }

  async function show() {
    const hello = await store.attempt(() => ask("hello"));
    if (!hello) return;
    /** @type {Record<string, HTMLElement[]>} */
    const groups = { [`Files in ${hello.folder}`]: hello.files.map((/** @type {string} */ name) => card(name.replace(/\.toml$/, ""), name, () => file(name))) };
    for (const one of hello.library) (groups[one.group] ??= []).push(card(one.title, one.name, () => start(one.name), beamPicture(one.scene)));
    open("Open a case", groups);
  }

  /** Vehicles and trains; the one that is chosen takes the place of the first load. */
  async function showVehicles() {
    const found = await store.attempt(() => ask("vehicles"));
    if (!found) return;
    /** @param {Record<string, any>} load */
    const cross = (load) => {
      dialog.close();
      const now = store.model.tables.loads?.[0] ?? {};
      const moving = ["speed", "entry_time", "deceleration"].filter((key) => key in now).map((key) => [key, now[key]]);
      store.change({ set: "loads.0", to: { ...load, speed: Math.round(store.scene?.length ?? 10), ...Object.fromEntries(moving) } });
    };
    open("Let it cross", {
      Vehicles: found.vehicles.map((/** @type {any} */ one) => card(one.name, `${axles(one.vehicle.wheels)}, ${number(one.mass / 1000, 3)} t`, () => cross({ kind: "vehicle", model: one.name }), vehiclePicture(one.vehicle, one.positions))),
      Trains: found.trains.map((/** @type {any} */ one) => card(one.name, `${axles(one.offsets.length)}, ${number(Math.max(...one.offsets), 3)} m`, () => cross({ kind: "axles", train: one.name }), trainPicture(one.offsets))),
    });
  }

  return { show, showVehicles };
}

const sheet = () => svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, class: "thumbnail", "aria-hidden": "true" });

/** Beam, supports, sensors and actuators of a case, to scale. @param {any} scene */
function beamPicture(scene) {
  const X = (/** @type {number} */ x) => 14 + (x / scene.length) * (WIDTH - 28);
  const floor = HEIGHT * 0.55;
  const pin = (/** @type {number} */ x) => svg("path", { class: "pin", d: `M${X(x)},${floor + 2}l-6,11h12Z` });
  const ends = scene.ends.flatMap((/** @type {any} */ end, /** @type {number} */ i) => (end.clamped ? [svg("path", { class: "line", d: `M${X(i * scene.length)},${floor - 10}v20` })] : end.held ? [pin(i * scene.length)] : []));
  const patches = scene.actuators.map((/** @type {any} */ one) => (one.positions.length > 1
    ? svg("path", { class: "patch", d: `M${X(one.positions[0])},${floor + 4}H${X(one.positions[1])}` })
    : svg("path", { class: "device", d: `M${X(one.positions[0])},${floor + 2}v5m-5,0h10v9h-10Z` })));
  const sensors = scene.sensors.map((/** @type {any} */ one, /** @type {number} */ i) => svg("circle", { class: `dot tint-${i % 6}`, cx: X(one.position), cy: floor, r: 3.5 }));
  const found = sheet();
  found.append(...ends, ...scene.supports.map((/** @type {any} */ one) => pin(one.position)), ...patches, svg("path", { class: "beam", d: `M${X(0)},${floor}H${X(scene.length)}` }), ...sensors);
  return found;
}

/** A vehicle at rest, its front on the right. @param {any} vehicle @param {number[]} positions */
function vehiclePicture(vehicle, positions) {
  const span = Math.max(...positions) - Math.min(...positions) || 3;
  const X = (/** @type {number} */ x) => WIDTH / 2 + ((x - (Math.max(...positions) + Math.min(...positions)) / 2) / span) * (WIDTH - 70);
  const drawn = drawVehicle({ ...vehicle, count: 1 }, 0);
  const still = new Array(vehicle.dofs).fill(0);
  drawn.update(positions, positions.map(() => 0), still, 1, { X, floor: HEIGHT - 4, follow: () => 0, wheel: WHEEL, least: 0.1 * span });
  const found = sheet();
  found.append(svg("path", { class: "ground", d: `M0,${HEIGHT - 4}H${WIDTH}` }), drawn.element);
  return found;
}

/** Axles of a train, the first on the right. @param {number[]} offsets */
function trainPicture(offsets) {
  const span = Math.max(...offsets) || 1;
  const found = sheet();
  found.append(svg("path", { class: "ground", d: `M0,${HEIGHT / 2 + 4}H${WIDTH}` }), ...offsets.map((one) => svg("circle", { class: "mass", cx: WIDTH - 12 - (one / span) * (WIDTH - 24), cy: HEIGHT / 2 + 1, r: 2.2 })));
  return found;
}
