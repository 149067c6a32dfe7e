// Form of a requirement: a result, the photosites it is of, and a limit.

import { make } from "/web/page_parts.js";
import { numberOf } from "./numbers.js";

const REGIONS = [["all", "all photosites"], ["site", "pinned photosite"], ["rectangle", "selected rectangle"],
  ["annulus", "annulus around the centre"]];
const LIMITS = [["at_least", "at least"], ["at_most", "at most"], ["equal", "equals"]];

/** @type {(choices: string[][], label: string) => HTMLSelectElement} */
function selectOf(choices, label) {
  const select = make("select");
  select.setAttribute("aria-label", label);
  for (const [value, text] of choices) select.append(new Option(text, value));
  return select;
}

/** @type {(label: string, placeholder: string) => HTMLInputElement} */
function fieldOf(label, placeholder) {
  const field = make("input");
  Object.assign(field, { type: "text", placeholder, autocomplete: "off", spellcheck: false });
  field.setAttribute("aria-label", label);
  return field;
}

export class ConditionForm {
  // page: the pinned photosite and the selected rectangle; hasEqual: whether a result may have to equal a value.
  constructor(page, { hasEqual = true } = {}) {
    this.page = page;
    this.measures = [];
    this.measure = selectOf([], "Result");
    this.region = selectOf(REGIONS, "Photosites");
    this.inner = fieldOf("Inner radius, µm", "from / µm");
    this.outer = fieldOf("Outer radius, µm", "to / µm");
    this.frequency = fieldOf("Spatial frequency, per mm", "1/mm");
    this.limit = selectOf(hasEqual ? LIMITS : LIMITS.slice(0, 2), "Condition");
    this.value = fieldOf("Value", "value");
    this.root = make("div", undefined, "condition");
    this.root.append(this.measure, this.frequency, this.region, this.inner, this.outer, this.limit, this.value);
    for (const select of [this.measure, this.region]) select.addEventListener("change", () => this._show());
    this._show();
  }

  // Takes over the results of the server.
  use(measures) {
    if (this.measures.length) return;
    this.measures = measures;
    for (const { name, label } of measures) this.measure.append(new Option(label, name));
    this._show();
  }

  _show() {
    const about = this.measures.find(({ name }) => name === this.measure.value), hasRegion = !about || about.has_region;
    this.frequency.hidden = this.measure.value !== "mtf";
    this.region.hidden = !hasRegion;
    this.inner.hidden = this.outer.hidden = !hasRegion || this.region.value !== "annulus";
  }

  // Returns { requirement } as in settings, or { problem }.
  read() {
    const name = this.measure.value, about = this.measures.find((each) => each.name === name);
    /** @type {{ [key: string]: unknown }} */
    const requirement = { measure: name };
    const number = (field, what, unit = "µm") => {
      const found = numberOf(field.value, unit);
      if (!Number.isFinite(found)) throw new Error("Enter " + what + " as a number");
      return found;
    };
    try {
      const value = number(this.value, "the value", about?.unit ?? "");
      if (this.limit.value !== "at_most") requirement.at_least = value;
      if (this.limit.value !== "at_least") requirement.at_most = value;
      if (name === "mtf") requirement.frequency_per_mm = number(this.frequency, "the spatial frequency", "");
      if (about?.has_region) this._readRegion(requirement, number);
    } catch (error) {
      return { problem: error instanceof Error ? error.message : String(error) };
    }
    return { requirement };
  }

  _readRegion(requirement, number) {
    const { pinned, rectangle } = this.page, kind = this.region.value;
    if (kind === "annulus") requirement.annulus_um = [number(this.inner, "the inner radius"), number(this.outer, "the outer radius")];
    else if (kind === "site") {
      if (pinned < 0) throw new Error("Click a photosite to pin it first");
      requirement.site = pinned;
    } else if (kind === "rectangle") {
      if (!rectangle) throw new Error("Select photosites first (key S)");
      const [[ax, ay], [bx, by]] = rectangle;
      const corners = [Math.min(ax, bx), Math.min(ay, by), Math.max(ax, bx), Math.max(ay, by)];
      requirement.rectangle_um = corners.map((v) => Number(v.toPrecision(6)));
    }
  }
}
