// Table of the variants A and B: budgets and picture quality.

import { shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";

const figure = (value, unit) => (value === null || value === undefined ? "–" : typeof value !== "number" ? "∞" : shown(Number(value.toPrecision(unit === "dB" || Math.abs(value) < 1000 ? 3 : 4))));

// Shows rows of { name, label, unit, values: [a, b] }; null without variants.
export function showComparison({ table, note, button }, about) {
  note.hidden = Boolean(about);
  table.hidden = button.hidden = !about;
  if (!about) return;
  const head = make("tr"), sizes = [about.fovea_um, about.field_um].map((side) => shown(Math.round(side)));
  head.append(make("td"), ...["A", "B"].map((name) => { const cell = make("th", name); cell.scope = "col"; return cell; }));
  const rows = about.rows.map(({ name, label, unit, values }) => {
    const row = make("tr"), title = make("th", label + (unit ? " / " + unit : ""));
    title.scope = "row";
    row.dataset.name = name;
    if (/^(fovea|field)_/.test(name)) title.title = "Against the optical image, after a fit of one gain, on a square of " + sizes[name.startsWith("fovea") ? 0 : 1] + " µm";
    row.append(title, ...values.map((value) => make("td", name === "n_sites" ? shown(value) : figure(value, unit))));
    row.classList.toggle("differs", values[0] !== values[1]);
    return row;
  });
  table.replaceChildren(head, ...rows);
  button.disabled = !about.can_match || about.rows[0].values[0] === about.rows[0].values[1];
  button.title = about.can_match ? "Same number of photosites as A, in the same field" : "The layout of B has no generator";
}
