// A log is dropped, its columns and faults are shown, and free numbers of the case are fitted to it.

import { ask, upload } from "./api.js";
import { html, number, raised } from "./dom.js";
import { createJob, freeChoice, labelled } from "./job.js";
import { createModes } from "./modes.js";
import { Plot } from "./plot.js";

/** @param {import("./store.js").Store} store */
export function createIdentify(store) {
  const input = html("input", { type: "file", multiple: true, id: "log-files", class: "hidden-input", onchange: () => take([...input.files]) });
  const drop = html("label.drop", { for: "log-files" }, html("strong", {}, "Drop a log here"), html("span", {}, "or choose files: CSV, MAT, TDMS, HDF5, UFF, Parquet; run.toml beside run.csv describes it"));
  const logs = html("div");
  const choice = freeChoice(store, "Free numbers", ["logs.*.loads.0.speed", "logs.*.loads.0.mass", "logs.*.loads.0.entry_time"]);
  const { free } = choice;
  const misfit = new Plot({ title: "Misfit (log10) by trial point", unit: "", axis: "point" });
  misfit.element.hidden = true;
  const results = html("div");
  const plots = html("div.plots");
  /** @type {Set<string>} */ const names = new Set();

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
  /** Descriptions first, as the logs are read with them. @param {File[]} files */
  async function take(files) {
    files.sort((a, b) => Number(b.name.endsWith(".toml")) - Number(a.name.endsWith(".toml")));
    for (const file of files) {
      await store.attempt(async () => {
        const found = await upload("log", file);
        if (found.logs.length || found.problem) show(found);
        else store.say(`${found.name} describes its log`);
      });
    }
    input.value = "";
  }

  /** A file as it is read, in the place of what it was read as before. @param {any} found */
  function show(found) {
    const parts = [...logs.children].filter((one) => /** @type {HTMLElement} */ (one).dataset.name === found.name);
    const card = html("section.log", { "data-name": found.name });
    if (parts.length) parts[0].replaceWith(card);
    else logs.append(card);
    if (found.problem) names.delete(found.name);
    else names.add(found.name);
    if (found.problem) card.append(html("h3", { "aria-level": 2 }, found.name), html("p.wrong", { role: "alert" }, found.problem.message));
    for (const log of found.logs) {
      const quantities = [...new Set(log.channels.map((/** @type {any} */ one) => one.quantity))];
      const rows = log.channels.map((/** @type {any} */ one) => html("tr", {}, html("td", {}, one.name), html("td", {}, one.quantity), html("td", {}, one.unit)));
      const remarks = [...log.notes, ...log.faults].map((words) => html("li", {}, words));
      card.append(html("h3", { "aria-level": 2 }, `${log.source}: ${number(log.duration)} s at ${number(log.rate)} Hz`, log.loads ? html("small", {}, `loads: ${log.loads.join(", ")}`) : ""),
        html("div.log-parts", {},
          html("table.data", {}, html("thead", {}, html("tr", {}, html("th", {}, "column"), html("th", {}, "quantity"), html("th", {}, "unit"))), html("tbody", {}, ...rows)),
          html("ul.remarks", {}, ...(remarks.length ? remarks : [html("li", {}, "no faults were found")]))),
        html("div.plots", {}, ...quantities.map((quantity) => {
          const own = log.channels.map((/** @type {any} */ one, /** @type {number} */ i) => ({ ...one, i })).filter((/** @type {any} */ one) => one.quantity === quantity);
          const plot = new Plot({ title: String(quantity), unit: SI[String(quantity)] ?? "" });
          plot.show({ x: log.times, series: own.map((/** @type {any} */ one) => ({ name: one.name, tint: one.i, y: log.values[one.i] })) });
          return plot.element;
        })));
    }
    card.append(otherwise(found));
    if (!names.size) return;
    if (!free.size && found.logs.some((/** @type {any} */ log) => log.loads)) ["logs.*.loads.0.speed", "logs.*.loads.0.entry_time"].forEach(choice.add);
    if (![...free].some((one) => one.startsWith("beam"))) for (const address of ["beam.flexural_rigidity", "beam.damping_ratio"]) if (store.model.numbers?.[address]) choice.add(address);
  }

  /** Columns, rate and gaps by hand, for a file that is read wrongly or not at all. @param {any} found */
  function otherwise(found) {
    const units = (/** @type {any} */ one) => `${one.name} [${one.unit}]`;
    const columns = html("input", { size: 40, autocomplete: "off", value: (found.logs[0]?.channels ?? []).map(units).join(", "), placeholder: "time [s], a1 [g], -" });
    const rate = html("input", { size: 10, autocomplete: "off", placeholder: "of its times" });
    const missing = html("select", {}, html("option", { value: "refuse" }, "refuse"), html("option", { value: "mask" }, "leave out"));
    const again = html("button", { type: "button", onclick: () => store.attempt(async () => show(await ask("read-log", { name: found.name, columns: columns.value, rate: rate.value, missing: missing.value }))) }, "Read again");
    return html("details", { open: found.problem !== null }, html("summary", {}, "Read it otherwise"),
      html("div.form", {}, labelled("Columns with units, - for one to leave out", columns), labelled("Sampling rate (Hz)", rate), labelled("Gaps", missing), again));
  }

  const job = createJob(store, "Fit", async () => {
    if (!names.size || !free.size) {
      store.say("a fit needs a log and a free number at least", true);
      return null;
    }
    const question = { text: store.text, logs: [...names], free: Object.fromEntries([...free].map((one) => [one, null])) };
    return { name: "fit", question };
  }, (state) => {
    const { seen } = state;
    misfit.element.hidden = !seen.misfits.length;
    if (seen.misfits.length) misfit.show({ zero: false, x: seen.misfits.map((/** @type {number} */ _, /** @type {number} */ i) => i), series: [{ name: "misfit", tint: 0, y: seen.misfits.map(Math.log10) }] });
    if (seen.runs && !state.done) {
      const rows = Object.entries(seen.numbers).map(([address, value]) => html("tr", {}, html("td", {}, address), html("td.number", {}, number(/** @type {number} */ (value), 5))));
      results.replaceChildren(html("h3", { "aria-level": 2 }, `Trial point ${seen.misfits.length}`), html("table.data", {}, html("tbody", {}, ...rows)));
      readings(seen);
    }
    if (state.result) result(state.result);
    return seen.misfits.length;
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
    readings(fit);
  }

  /** Measured and fitted readings, and their difference. @param {any} fit */
  function readings(fit) {
    plots.replaceChildren(...fit.runs.flatMap((/** @type {any} */ run) => fit.channels.map((/** @type {any} */ channel, /** @type {number} */ i) => ({ channel, i })).filter((/** @type {any} */ one) => run.measured[one.i].some(Number.isFinite)).map((/** @type {any} */ { channel, i }) => {
      const plot = new Plot({ title: `${run.source}, ${channel.name}`, unit: channel.unit });
      const residual = run.measured[i].map((/** @type {number} */ value, /** @type {number} */ k) => value - run.fitted[i][k]);
      plot.show({ x: run.times, series: [{ name: "measured", tint: 2, y: run.measured[i] }, { name: "fitted", tint: 0, y: run.fitted[i] }, { name: "residual", tint: 1, y: residual }] });
      return plot.element;
    })));
  }

  const element = html("div.identify", {}, input, drop, logs, html("div.form", {}, choice.element, choice.chips, job.element), html("div.plots", {}, misfit.element), results, plots, createModes(store, names).element);
  return { element };
}

/** Units of quantities of logs. @type {Record<string, string>} */
const SI = { deflection: "m", velocity: "m/s", acceleration: "m/s^2", slope: "rad", moment: "N m", shear: "N", stress: "Pa", force: "N", voltage: "V" };
