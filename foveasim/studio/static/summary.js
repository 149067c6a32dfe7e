// Figures of a result in tables: statistics of the shown values, and the summary with variant A.

import { shown } from "/web/colours.js";
import { statistics } from "/web/measure.js";
import { make } from "/web/page_parts.js";

// Words of the summary that have another form than the key.
const SUMMARY = {
  n_sites: ["photosites", ""], width_um: ["width", "µm"], height_um: ["height", "µm"], min_size_um: ["smallest site", "µm"], max_size_um: ["largest site", "µm"],
  exposure_s: ["exposure", "s"], bits: ["bits", ""], mean_dn: ["mean code", "DN"], median_e: ["median signal", "e⁻"], saturated_fraction: ["saturated", "%"],
  dark_fraction: ["code 0", "%"], f_number: ["f-number", ""], magnification: ["magnification", ""],
};

// Returns statistics of the values of a pane by name, as texts.
export function statisticsOf({ column, sites }) {
  if (column.names) return { n: shown(sites.n) };
  const sorted = Float64Array.from(column.values).sort(), figure = (v) => (Number.isNaN(v) ? "–" : shown(Number(v.toPrecision(4))));
  // NaN is last.
  const found = statistics(sorted, sorted.keys()), first = sorted.findIndex((v) => v > -Infinity);
  return { n: shown(found.n), mean: figure(found.mean), median: figure(found.n ? sorted[first + (found.n >> 1)] : NaN), std: figure(found.std), min: figure(found.min), max: figure(found.max) };
}

function textOf(key, value) {
  if (value === undefined) return "–";
  if (key.endsWith("_fraction")) return shown(Number((100 * value).toPrecision(3))) + " %";
  const unit = SUMMARY[key]?.[1];
  return shown(Number.isInteger(value) ? value : Number(value.toPrecision(5))) + (unit ? " " + unit : "");
}

// Returns the rows of the numbers of a summary, beside those of variant A if there is one.
export function summaryRows(summary, before) {
  const rows = Object.entries(summary).filter(([, value]) => typeof value === "number").map(([key, value]) => {
    const row = make("tr"), name = make("th", SUMMARY[key]?.[0] || key.replaceAll("_", " "));
    name.scope = "row";
    row.append(name, ...(before ? [make("td", textOf(key, before[key]))] : []), make("td", textOf(key, value)));
    row.classList.toggle("differs", Boolean(before) && before[key] !== value);
    return row;
  });
  if (!before) return rows;
  const head = make("tr");
  head.append(make("td"), ...["A", "B"].map((name) => { const cell = make("th", name); cell.scope = "col"; return cell; }));
  return [head, ...rows];
}
