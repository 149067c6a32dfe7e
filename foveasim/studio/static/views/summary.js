// Summary of the result, beside that of variant A, and warnings.

import { quantity, shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";
import { percent } from "../problems.js";

// Words of the summary that have another form than the key.
const SUMMARY = {
  n_sites: ["photosites", ""], width_um: ["width", "µm"], height_um: ["height", "µm"], min_size_um: ["smallest site", "µm"],
  max_size_um: ["largest site", "µm"],
  exposure_s: ["exposure", "s"], bits: ["bits", ""], mean_dn: ["mean code", "DN"], median_e: ["median signal", "e-"],
  saturated_fraction: ["saturated", "%"],
  dark_fraction: ["code 0", "%"], f_number: ["f-number", ""], magnification: ["magnification", ""],
};

function textOf(key, value) {
  if (value === undefined) return "–";
  if (key.endsWith("_fraction")) return shown(Number((100 * value).toPrecision(3))) + " %";
  const unit = SUMMARY[key]?.[1];
  return quantity(Number.isInteger(value) ? value : Number(value.toPrecision(5)), unit ?? "");
}

// Returns the rows of the numbers of a summary, beside those of variant A if there is one.
function summaryRows(summary, before) {
  // Values of signals count saturated photosites with their clipped signal.
  const text = (key, of) => textOf(key, of[key]) + (["mean_dn", "median_e"].includes(key) && of.saturated_fraction > 0
    ? " (" + percent(of.saturated_fraction) + " saturated)" : "");
  const rows = Object.entries(summary).filter(([, value]) => typeof value === "number").map(([key, value]) => {
    const row = make("tr"), name = make("th", SUMMARY[key]?.[0] || key.replaceAll("_", " "));
    name.scope = "row";
    row.append(name, ...(before ? [make("td", text(key, before))] : []), make("td", text(key, summary)));
    row.classList.toggle("differs", Boolean(before) && before[key] !== value);
    return row;
  });
  if (!before) return rows;
  const head = make("tr");
  head.append(make("td"), ...["A", "B"].map((name) => { const cell = make("th", name); cell.scope = "col"; return cell; }));
  return [head, ...rows];
}

export function create(root, { page }) {
  const table = make("table"), warnings = make("ul");
  table.id = "summary";
  warnings.id = "warnings";
  root.append(table, warnings);
  return {
    onState() {
      table.replaceChildren(...summaryRows(page.state.summary, page.frozen?.summary));
      warnings.replaceChildren(...(page.state.warnings || []).map((warning) => make("li", warning)));
    },
  };
}
