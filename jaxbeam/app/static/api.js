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
    response = await fetch(`api/${name}`, { method: "POST", body, headers: { "x-token": token, ...headers } });
  } catch {
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
