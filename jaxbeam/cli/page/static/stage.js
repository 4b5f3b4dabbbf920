// The beam to scale, its parts to drag, and the run over it, frame by frame.

import { html, number, released, scaled, svg } from "./dom.js";
import { indexAt } from "./plot.js";
import { drawVehicle } from "./vehicle.js";

const SWING = 46; // pixels, of the largest deflection
const ROUGH = 0.25; // of the swing, for the height of the surface
const RATES = { "4 s": 0, "1 ×": 1, "½ ×": 0.5, "¼ ×": 0.25, "1/10 ×": 0.1, "1/50 ×": 0.02 };

/** @param {import("./store.js").Store} store */
export function createStage(store) {
  const picture = svg("svg", { role: "group", "aria-label": "the beam, its parts and loads" });
  const caption = html("p.caption");
  const play = html("button.icon", { type: "button", "aria-label": "play", onclick: () => toggle() }, "▶");
  const scrubber = html("input", { type: "range", min: 0, max: 1000, value: 0, "aria-label": "time", oninput: () => {
    stop();
    store.seek((Number(scrubber.value) / 1000) * store.duration);
  } });
  const clock = html("output.clock");
  const rate = html("select", { "aria-label": "speed of the motion", title: "speed of the motion; 4 s: the whole run in four seconds" }, ...Object.keys(RATES).map((name) => html("option", {}, name)));
  const player = html("div.player", {}, play, scrubber, clock, rate);
  const element = html("div.stage", {}, picture, caption, player);

  /** @type {any} */ let drawn = null;
  /** @type {number | null} */ let last = null;
  let size = { width: 0, height: 0 };

  new ResizeObserver(() => {
    const { width, height } = picture.getBoundingClientRect();
    if (width === size.width && height === size.height) return;
    size = { width, height };
    build();
  }).observe(picture);

  const calmly = released(build);
  store.on("model", calmly);
  store.on("run", ({ preview }) => (preview ? build() : calmly()));
  store.on("cursor", update);

  function toggle() {
    if (last !== null) return stop();
    if (store.cursor >= store.duration) store.seek(0);
    last = performance.now();
    play.textContent = "❚❚";
    play.setAttribute("aria-label", "pause");
    requestAnimationFrame(step);
  }

  function stop() {
    last = null;
    play.textContent = "▶";
    play.setAttribute("aria-label", "play");
  }

  /** @param {number} now */
  function step(now) {
    if (last === null) return;
    const chosen = RATES[/** @type {keyof typeof RATES} */ (rate.value)] || store.duration / 4;
    store.seek(store.cursor + (Math.max(0, now - last) / 1000) * chosen);
    last = now;
    if (store.cursor >= store.duration) stop();
    else requestAnimationFrame(step);
  }

  /** Draw all parts anew. */
  function build() {
    const scene = store.scene;
    if (!scene || !(size.width > 40)) return;
    const focused = /** @type {HTMLElement | null} */ (picture.contains(document.activeElement) ? document.activeElement : null)?.dataset.part;
    picture.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    drawn = drawScene(store, scene, size);
    picture.replaceChildren(...drawn.elements);
    if (focused) picture.querySelector(`[data-part="${focused}"]`)?.focus();
    update();
  }

  function update() {
    if (drawn === null) return;
    drawn.update(store.cursor);
    scrubber.value = String((store.cursor / store.duration) * 1000);
    scrubber.setAttribute("aria-valuetext", `${number(store.cursor, 3)} s`);
    clock.textContent = `${store.cursor.toFixed(3)} s`;
    caption.textContent = drawn.caption;
  }

  return { element, toggle };
}

/** @param {import("./store.js").Store} store @param {any} scene @param {{width: number, height: number}} size */
function drawScene(store, scene, size) {
  const { run } = store;
  const { length } = scene;
  const wide = scene.surface !== null || scene.loads.some((/** @type {any} */ load) => load.vehicle !== null);
  const beside = (wide ? 0.14 : 0.04) * length;
  const pad = 14;
  const X = (/** @type {number} */ x) => pad + ((x + beside) / (length + 2 * beside)) * (size.width - 2 * pad);
  const back = (/** @type {number} */ px) => ((px - pad) / (size.width - 2 * pad)) * (length + 2 * beside) - beside;
  const floor = Math.round(size.height * (wide ? 0.62 : 0.52));

  const arrays = run?.arrays;
  const frames = arrays?.frameTimes.data.length ?? 0;
  const points = arrays?.x.data ?? Float32Array.of(0, length);
  const largest = arrays ? arrays.beam.data.reduce((/** @type {number} */ a, /** @type {number} */ b) => Math.max(a, Math.abs(b) || 0), 0) : 0;
  const scale = largest > 0 ? SWING / largest : 0; // pixels per m
  const rough = scene.surface ? Math.max(...scene.surface.height.map(Math.abs)) * scale : 0;
  const share = rough > ROUGH * SWING ? (ROUGH * SWING) / rough : 1;

  let now = { frame: 0, part: 0 };
  /** @param {any} values @param {number} i */
  const at = (values, i) => {
    const columns = values.shape[1], k = now.frame * columns + i;
    const next = now.frame + 1 < frames ? values.data[k + columns] : values.data[k];
    const moved = values.data[k] + now.part * (next - values.data[k]);
    return Number.isFinite(moved) ? moved : values.data[k];
  };
  /** Height of the beam in pixels, upwards. @param {number} x */
  const height = (x) => {
    if (!arrays || x < 0 || x > length) return 0;
    const i = Math.min(indexAt(points, x), points.length - 2);
    const along = (x - points[i]) / (points[i + 1] - points[i] || 1);
    return scale * (at(arrays.beam, i) * (1 - along) + at(arrays.beam, i + 1) * along) || 0;
  };
  /** Height of the surface above the beam in pixels. @param {number} x */
  const surface = (x) => {
    if (!scene.surface) return 0;
    const xs = scene.surface.x, hs = scene.surface.height;
    const i = Math.min(indexAt(xs, x), xs.length - 2);
    return scale * share * (hs[i] + ((x - xs[i]) / (xs[i + 1] - xs[i])) * (hs[i + 1] - hs[i]));
  };

  const beam = svg("path", { class: "beam" });
  const rest = svg("path", { class: "rest", d: `M${X(0)},${floor}H${X(length)}` });
  const ground = svg("path", { class: "ground", d: wide ? `M0,${floor}H${X(0)}M${X(length)},${floor}H${size.width}` : "" });
  const profile = svg("path", { class: "surface" });
  const parts = drawParts(store, scene, { X, back, floor, height, scale, at });
  const loads = drawLoads(store, scene, { X, back, floor, height, surface, scale, share, at });
  const lost = (run?.lost ?? []).map((/** @type {any} */ one) => ({ ...one, mark: svg("text", { class: "lost", "text-anchor": "middle" }, "contact lost") }));
  const saturated = scene.actuators.map((/** @type {any} */ one) => svg("text", { class: "lost", x: X(one.positions[0]), y: floor + 52, "text-anchor": "middle" }, "at its limit"));

  function update(/** @type {number} */ time) {
    if (frames) {
      const times = arrays.frameTimes.data;
      const frame = indexAt(times, time);
      now = { frame, part: frame + 1 < frames ? (time - times[frame]) / (times[frame + 1] - times[frame]) : 0 };
    }
    beam.setAttribute("d", "M" + Array.from(points, (x) => `${X(x).toFixed(1)},${(floor - height(x)).toFixed(2)}`).join("L"));
    if (scene.surface) profile.setAttribute("d", "M" + scene.surface.x.map((/** @type {number} */ x) => `${X(x).toFixed(1)},${(floor - height(x) - surface(x)).toFixed(2)}`).join("L"));
    parts.update();
    loads.update();
    for (const one of lost) {
      one.mark.setAttribute("x", X(one.position));
      one.mark.setAttribute("y", floor - 58);
      one.mark.style.visibility = Math.abs(time - one.time) < 0.04 * store.duration ? "visible" : "hidden";
    }
    const sample = arrays ? indexAt(arrays.times.data, time) : 0;
    saturated.forEach((/** @type {any} */ mark, /** @type {number} */ i) => {
      const columns = arrays?.saturated?.shape[1] ?? 0;
      mark.style.visibility = i < columns && arrays.saturated.data[sample * columns + i] ? "visible" : "hidden";
    });
  }

  const [factor, unit] = scaled(largest, "m");
  const metre = (size.width - 2 * pad) / (length + 2 * beside);
  const caption = largest > 0
    ? `deflection × ${number(scale / metre, 2)}, largest ${number(largest / factor, 3)} ${unit}${share < 1 ? `; surface × ${number((scale * share) / metre, 2)}` : ""}`
    : "to scale";
  return { elements: [ground, rest, ...parts.below, beam, profile, ...loads.elements, ...parts.above, ...lost.map((/** @type {any} */ one) => one.mark), ...saturated], update, caption };
}

/**
 * Supports, ends, actuators, sensors, which may be dragged, or moved and removed by keys.
 * @param {import("./store.js").Store} store @param {any} scene @param {any} view
 */
function drawParts(store, scene, view) {
  const { X, back, floor, height, scale, at } = view;
  /** @type {{element: any, x: () => number, follows: boolean}[]} */
  const moving = [];

  /** @param {string} list @param {number} i @param {string} words @param {number[]} positions @param {any[]} shape @param {boolean} follows */
  function part(list, i, words, positions, shape, follows) {
    const keys = positions.length > 1 ? ["start", "end"] : ["position"];
    let shift = 0;
    const label = () => `${words}, at ${number(positions[0] + shift)} m`;
    const element = svg("g", {
      class: `part ${list}`, tabindex: 0, role: "slider", "data-part": `${list}.${i}`, "aria-label": words,
      "aria-valuemin": 0, "aria-valuemax": scene.length, "aria-valuenow": positions[0], "aria-valuetext": label(),
    }, svg("title", {}, `${label()}: drag, or arrow keys; Delete removes it`), ...shape);
    const moved = () => Object.fromEntries(keys.map((key, k) => [`${list}.${i}.${key}`, rounded(positions[k] + shift)]));
    const limit = (/** @type {number} */ to) => Math.min(Math.max(to, -Math.min(...positions)), scene.length - Math.max(...positions));
    const keep = () => store.change(...Object.entries(moved()).map(([address, to]) => ({ set: address, to })));
    /** @param {number} value */
    const rounded = (value) => {
      const step = 10 ** Math.floor(Math.log10(scene.length / 500));
      return Number((Math.round(value / step) * step).toPrecision(12));
    };
    element.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      const start = event.clientX;
      event.preventDefault();
      element.focus();
      follow(element, event, (now) => {
        shift = limit(back(X(0) + now.clientX - start));
        place();
        if (store.model.problem === null) store.preview(moved());
      }, () => {
        if (shift !== 0) keep();
      });
    });
    element.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const steps = { ArrowRight: 1, ArrowLeft: -1, ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (event.key === "Delete" || event.key === "Backspace") store.change({ remove: `${list}.${i}` });
      else if (steps) {
        shift = limit((steps * scene.length) / (event.shiftKey ? 500 : 100));
        keep();
      } else return;
      event.preventDefault();
    });
    const x = () => positions[0] + shift;
    const place = () => { // the one on the screen, which a preview has drawn anew
      const shown = document.querySelector(`[data-part="${list}.${i}"]`) ?? element;
      for (const one of new Set([element, shown])) one.setAttribute("transform", `translate(${X(x())},${floor - (follows ? height(x()) : 0)})`);
    };
    moving.push({ element, x, follows });
    place();
    return element;
  }

  const ends = scene.ends.map((/** @type {any} */ end, /** @type {number} */ i) => {
    const side = i ? "right" : "left";
    const next = scene.endNames[(scene.endNames.indexOf(end.name) + 1) % scene.endNames.length];
    const names = scene.ends.map((/** @type {any} */ one) => one.name);
    const change = () => store.change({ set: "beam.ends", to: (i ? [names[0], next] : [next, names[1]]).join("-") });
    return svg("g", {
      class: "part end", tabindex: 0, role: "button", "aria-label": `${side} end: ${end.name}; press for ${next}`, "data-part": `end.${i}`,
      transform: `translate(${X(i ? scene.length : 0)},${floor})`, onclick: change,
      onkeydown: (/** @type {KeyboardEvent} */ event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        change();
      },
    }, svg("title", {}, `${side} end: ${end.name}; click for ${next}`), svg("rect", { class: "grip", x: -14, y: -22, width: 28, height: 46 }), ...endShape(end, i ? -1 : 1));
  });
  const supports = scene.supports.map((/** @type {any} */ one, /** @type {number} */ i) =>
    part("supports", i, `support ${i}`, [one.position], one.elastic ? [grip(), svg("path", { class: "line", d: "M0,2V6L6,9L-6,13L6,17L-6,21L0,24V28M-11,28H11" })] : [grip(), pin()], false));
  const actuators = scene.actuators.map((/** @type {any} */ one, /** @type {number} */ i) => {
    const words = `actuator ${i}, ${one.kind}`;
    const shape = one.positions.length > 1
      ? [svg("path", { class: "patch", d: `M0,4H${X(one.positions[1]) - X(one.positions[0])}` })]
      : [svg("path", { class: "device", d: "M0,2V12M-10,12H10V30H-10Z" })];
    return part("actuators", i, words, one.positions, shape, true);
  });
  const sensors = scene.sensors.map((/** @type {any} */ one, /** @type {number} */ i) =>
    part("sensors", i, `sensor ${one.label}`, [one.position], [grip(), svg("circle", { class: `dot tint-${i % 6}`, r: 5.5 })], true));
  const bodies = store.run?.arrays.bodies;
  const boxes = scene.absorbers.map(() => svg("path", { class: "device", d: "M-11,24H11V40H-11Z" }));
  const absorbers = scene.absorbers.map((/** @type {any} */ one, /** @type {number} */ i) =>
    part("absorbers", i, `absorber ${i}`, [one.position], [svg("path", { class: "line", d: "M0,2V6L5,8L-5,12L5,16L-5,20L0,22V24" }), boxes[i]], true));
  /** Absorbers swing below the beam, as far as there is room. */
  const swing = () => boxes.forEach((/** @type {any} */ box, /** @type {number} */ i) => {
    const first = (bodies?.shape[1] ?? 0) - boxes.length;
    if (first < 0) return;
    const stroke = scale * at(bodies, first + i) - height(scene.absorbers[i].position);
    box.setAttribute("transform", `translate(0,${Math.min(Math.max(-stroke || 0, -14), 22)})`);
  });
  const hinges = scene.hinges.map((/** @type {number} */ x) => svg("circle", { class: "hinge", cx: X(x), cy: floor, r: 4 }));
  return {
    below: [...ends, ...supports, ...absorbers, ...actuators],
    above: [...hinges, ...sensors],
    update: () => (swing(), moving.forEach(({ element, x, follows }) => element.setAttribute("transform", `translate(${X(x())},${floor - (follows ? height(x()) : 0)})`))),
  };
}

/**
 * Follow the pointer until it is released; the picture is told, as its parts may be drawn anew.
 * @param {any} element @param {PointerEvent} event
 * @param {(now: PointerEvent) => void} move @param {() => void} [end]
 */
function follow(element, event, move, end = () => {}) {
  const picture = element.ownerSVGElement;
  picture.setPointerCapture(event.pointerId);
  picture.addEventListener("pointermove", move);
  picture.addEventListener("pointerup", () => {
    picture.removeEventListener("pointermove", move);
    end();
  }, { once: true });
}

const grip = () => svg("rect", { class: "grip", x: -12, y: -12, width: 24, height: 40 });
const pin = () => svg("path", { class: "pin", d: "M0,2L-10,19H10Z" });

/** @param {any} end @param {number} side */
function endShape(end, side) {
  const hatch = [-12, -5, 2, 9].map((y) => `M0,${y + 5}L${-7 * side},${y}`).join("");
  const wall = svg("path", { class: "line", d: `M0,-16V16${hatch}` });
  const rollers = svg("path", { class: "line", d: `M${-6 * side},-16V16` });
  if (end.held && end.clamped) return [wall];
  if (end.held) return [pin()];
  if (end.clamped) return [wall, rollers];
  return [svg("circle", { class: "free", r: 4 })];
}

/**
 * Loads; to drag one is to go to the time when it is there.
 * @param {import("./store.js").Store} store @param {any} scene @param {any} view
 */
function drawLoads(store, scene, view) {
  const { X, back, floor, height, surface, scale, share, at } = view;
  const arrays = store.run?.arrays;
  /** @type {Element[]} */ const elements = [];
  /** @type {(() => void)[]} */ const updates = [];
  const total = arrays?.wheelPositions.shape[1] ?? 0;
  scene.loads.forEach((/** @type {any} */ load, /** @type {number} */ i) => {
    const dofs = load.vehicle ? load.vehicle.firstBody + load.vehicle.count * load.vehicle.dofs : 0;
    // Of a run before the loads were changed there is nothing to draw.
    if (!arrays || load.wheels.some((/** @type {number} */ w) => w >= total) || dofs > arrays.bodies.shape[1]) return;
    const { data } = arrays.wheelPositions;
    const path = (/** @type {number} */ w) => Array.from({ length: arrays.wheelPositions.shape[0] }, (_, k) => data[k * total + w]);
    const first = path(load.wheels[0]).filter(Number.isFinite);
    const direction = first.length > 1 && first[first.length - 1] < first[0] ? -1 : 1;
    const group = svg("g", { class: `part load load-${i % 4}` }, svg("title", {}, `load ${i}, ${load.kind}: drag it along the beam`));
    const gaps = load.wheels.slice(1).map((/** @type {number} */ w, /** @type {number} */ k) => Math.abs(X(data[w]) - X(data[load.wheels[k]]))).filter((/** @type {number} */ gap) => gap > 0);
    const wheel = Math.min(load.vehicle ? 14 : 22, Math.max(5, 0.9 * Math.min(...gaps, 30)));
    const vehicle = load.vehicle ? drawVehicle(load.vehicle, i) : null;
    const circles = vehicle ? [] : load.wheels.map(() => svg("circle", { class: "mass", r: wheel / 2 }));
    group.append(...(vehicle ? [vehicle.element] : circles));
    group.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      event.preventDefault();
      const offset = X(at(arrays.wheelPositions, load.wheels[0])) - event.clientX;
      const positions = path(load.wheels[0]);
      follow(group, event, (now) => {
        const wanted = back(now.clientX + offset);
        let best = -1;
        positions.forEach((x, k) => {
          if (Number.isFinite(x) && (best < 0 || Math.abs(x - wanted) < Math.abs(positions[best] - wanted))) best = k;
        });
        if (best >= 0) store.seek(arrays.frameTimes.data[best]);
      });
    });
    elements.push(group);
    updates.push(() => {
      const positions = load.wheels.map((/** @type {number} */ w) => at(arrays.wheelPositions, w));
      if (vehicle) {
        const heights = positions.map((/** @type {number} */ x) => height(x) + surface(x));
        const motion = Array.from({ length: load.vehicle.count * load.vehicle.dofs }, (_, k) => scale * share * at(arrays.bodies, load.vehicle.firstBody + k));
        vehicle.update(positions, heights, motion, direction, { X, floor, follow: (/** @type {number} */ x) => (1 - share) * height(x), wheel, least: 0.025 * scene.length });
        return;
      }
      circles.forEach((/** @type {any} */ circle, /** @type {number} */ k) => {
        const x = positions[k];
        circle.style.visibility = Number.isFinite(x) ? "visible" : "hidden";
        if (!Number.isFinite(x)) return;
        circle.setAttribute("cx", X(x));
        circle.setAttribute("cy", floor - height(x) - surface(x) - wheel / 2 - 2);
      });
    });
  });
  return { elements, update: () => updates.forEach((work) => work()) };
}
