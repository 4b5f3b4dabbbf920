// Answers the questions of the page in the browser itself, without a server: Python as WebAssembly.

const PYODIDE = "https://cdn.jsdelivr.net/pyodide/v314.0.7/full/";
const BUILT = ["numpy", "scipy", "matplotlib", "tqdm", "lazy-loader", "threadpoolctl", "tomli-w", "micropip"];
const PURE = ["jaxtyping", "pint", "tomlkit"];

/**
 * Functions of Pyodide that are used here.
 * @typedef {{loadPackage: (names: string[]) => Promise<any>, unpackArchive: (content: ArrayBuffer, format: string) => void, runPythonAsync: (code: string) => Promise<any>}} Pyodide
 */

/**
 * The library in a Python that is ready, and its answers.
 * @param {() => Promise<Pyodide>} load
 * @param {() => Promise<ArrayBuffer>} library a zip archive of the package
 * @param {(words: string) => void} say
 */
export async function begin(load, library, say) {
  say("Python is loaded (once: some 40 MB)");
  const python = await load();
  await python.loadPackage(BUILT);
  say("the library is loaded");
  await python.runPythonAsync(`import micropip\nawait micropip.install(${JSON.stringify(PURE)})`);
  python.unpackArchive(await library(), "zip");
  const ask = await python.runPythonAsync("from jaxbeam.cli.page.questions import Page\nPage().ask");
  say("");
  return (/** @type {string} */ name, /** @type {string} */ text) => {
    const found = ask(name, text);
    const [answered, body, kind, file] = found.toJs();
    found.destroy();
    return { answered, body: body.buffer.slice(body.byteOffset, body.byteOffset + body.byteLength), kind, file };
  };
}

if (typeof WorkerGlobalScope !== "undefined") {
  const load = async () => (await import(`${PYODIDE}pyodide.mjs`)).loadPyodide({ indexURL: PYODIDE });
  const library = async () => (await fetch("../jaxbeam.zip")).arrayBuffer();
  const ready = begin(load, library, (words) => postMessage({ say: words }));
  // One at a time, in the order in which they were asked.
  let last = ready.catch(() => null);
  addEventListener("message", ({ data: { id, name, text } }) => {
    last = last.then(async () => {
      try {
        const found = (await ready)(name, text);
        postMessage({ id, ...found }, { transfer: [found.body] });
      } catch (error) {
        postMessage({ id, problem: String(error) });
      }
      return null;
    });
  });
}
