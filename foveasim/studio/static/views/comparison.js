// Table of the compared variants: budgets and picture quality.

import { quantity, shown } from "/web/colours.js";
import { make, setChoices } from "/web/page_parts.js";

const EMPTY = "Press A|B to keep the present sensor as A and change it, or compare named variants.";
// Notes on rows, by name.
const NOTES = { frames_per_s: "At the highest data rate of the variants",
  median_e: "Median over all photosites; saturated ones count with their clipped signal",
  read_noise_e: "Median over all photosites, without quantisation",
  readout_steps: "Photosites on the longest readout line; lines are read in parallel", area_mm2: "Total area of the photosites" };
// What B can have in common with A.
/** @type {[string, string][]} */
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

function heading(text) {
  const cell = make("th", text);
  cell.scope = "col";
  return cell;
}

// Shows a comparison; null without variants.
function show({ table, note, match }, about, hasMatch) {
  table.hidden = !about;
  match.hidden = !about || !hasMatch;
  note.textContent = about ? "" : EMPTY;
  if (!about) return;
  const sizes = [about.fovea_um, about.field_um].map((side) => shown(Math.round(side))), { names } = about;
  const head = make("tr"), isQuality = (name) => /^(fovea|field)_/.test(name);
  head.append(make("td"), ...names.map(heading), heading(names[names.length - 1] + " − " + names[0]));
  const rows = about.rows.map(({ name, label, unit, values, best }) => {
    const row = make("tr"), title = make("th", label + (isQuality(name) && !about.has_equal_fields ? " (fields differ)" : ""));
    title.scope = "row";
    row.dataset.name = name;
    title.title = NOTES[name] || "";
    if (isQuality(name)) title.title = "Against the optical image, after a fit of one gain, on a square of "
      + sizes[name.startsWith("fovea") ? 0 : 1] + " µm";
    row.append(title, ...values.map((value, k) => {
      const cell = make("td", name === "n_sites" ? shown(value) : figure(value, unit));
      cell.classList.toggle("best", best.includes(k));
      return cell;
    }), make("td", difference(values, unit)));
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
  const head = make("div", undefined, "head"), button = make("button", "Match B to A"), table = make("table");
  const note = make("p", "", "quiet"), match = make("span", undefined, "match"), what = make("select");
  const elements = { table, note, match };
  setChoices(what, MATCHES);
  what.id = "match-what";
  what.setAttribute("aria-label", "What B has in common with A");
  match.append(what, button);
  Object.assign(button, { type: "button", id: "match" });
  table.id = "comparison";
  note.id = "comparison-note";
  head.append(root.querySelector("h2"), match);
  root.append(head, note, table);
  button.addEventListener("click", () => connection.send({ do: "match", what: /** @type {any} */ (what.value) }));
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
