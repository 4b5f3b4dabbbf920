// Questions to the server, each with the token of the page.

/**
 * What is wrong with an input: the sentence of the library, and where.
 * @typedef {{message: string, address: string | null, line: number | null}} Problem
 */

/**
 * Arrays of a run by name, row by row, with their shapes.
 * @typedef {{shape: number[], data: Float32Array}} Values
 */

const token = new URLSearchParams(location.search).get("token") ?? "";

/** The page without a server: a worker computes in the browser. */
export const alone = globalThis.document?.querySelector('meta[name="jaxbeam-worker"]') ?? null;
const worker = alone && new Worker(/** @type {HTMLMetaElement} */ (alone).content, { type: "module" });
/** @type {Map<number, (answer: any) => void>} */ const waiting = new Map();
let asked = 0;
worker?.addEventListener("message", ({ data }) => {
  if (data.say === undefined) return waiting.get(data.id)?.(data);
  const status = document.getElementById("status");
  if (status) status.textContent = data.say;
});

/**
 * The answer of the worker, as a server would give it.
 * @param {string} name @param {string} text
 */
async function fromWorker(name, text) {
  const id = ++asked;
  worker?.postMessage({ id, name, text });
  const { answered, body, kind, file, problem } = await new Promise((take) => waiting.set(id, take));
  waiting.delete(id);
  if (problem) throw new Refusal({ message: problem, address: null, line: null });
  const headers = { "content-type": kind, ...(file ? { "content-disposition": `attachment; filename="${file}"` } : {}) };
  return new Response(body, { status: answered ? 200 : 422, headers });
}

export class Refusal extends Error {
  /** @param {Problem} problem */
  constructor(problem) {
    super(problem.message);
    this.problem = problem;
  }
}

/**
 * @param {string} name
 * @param {BodyInit} body
 * @param {Record<string, string>} headers
 */
async function send(name, body, headers = {}) {
  let response;
  try {
    if (worker) response = await fromWorker(name, String(body));
    else response = await fetch(`api/${name}`, { method: "POST", body, headers: { "x-token": token, ...headers } });
  } catch (error) {
    if (error instanceof Refusal) throw error;
    const message = "the server does not answer: start jaxbeam app again, and open the address that it prints";
    throw new Refusal({ message, address: null, line: null });
  }
  if (!response.ok) {
    const content = await response.json().catch(() => ({}));
    throw new Refusal(content.problem ?? { message: `the server answers ${response.status}`, address: null, line: null });
  }
  return response;
}

/**
 * Ask for JSON.
 * @param {string} name
 * @param {Record<string, any>} [question]
 * @returns {Promise<any>}
 */
export async function ask(name, question = {}) {
  return (await send(name, JSON.stringify(question))).json();
}

/**
 * Ask for words and arrays (see `packed` of the server).
 * @param {string} name
 * @param {Record<string, any>} question
 * @returns {Promise<any>}
 */
export async function askArrays(name, question) {
  const buffer = await (await send(name, JSON.stringify(question))).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const words = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let place = 4 + length;
  /** @type {Record<string, Values>} */
  const arrays = {};
  for (const [key, shape] of Object.entries(words.arrays)) {
    const size = shape.reduce((/** @type {number} */ a, /** @type {number} */ b) => a * b, 1);
    arrays[key] = { shape, data: new Float32Array(buffer, place, size) };
    place += 4 * size;
  }
  return { ...words, arrays };
}

/**
 * Ask for a file, and let the browser keep it.
 * @param {Record<string, any>} question
 */
export async function download(question) {
  const response = await send("take", JSON.stringify(question));
  const name = /filename="(.+)"/.exec(response.headers.get("content-disposition") ?? "")?.[1] ?? "file";
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  return name;
}

/**
 * Give a file to the server.
 * @param {string} name of the question
 * @param {File} file
 */
export async function upload(name, file) {
  return (await send(name, file, { "x-name": encodeURIComponent(file.name) })).json();
}

/**
 * A column of rows.
 * @param {Values} values
 * @param {number} column
 */
export function column(values, column) {
  const [rows, columns] = values.shape;
  const found = new Float32Array(rows);
  for (let i = 0; i < rows; i++) found[i] = values.data[i * columns + column];
  return found;
}
