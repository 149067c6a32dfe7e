// Form of a sweep: one or two settings with their values, and one or two results.

import { around, make } from "/web/page_parts.js";
import { ResultForm, orProblem, readNumber } from "./condition_form.js";
import { fieldText } from "./controls.js";
import { fieldOf, selectOf } from "./elements.js";
import { SettingSelect, isWide, presentOf, rangeAround } from "./number_settings.js";
import { numberOf } from "./numbers.js";

const N_VALUES = 9;
const SPACINGS = [["linear", "linear"], ["geometric", "logarithmic"]];
const DIRECTIONS = [["larger", "larger is better"], ["smaller", "smaller is better"]];
// All points of a sweep have the same noise.
const WITHOUT = ["seed"];

/** @type {(legend: string, ...elements: HTMLElement[]) => HTMLFieldSetElement} */
const groupOf = (legend, ...elements) => around("fieldset", "condition", make("legend", legend), ...elements);

// A setting, its range and the number of its values.
class AxisForm {
  // Whether the user has chosen the spacing of this setting.
  isChosen = false;

  constructor(legend, options = {}) {
    this.setting = new SettingSelect("Setting", { ...options, without: WITHOUT });
    this.from = fieldOf("From", { placeholder: "from" });
    this.to = fieldOf("To", { placeholder: "to" });
    this.n = fieldOf("Number of values", { placeholder: "values", value: String(N_VALUES) });
    this.unit = make("span", "", "quiet");
    this.spacing = selectOf(SPACINGS, "Spacing");
    this.root = groupOf(legend, this.setting.root, this.from, this.to, this.unit, this.n, this.spacing);
    this.spacing.addEventListener("change", () => { this.isChosen = true; });
    for (const field of [this.from, this.to]) field.addEventListener("change", () => this._chooseSpacing());
  }

  // Takes over the controls; the range of another setting is around its present value.
  follow(controls, state) {
    if (this.setting.follow(controls)) this.fill(state);
    this._show();
  }

  fill(state) {
    const { control } = this.setting;
    this.isChosen = false;
    if (control) {
      [this.from.value, this.to.value] = rangeAround(control, presentOf(state, control)).map((v) => fieldText(Number(v.toPrecision(6))));
      this._chooseSpacing();
    }
    this._show();
  }

  _show() {
    const { control } = this.setting, unit = control?.unit ?? "";
    for (const element of [this.from, this.to, this.unit, this.n, this.spacing]) element.hidden = !control;
    this.unit.textContent = unit;
    this.from.ariaLabel = "From" + (unit ? ", " + unit : "");
    this.to.ariaLabel = "To" + (unit ? ", " + unit : "");
  }

  _chooseSpacing() {
    if (this.isChosen) return;
    const unit = this.setting.control?.unit ?? "";
    this.spacing.value = isWide(numberOf(this.from.value, unit), numberOf(this.to.value, unit)) ? "geometric" : "linear";
  }

  // Returns the setting with its range; null where none is chosen.
  read() {
    const { control } = this.setting;
    if (!control) return null;
    const { key, unit } = control;
    return {
      key, from: readNumber(this.from, "the first value", unit), to: readNumber(this.to, "the last value", unit),
      n: readNumber(this.n, "the number of values", ""), spacing: this.spacing.value,
    };
  }
}

export class SweepForm {
  // changed() is called when a direction changes.
  constructor(studio, { changed }) {
    this.axes = [new AxisForm("Setting"), new AxisForm("Second setting", { none: "no second setting" })];
    this.results = [new ResultForm(studio.page), new ResultForm(studio.page, { none: "no second result" })];
    this.directions = this.results.map(() => selectOf(DIRECTIONS, "Direction"));
    this.run = make("button", "Run", { type: "button" });
    const results = this.results.map((form, i) => groupOf(i ? "Second result" : "Result", form.root, this.directions[i]));
    this.root = around("div", "sweep-form", ...this.axes.map(({ root }) => root), ...results, this.run);
    for (const axis of this.axes) axis.setting.root.addEventListener("change", () => { if (studio.state) axis.fill(studio.state); });
    this.results.forEach((form, i) => form.measure.addEventListener("change", () => { this._chooseDirection(i); changed(); }));
    for (const select of this.directions) select.addEventListener("change", changed);
    this.root.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target instanceof HTMLInputElement) this.run.click();
    });
    this._showDirections();
  }

  // Takes over the settings, and the results of the server.
  follow(controls, state, measures) {
    for (const axis of this.axes) axis.follow(controls, state);
    if (!measures || this.results[0].measures.length) return;
    this.results.forEach((form, i) => { form.use(measures); this._chooseDirection(i); });
  }

  _chooseDirection(i) {
    this.directions[i].value = this.results[i].about?.is_cost ? "smaller" : "larger";
    this._showDirections();
  }

  // Directions matter for two results only.
  _showDirections() { for (const select of this.directions) select.hidden = !this.results[1].measure.value; }

  // Whether smaller values of each result are better.
  get isSmaller() { return this.directions.map(({ value }) => value === "smaller"); }

  // Returns { settings, results } of the message, or { problem }.
  read() {
    return orProblem(() => ({
      settings: this.axes.map((axis) => axis.read()).filter(Boolean),
      results: this.results.map((form) => form.readResult()).filter(Boolean),
    }));
  }
}
