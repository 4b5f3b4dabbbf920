// Parts of the page that need no browser. `node --test` runs them; tests/cli/page/test_scripts.py does so.

import assert from "node:assert/strict";
import { test } from "node:test";

globalThis.location = /** @type {any} */ ({ search: "?token=a" });
const page = new URL("../../../../jaxbeam/cli/page/static/", import.meta.url);
const load = (name) => import(new URL(name, page).href);
const { number, raised, scaled } = await load("dom.js");
const { indexAt, ticks } = await load("plot.js");
const { boundsOf, newEntry, parsed, tableSchema } = await load("fields.js");
const { rangeAbout } = await load("sliders.js");
const { onBeam } = await load("histories.js");
const { column } = await load("api.js");
const { heat } = await load("sweep.js");

test("numbers are short, with a minus sign", () => {
  assert.equal(number(-0.00123456), "−0.001235");
  assert.equal(number(1.8e10), "1.8e10");
  assert.equal(number(NaN), "–");
  assert.equal(number(1200), "1200");
});

test("units have prefixes where they are metres, newtons and their like", () => {
  assert.deepEqual(scaled(0.0012, "m"), [1e-3, "mm"]);
  assert.deepEqual(scaled(1.8e10, "N m^2"), [1e9, "GN m²"]);
  assert.deepEqual(scaled(5000, "m"), [1, "m"]);
  assert.deepEqual(scaled(300, "kg"), [1, "kg"]);
  assert.deepEqual(scaled(0, "N"), [1, "N"]);
  assert.deepEqual(scaled(2, "1"), [1, ""]);
  assert.equal(raised("m/s^2"), "m/s²");
});

test("ticks are round and within the range", () => {
  assert.deepEqual(ticks(0, 1, 5).map((one) => Number(one.toFixed(9))), [0, 0.2, 0.4, 0.6, 0.8, 1]);
  assert.deepEqual(ticks(-3, 7, 4), [0, 5]);
  assert.deepEqual(ticks(1, 1, 5), []);
  for (const [low, high] of [[-1e-7, 3e-6], [2e8, 2.1e8]]) {
    for (const one of ticks(low, high, 6)) assert.ok(one >= low - 1e-12 && one <= high * (1 + 1e-9));
  }
});

test("the last entry that is not above a value is found", () => {
  const x = [0, 1, 2, 2, 5];
  assert.deepEqual([-1, 0, 0.5, 2, 4, 9].map((one) => indexAt(x, one)), [0, 0, 0, 3, 3, 4]);
});

test("sliders reach from half to twice a value", () => {
  assert.deepEqual(rangeAbout(4), [2, 8]);
  assert.deepEqual(rangeAbout(-4), [-8, -2]);
  assert.deepEqual(rangeAbout(0), [0, 1]);
});

const schema = {
  $defs: { "load-mass": { properties: { kind: { const: "mass" }, mass: { type: ["number", "string"], minimum: 0 }, speed: {} }, required: ["kind", "mass"] } },
};
const loads = { properties: { kind: { enum: ["mass"] } }, allOf: [{ if: { properties: { kind: { const: "mass" } } }, then: { $ref: "#/$defs/load-mass" } }] };

test("a table has the schema of its kind, and a new one what that needs", () => {
  assert.equal(tableSchema(schema, loads, { kind: "mass" }), schema.$defs["load-mass"]);
  assert.equal(tableSchema(schema, loads, { kind: "none" }), loads);
  assert.deepEqual(newEntry(schema, loads, "mass", 25), { kind: "mass", mass: 1, speed: 25 });
});

test("what is typed is a number, a quantity, a list or nothing", () => {
  const numbers = { type: ["number", "string"] };
  assert.equal(parsed(" 1e-3 ", numbers), 1e-3);
  assert.equal(parsed("80 km/h", numbers), "80 km/h");
  assert.deepEqual(parsed("[1, 2.5]", { type: "array" }), [1, 2.5]);
  assert.equal(parsed("[1, 2", { type: "array" }), "[1, 2");
  assert.equal(parsed("", numbers), null);
  assert.equal(parsed("7", { type: "string" }), "7");
});

test("bounds are told in words", () => {
  assert.equal(boundsOf({ exclusiveMinimum: 0 }), "above 0");
  assert.equal(boundsOf({ anyOf: [{ minimum: 0 }, {}] }), "0 or more");
  assert.equal(boundsOf({ minimum: 1, maximum: 1000 }), "1 or more, at most 1000");
});

test("passages that overlap are one time on the beam", () => {
  assert.deepEqual(onBeam([[1, 3], [-1, 0.5], [2, 9]], 5), [{ from: 0, to: 0.5 }, { from: 1, to: 5 }]);
  assert.deepEqual(onBeam([[8, 9]], 5), []);
});

test("a column is taken of rows", () => {
  assert.deepEqual([...column({ shape: [2, 3], data: Float32Array.of(1, 2, 3, 4, 5, 6) }, 1)], [2, 5]);
});

test("colours of a map rise in lightness", () => {
  const light = Array.from({ length: 21 }, (_, i) => {
    const [r, g, b] = heat(i / 20).match(/\d+/g).map(Number);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  });
  assert.ok(light.every((one, i) => i === 0 || one > light[i - 1]));
});
