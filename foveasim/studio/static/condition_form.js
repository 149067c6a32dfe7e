// Forms of a result with the photosites it is of, and of a requirement, which limits one.

import { around } from "/web/page_parts.js";
import { fieldOf, selectOf } from "./elements.js";
import { numberOf } from "./numbers.js";

const REGIONS = [["all", "all photosites"], ["site", "pinned photosite"], ["rectangle", "selected rectangle"],
  ["annulus", "annulus around the centre"]];
const LIMITS = [["at_least", "at least"], ["at_most", "at most"], ["equal", "equals"]];

// The number in a field; an error explains what is missing.
/** @type {(field: HTMLInputElement, what: string, unit: string) => number} */
export function readNumber(field, what, unit) {
  const found = numberOf(field.value, unit);
  if (!Number.isFinite(found)) throw new Error("Enter " + what + " as a number");
  return found;
}

// What a function returns, or { problem } where it throws an error that explains what is missing.
/** @type {(read: () => { [name: string]: any }) => { [name: string]: any }} */
export function orProblem(read) {
  try { return read(); } catch (error) { return { problem: error instanceof Error ? error.message : String(error) }; }
}

export class ResultForm {
  // page: the pinned photosite and the selected rectangle; none: text of the choice of no result.
  /** @param {any} page @param {{ none?: string }} [options] */
  constructor(page, { none } = {}) {
    this.page = page;
    this.measures = [];
    this.measure = selectOf(none === undefined ? [] : [["", none]], "Result");
    this.region = selectOf(REGIONS, "Photosites");
    this.inner = fieldOf("Inner radius, µm", { placeholder: "from / µm" });
    this.outer = fieldOf("Outer radius, µm", { placeholder: "to / µm" });
    this.frequency = fieldOf("Spatial frequency, per mm", { placeholder: "1/mm" });
    this.root = around("div", "condition", this.measure, this.frequency, this.region, this.inner, this.outer);
    for (const select of [this.measure, this.region]) select.addEventListener("change", () => this._show());
    this._show();
  }

  get about() { return this.measures.find(({ name }) => name === this.measure.value); }

  // Takes over the results of the server.
  use(measures) {
    if (this.measures.length) return;
    this.measures = measures;
    for (const { name, label } of measures) this.measure.append(new Option(label, name));
    this._show();
  }

  _show() {
    const { about } = this, hasRegion = this.measures.length ? Boolean(about?.has_region) : true;
    this.frequency.hidden = this.measure.value !== "mtf";
    this.region.hidden = !hasRegion;
    this.inner.hidden = this.outer.hidden = !hasRegion || this.region.value !== "annulus";
  }

  // Returns the result as in settings; null where none is chosen. Throws an error that explains what is missing.
  readResult() {
    const { about } = this;
    if (!about) return null;
    /** @type {{ [key: string]: unknown }} */
    const result = { measure: about.name };
    if (about.name === "mtf") result.frequency_per_mm = readNumber(this.frequency, "the spatial frequency", "");
    if (about.has_region) this._readRegion(result);
    return result;
  }

  _readRegion(result) {
    const { pinned, rectangle } = this.page, kind = this.region.value;
    if (kind === "annulus") {
      result.annulus_um = [readNumber(this.inner, "the inner radius", "µm"), readNumber(this.outer, "the outer radius", "µm")];
    } else if (kind === "site") {
      if (pinned < 0) throw new Error("Click a photosite to pin it first");
      result.site = pinned;
    } else if (kind === "rectangle") {
      if (!rectangle) throw new Error("Select photosites first (key S)");
      const [[ax, ay], [bx, by]] = rectangle;
      const corners = [Math.min(ax, bx), Math.min(ay, by), Math.max(ax, bx), Math.max(ay, by)];
      result.rectangle_um = corners.map((v) => Number(v.toPrecision(6)));
    }
  }
}

export class ConditionForm extends ResultForm {
  constructor(page) {
    super(page);
    this.limit = selectOf(LIMITS, "Condition");
    this.value = fieldOf("Value", { placeholder: "value" });
    this.root.append(this.limit, this.value);
  }

  // Returns { requirement } as in settings, or { problem }.
  read() {
    return orProblem(() => {
      const value = readNumber(this.value, "the value", this.about?.unit ?? ""), requirement = { ...this.readResult() };
      if (this.limit.value !== "at_most") requirement.at_least = value;
      if (this.limit.value !== "at_least") requirement.at_most = value;
      return { requirement };
    });
  }
}
