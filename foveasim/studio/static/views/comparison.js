// Table of the compared variants: budgets and picture quality.

import { quantity, shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";

// Largest relative difference of equal numbers of photosites: generators solve for a number within this tolerance.
const MATCHED = 0.01;
// Notes on rows, by name.
const NOTES = { frames_per_s: "At the highest data rate of the variants", total_e: "Signal of all photosites in a frame",
  read_noise_e: "Root sum of squares over all photosites",
  readout_steps: "Photosites on the longest readout line; lines are read in parallel", area_mm2: "Total area of the photosites" };
// Four digits; "∞" for an infinite value, "–" without value.
function figure(value, unit) {
  if (typeof value !== "number") return value ? "∞" : "–";
  // A frame has millions of electrons.
  if (unit === "e-" && value >= 1e6) return shown(Number((value / 1e6).toPrecision(4))) + " Me-";
  return quantity(Number(value.toPrecision(4)), unit);
}

// Shows a comparison; null without variants.
function show({ table, note, button }, about, hasMatch) {
  note.hidden = Boolean(about);
  table.hidden = !about;
  button.hidden = !about || !hasMatch;
  if (!about) return;
  const head = make("tr"), sizes = [about.fovea_um, about.field_um].map((side) => shown(Math.round(side)));
  head.append(make("td"), ...about.names.map((name) => { const cell = make("th", name); cell.scope = "col"; return cell; }));
  const rows = about.rows.map(({ name, label, unit, values }) => {
    const row = make("tr"), title = make("th", label);
    title.scope = "row";
    row.dataset.name = name;
    title.title = NOTES[name] || "";
    if (/^(fovea|field)_/.test(name)) title.title = "Against the optical image, after a fit of one gain, on a square of "
      + sizes[name.startsWith("fovea") ? 0 : 1] + " µm";
    row.append(title, ...values.map((value) => make("td", name === "n_sites" ? shown(value) : figure(value, unit))));
    row.classList.toggle("differs", values.some((value) => value !== values[0]));
    return row;
  });
  table.replaceChildren(head, ...rows);
  const { values } = about.rows[0], a = values[0], b = values[values.length - 1];
  button.disabled = !about.can_match || Math.abs(a - b) <= MATCHED * a;
  button.title = about.can_match ? "Same number of photosites as A, in the same field" : "The layout of B has no generator";
}

export function create(root, { page, connection }) {
  const head = make("div", undefined, "head"), button = make("button", "Match B to A"), table = make("table");
  const note = make("p", "Press A|B to keep the present sensor as A and change it, or compare named variants.", "quiet");
  const elements = { table, note, button };
  Object.assign(button, { type: "button", id: "match" });
  table.id = "comparison";
  note.id = "comparison-note";
  head.append(root.querySelector("h2"), button);
  root.append(head, note, table);
  button.addEventListener("click", () => connection.send({ do: "match" }));
  show(elements, null, false);
  // Rows of an earlier variant A are not those of the next one.
  const variants = new WeakMap();
  const hasNamed = () => (page.state?.variants || []).some((each) => each.is_compared);
  return {
    use(part) {
      if (!variants.has(part)) variants.set(part, page.frozen);
      const isCurrent = variants.get(part) === page.frozen && (page.frozen || hasNamed());
      show(elements, isCurrent ? part.about : null, Boolean(page.frozen));
    },
    onState() { if (!page.frozen && !hasNamed()) show(elements, null, false); },
  };
}
