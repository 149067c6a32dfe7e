// Summary of the result, beside that of variant A, and warnings.

import { around, make } from "/web/page_parts.js";
import { quantity } from "../numbers.js";
import { percent } from "../problems.js";

// Words of the summary that have another form than the key.
const SUMMARY = {
  n_sites: ["photosites", ""], width_um: ["size", "µm"], min_size_um: ["smallest site", "µm"], max_size_um: ["largest site", "µm"],
  exposure_s: ["exposure", "s"], bits: ["bits", ""], mean_dn: ["mean code", "DN"], median_e: ["median signal", "e-"],
  saturated_fraction: ["saturated", "%"],
  dark_fraction: ["code 0", "%"], f_number: ["f-number", ""], magnification: ["magnification", ""],
};

function textOf(key, summary) {
  const value = summary[key], height = summary.height_um;
  if (value === undefined) return "–";
  if (key === "width_um") return quantity(value) + " × " + quantity(height, "µm");
  return key.endsWith("_fraction") ? quantity(100 * value, "%", 3) : quantity(value, SUMMARY[key]?.[1]);
}

// Returns the rows of the numbers of a summary, beside those of variant A if there is one.
function summaryRows(summary, before) {
  // Values of signals count saturated photosites with their clipped signal.
  const text = (key, of) => textOf(key, of) + (["mean_dn", "median_e"].includes(key) && of.saturated_fraction > 0
    ? " (" + percent(of.saturated_fraction) + " saturated)" : "");
  const rows = Object.entries(summary).filter(([key, value]) => typeof value === "number" && key !== "height_um").map(([key, value]) => {
    const name = make("th", SUMMARY[key]?.[0] || key.replaceAll("_", " "), { scope: "row" });
    const row = around("tr", {}, name, ...(before ? [make("td", text(key, before))] : []), make("td", text(key, summary)));
    row.classList.toggle("differs", Boolean(before) && before[key] !== value);
    return row;
  });
  if (!before) return rows;
  return [around("tr", {}, make("td"), ...["A", "B"].map((name) => make("th", name, { scope: "col" }))), ...rows];
}

export function create(root, { page }) {
  const table = make("table", undefined, { id: "summary" }), warnings = make("ul", undefined, { id: "warnings" });
  root.append(table, warnings);
  return {
    onState() {
      table.replaceChildren(...summaryRows(page.state.summary, page.frozen?.summary));
      warnings.replaceChildren(...(page.state.warnings || []).map((warning) => make("li", warning)));
    },
  };
}
