// What is wrong with the present design: violations, photosites outside the image, saturation, warnings; the worst first.

import { shown } from "/web/colours.js";
import { $, change, find, make } from "/web/page_parts.js";

// Fractions of saturated photosites that are reported, and reported as wrong.
const SATURATED = 0.01, MANY_SATURATED = 0.2;
const OUTSIDE = /outside the image/;

export const percent = (fraction) => shown(Number((100 * fraction).toPrecision(2))) + " %";

// Returns problems as { text, view, count, isMild, canFit }; count is the badge of the tab of their view.
/** @param {State} state @param {{ [name: string]: Part }} parts */
export function problemsOf(state, { rules, requirements }) {
  const found = [], { warnings, summary, notes } = state, saturated = summary.saturated_fraction ?? 0;
  const violations = (rules?.about.rules || []).reduce((sum, { count }) => sum + count, 0);
  if (violations) found.push({ text: shown(violations) + " violation" + (violations === 1 ? "" : "s") + " of design rules", view: "rules",
    count: shown(violations), isMild: false, canFit: false });
  const all = requirements?.about.rows || [], unmet = all.filter((row) => !row.is_met).length;
  if (unmet) found.push({ text: shown(unmet) + " of " + shown(all.length) + " requirements not met", view: "requirements",
    count: shown(unmet), isMild: false, canFit: false });
  const isOutside = (warning) => OUTSIDE.test(warning);
  for (const text of warnings.filter(isOutside)) found.push({ text, view: "summary", count: "", isMild: false, canFit: true });
  if (saturated >= SATURATED) found.push({ text: percent(saturated) + " of the photosites are saturated", view: "histogram",
    count: percent(saturated), isMild: saturated < MANY_SATURATED, canFit: false });
  const others = [...warnings.filter((warning) => !isOutside(warning)), ...notes];
  for (const text of others) found.push({ text, view: "summary", count: "", isMild: true, canFit: false });
  return found;
}

export class Problems {
  /** @type {ReturnType<typeof problemsOf>} */ found = [];
  shown = "";

  // show(view) opens a tile; fit() lets the image cover the photosites.
  /** @param {{ show: (view: string) => void, fit: () => void }} on */
  constructor(on) {
    $("worst-text").addEventListener("click", () => { if (this.found.length) on.show(this.found[0].view); });
    $("fit-scene").addEventListener("click", on.fit);
  }

  /** @param {State} state @param {{ [name: string]: Part }} parts */
  update(state, parts) {
    this.found = problemsOf(state, parts);
    const text = JSON.stringify(this.found);
    if (text === this.shown) return;
    this.shown = text;
    const [worst] = this.found, more = this.found.length - 1;
    change($("worst-text"), { hidden: !worst, textContent: worst ? worst.text + (more > 0 ? " (+" + more + ")" : "") : "",
      title: this.found.map((one) => one.text).join("\n") });
    $("worst-text").classList.toggle("mild", Boolean(worst?.isMild));
    change($("fit-scene"), { hidden: !this.found.some((one) => one.canFit) });
    for (const view of ["rules", "requirements", "summary", "histogram"]) this._mark(view, this.found.filter((one) => one.view === view));
  }

  // The badge of a tab: a number that the problem has, or the number of problems.
  _mark(view, problems) {
    const button = document.querySelector(`#tabs button[data-tile="${view}"]`);
    if (!button) return;
    button.querySelector(".count")?.remove();
    if (!problems.length) return;
    const badge = make("span", problems[0].count || shown(problems.length), "count");
    badge.classList.toggle("mild", problems.every((one) => one.isMild));
    badge.title = problems.map((one) => one.text).join("\n");
    find(document, `#tabs button[data-tile="${view}"]`).append(badge);
  }
}
