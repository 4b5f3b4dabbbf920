// A vehicle above its wheels: bodies as boxes, springs between them. Heights are in pixels upwards.

import { svg } from "./dom.js";

const SPRING = 0.7, FRAME = 0.5, BODY = 1.6; // in diameters of a wheel
const ZIGZAG = [[0, 0], [0.2, 0], [0.3, 1], [0.5, -1], [0.7, 1], [0.8, 0], [1, 0]];

/**
 * @typedef {object} Surroundings
 * @property {(x: number) => number} X position (m) to pixels
 * @property {number} floor height of the beam at rest, in pixels from the top
 * @property {(x: number) => number} follow height that bodies take over from the beam
 * @property {number} wheel diameter of a wheel
 * @property {number} least least length (m) of a body
 */

/**
 * @param {any} vehicle as of `views.scene`
 * @param {number} tint
 */
export function drawVehicle(vehicle, tint) {
  const { parts, springs } = vehicle;
  const element = svg("g", { class: `vehicle load-${tint % 4}` });
  const highest = Math.max(...parts.map((/** @type {any} */ part) => part.level));
  const units = Array.from({ length: vehicle.count }, () => ({
    springs: svg("path", { class: "spring" }),
    boxes: parts.map(() => svg("path", { class: "body" })),
    wheels: Array.from({ length: vehicle.wheels }, () => svg("circle", { class: "wheel" })),
  }));
  for (const unit of units) element.append(unit.springs, ...unit.boxes, ...unit.wheels);

  /**
   * @param {number[]} positions of all wheels (m)
   * @param {number[]} heights of the surface under them
   * @param {number[]} motion of all degrees of freedom
   * @param {number} direction 1 to the right, -1 to the left
   * @param {Surroundings} around
   */
  function update(positions, heights, motion, direction, around) {
    const { X, floor, follow, wheel, least } = around;
    const thickness = (/** @type {any} */ part) => wheel * (part.level === highest ? BODY : FRAME);
    units.forEach((unit, v) => {
      const first = positions[v * vehicle.wheels];
      const u = motion.slice(v * vehicle.dofs, (v + 1) * vehicle.dofs);
      const dot = (/** @type {number[]} */ row) => row.reduce((sum, one, i) => sum + one * u[i], 0);
      const bottom = (/** @type {any} */ part, /** @type {number} */ s) => {
        const base = wheel + SPRING * wheel + (part.level - 1) * wheel * (FRAME + SPRING);
        return base + dot(part.height) + (s - part.position) * dot(part.pitch) + follow(first + direction * s);
      };
      parts.forEach((/** @type {any} */ part, /** @type {number} */ i) => {
        const size = least * (part.level > 1 || parts.length === 1 ? 1.6 : 1);
        const more = Math.max(0, size - (part.ends[1] - part.ends[0])) / 2;
        const [rear, front] = [part.ends[0] - more, part.ends[1] + more];
        const corners = [[rear, 0], [front, 0], [front, thickness(part)], [rear, thickness(part)]];
        const points = corners.map(([s, up]) => `${X(first + direction * s)},${floor - bottom(part, s) - up}`);
        unit.boxes[i].setAttribute("d", `M${points.join("L")}Z`);
      });
      const lines = springs.map((/** @type {[number, number, number]} */ [s, upper, lower]) => {
        const high = bottom(parts[upper], s);
        const low = lower >= 0 ? bottom(parts[lower], s) + thickness(parts[lower]) : heights[v * vehicle.wheels - 1 - lower] + wheel;
        const x = X(first + direction * s);
        return "M" + ZIGZAG.map(([along, across]) => `${x + 3 * across},${floor - low - (high - low) * along}`).join("L");
      });
      unit.springs.setAttribute("d", lines.join(""));
      unit.wheels.forEach((circle, w) => {
        const at = v * vehicle.wheels + w;
        circle.setAttribute("cx", X(positions[at]));
        circle.setAttribute("cy", floor - heights[at] - wheel / 2);
        circle.setAttribute("r", wheel / 2);
      });
    });
  }
  return { element, update };
}
