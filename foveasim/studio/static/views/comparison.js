// Table of the compared variants: budgets and picture quality.

import { quantity, shown } from "/web/colours.js";
import { around, make } from "/web/page_parts.js";
import { buttonOf, selectOf } from "../elements.js";

const EMPTY = "Press A|B to keep the present sensor as A and change it, or compare named variants.";
// Notes on rows, by name.
const NOTES = { frames_per_s: "At the highest data rate of the variants",
  median_e: "Median over all photosites; saturated ones count with their clipped signal",
  read_noise_e: "Median over all photosites, without quantisation",
  readout_steps: "Photosites on the longest readout line; lines are read in parallel", area_mm2: "Total area of the photosites" };
// What B can have in common with A.
const MATCHES = [["field", "same field"], ["n_sites", "same number of photosites"], ["both", "same field and number"],
  ["data_rate", "same data rate"]];
// Four digits; "∞" for an infinite value, "–" without value.
function figure(value, unit) {
  if (typeof value !== "number") return value ? "∞" : "–";
  return quantity(Number(value.toPrecision(4)), unit);
}

// The last value minus the first one, with its sign.
function difference([first, ...others], unit) {
  const last = others[others.length - 1];
  if (typeof first !== "number" || typeof last !== "number") return "–";
  return last === first ? "0" : (last > first ? "+" : "−") + figure(Math.abs(last - first), unit);
}

const heading = (text) => make("th", text, { scope: "col" });

// Shows a comparison; null without variants.
function show({ table, note, match }, about, hasMatch) {
  table.hidden = !about;
  match.hidden = !about || !hasMatch;
  note.textContent = about ? "" : EMPTY;
  if (!about) return;
  const sizes = [about.fovea_um, about.field_um].map((side) => shown(Math.round(side))), { names } = about;
  const isQuality = (name) => /^(fovea|field)_/.test(name);
  const head = around("tr", {}, make("td"), ...names.map(heading), heading(names[names.length - 1] + " − " + names[0]));
  const rows = about.rows.map(({ name, label, unit, values, best }) => {
    const title = make("th", label + (isQuality(name) && !about.has_equal_fields ? " (fields differ)" : ""), { scope: "row" });
    title.title = NOTES[name] || "";
    if (isQuality(name)) title.title = "Against the optical image, after a fit of one gain, on a square of "
      + sizes[name.startsWith("fovea") ? 0 : 1] + " µm";
    const cells = values.map((value, k) =>
      make("td", name === "n_sites" ? shown(value) : figure(value, unit), best.includes(k) ? "best" : {}));
    const row = around("tr", {}, title, ...cells, make("td", difference(values, unit)));
    row.dataset.name = name;
    row.classList.toggle("differs", values.some((value) => value !== values[0]));
    return row;
  });
  table.replaceChildren(head, ...rows);
  const button = match.querySelector("button");
  button.disabled = !about.can_match;
  button.title = about.can_match ? "" : "The layout of B has no generator";
  if (!about.has_equal_fields) note.textContent = "The fields differ: "
    + names.map((name, k) => name + " " + about.sizes_um[k].map((side) => shown(Math.round(side))).join(" × ") + " µm").join(", ")
    + ". PSNR and SSIM compare squares of " + sizes.join(" and ") + " µm around the fovea of each.";
}

export function create(root, { page, connection }) {
  const what = selectOf(MATCHES, "What B has in common with A"), table = make("table", undefined, { id: "comparison" });
  const button = buttonOf("Match B to A", () => connection.send({ do: "match", what: /** @type {any} */ (what.value) }), { id: "match" });
  const note = make("p", "", { className: "quiet", id: "comparison-note" }), match = around("span", "match", what, button);
  const elements = { table, note, match };
  what.id = "match-what";
  root.append(around("div", "head", root.querySelector("h2"), match), note, table);
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
