// A log is dropped, its columns and faults are shown, and free numbers of the case are fitted to it.

import { upload } from "./api.js";
import { html, number, raised } from "./dom.js";
import { addressChoice, createJob } from "./job.js";
import { createModes } from "./modes.js";
import { Plot } from "./plot.js";

/** @param {import("./store.js").Store} store */
export function createIdentify(store) {
  const input = html("input", { type: "file", multiple: true, id: "log-files", class: "hidden-input", onchange: () => take([...input.files]) });
  const drop = html("label.drop", { for: "log-files" }, html("strong", {}, "Drop a log here"), html("span", {}, "or choose files: CSV, MAT, TDMS, HDF5, UFF, Parquet; run.toml beside run.csv describes it"));
  const logs = html("div");
  const chips = html("div.chips", { role: "group", "aria-label": "free numbers" });
  const choice = addressChoice(store, "Free numbers", ["logs.*.loads.0.speed", "logs.*.loads.0.mass", "logs.*.loads.0.entry_time"]);
  const results = html("div");
  const plots = html("div.plots");
  /** @type {Set<string>} */ const names = new Set();
  /** @type {Set<string>} */ const free = new Set();

  drop.addEventListener("dragover", (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    drop.classList.add("over");
  });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    drop.classList.remove("over");
    take([...(event.dataTransfer?.files ?? [])]);
  });
  choice.select.addEventListener("change", () => {
    if (choice.select.value) addFree(choice.select.value);
    choice.select.value = "";
  });

  /** Descriptions first, as the logs are read with them. @param {File[]} files */
  async function take(files) {
    files.sort((a, b) => Number(b.name.endsWith(".toml")) - Number(a.name.endsWith(".toml")));
    for (const file of files) {
      await store.attempt(async () => {
        const found = await upload("log", file);
        if (found.logs.length) {
          names.add(found.name);
          show(found);
        } else store.say(`${found.name} describes its log`);
      });
    }
    input.value = "";
  }

  /** @param {any} found */
  function show(found) {
    for (const log of found.logs) {
      const quantities = [...new Set(log.channels.map((/** @type {any} */ one) => one.quantity))];
      const rows = log.channels.map((/** @type {any} */ one) => html("tr", {}, html("td", {}, one.name), html("td", {}, one.quantity), html("td", {}, one.unit)));
      const remarks = [...log.notes, ...log.faults].map((words) => html("li", {}, words));
      const card = html("section.log", {}, html("h3", { "aria-level": 2 }, `${log.source}: ${number(log.duration)} s at ${number(log.rate)} Hz`, log.loads ? html("small", {}, `loads: ${log.loads.join(", ")}`) : ""),
        html("div.log-parts", {},
          html("table.data", {}, html("thead", {}, html("tr", {}, html("th", {}, "column"), html("th", {}, "quantity"), html("th", {}, "unit"))), html("tbody", {}, ...rows)),
          html("ul.remarks", {}, ...(remarks.length ? remarks : [html("li", {}, "no faults were found")]))),
        html("div.plots", {}, ...quantities.map((quantity) => {
          const own = log.channels.map((/** @type {any} */ one, /** @type {number} */ i) => ({ ...one, i })).filter((/** @type {any} */ one) => one.quantity === quantity);
          const plot = new Plot({ title: String(quantity), unit: SI[String(quantity)] ?? "" });
          plot.show({ x: log.times, series: own.map((/** @type {any} */ one) => ({ name: one.name, tint: one.i, y: log.values[one.i] })) });
          return plot.element;
        })));
      logs.append(card);
    }
    if (!free.size && found.logs.some((/** @type {any} */ log) => log.loads)) ["logs.*.loads.0.speed", "logs.*.loads.0.entry_time"].forEach(addFree);
    if (![...free].some((one) => one.startsWith("beam"))) for (const address of ["beam.flexural_rigidity", "beam.damping_ratio"]) if (store.model.numbers?.[address]) addFree(address);
  }

  /** @param {string} address */
  function addFree(address) {
    free.add(address);
    chips.replaceChildren(...[...free].map((one) => html("button.chip", { type: "button", "aria-label": `${one}: no longer free`, onclick: () => {
      free.delete(one);
      chips.querySelector(`[data-address="${one}"]`)?.remove();
    }, "data-address": one }, `${one} ×`)));
  }

  const job = createJob(store, "Fit", async () => {
    if (!names.size || !free.size) {
      store.say("a fit needs a log and a free number at least", true);
      return null;
    }
    const question = { text: store.text, logs: [...names], free: Object.fromEntries([...free].map((one) => [one, null])) };
    return { name: "fit", question };
  }, (state) => {
    if (state.result) result(state.result);
    return 0;
  });

  /** @param {any} fit */
  function result(fit) {
    const rows = Object.entries(fit.numbers).map(([address, one]) => {
      const own = /** @type {any} */ (one);
      const interval = own.interval_95 ? `${number(own.interval_95[0], 5)} to ${number(own.interval_95[1], 5)}` : "not seen in the data";
      return html("tr", {}, html("td", {}, address), ...[own.start, own.value].map((value) => html("td.number", {}, number(value, 5))), html("td.number", {}, interval), html("td", {}, raised(own.unit === "1" ? "" : own.unit)));
    });
    const keep = html("button", { type: "button", onclick: () => store.change(...Object.entries(fit.numbers).filter(([address]) => !address.startsWith("logs.")).map(([address, one]) => ({ set: address, to: Number(/** @type {any} */ (one).value.toPrecision(8)) }))) }, "Put them into the case");
    results.replaceChildren(
      html("h3", { "aria-level": 2 }, "Fitted numbers", keep),
      html("table.data", {}, html("thead", {}, html("tr", {}, ...["number", "start", "fitted", "95 % interval", "unit"].map((words) => html("th", {}, words)))), html("tbody", {}, ...rows)),
      html("p", {}, fit.verdict),
      ...(fit.remarks.length ? [html("ul.remarks", {}, ...fit.remarks.map((/** @type {string} */ words) => html("li", {}, words)))] : []));
    plots.replaceChildren(...fit.runs.flatMap((/** @type {any} */ run) => fit.channels.map((/** @type {any} */ channel, /** @type {number} */ i) => ({ channel, i })).filter((/** @type {any} */ one) => run.measured[one.i].some(Number.isFinite)).map((/** @type {any} */ { channel, i }) => {
      const plot = new Plot({ title: `${run.source}, ${channel.name}`, unit: channel.unit });
      const residual = run.measured[i].map((/** @type {number} */ value, /** @type {number} */ k) => value - run.fitted[i][k]);
      plot.show({ x: run.times, series: [{ name: "measured", tint: 5, y: run.measured[i] }, { name: "fitted", tint: 0, y: run.fitted[i] }, { name: "residual", tint: 1, y: residual }] });
      return plot.element;
    })));
  }

  const element = html("div.identify", {}, input, drop, logs, html("div.form", {}, choice.element, chips, job.element), results, plots, createModes(store, names).element);
  return { element };
}

/** Units of quantities of logs. @type {Record<string, string>} */
const SI = { deflection: "m", velocity: "m/s", acceleration: "m/s^2", slope: "rad", moment: "N m", shear: "N", stress: "Pa", force: "N", voltage: "V" };
