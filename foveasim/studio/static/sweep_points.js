// Points of a sweep: their settings and results as the server sends them, texts, and the Pareto front.

import { axisTitle } from "./charts.js";
import { quantity } from "./numbers.js";
import { percent } from "./problems.js";
import { figure } from "./views/requirements.js";

const NUMBERS = { ".inf": Infinity, "-.inf": -Infinity };
// Infinite results are texts in JSON, and missing ones null.
const numberOfResult = (value) => (typeof value === "number" ? value : NUMBERS[value] ?? NaN);

// Indices of the points that no other point dominates, by their first result; isSmaller: whether smaller values are better.
/** @type {(results: number[][], isSmaller: boolean[]) => number[]} */
export function paretoFront(results, isSmaller) {
  const signs = isSmaller.map((smaller) => (smaller ? -1 : 1));
  const scored = results.map((values, k) => ({ k, scores: values.map((value, i) => signs[i] * value) }))
    .filter(({ scores }) => scores.every((score) => !Number.isNaN(score)));
  // From the best first result on, each point must be better in the second one than all before.
  scored.sort((a, b) => b.scores[0] - a.scores[0] || b.scores[1] - a.scores[1] || a.k - b.k);
  let best = -Infinity, first = NaN;
  const front = scored.filter(({ scores: [one, other] }) => {
    const isEqual = one === first && other === best, isBetter = other > best;
    if (isBetter) { best = other; first = one; }
    return isBetter || isEqual;
  });
  return front.map(({ k }) => k);
}

export class SweepPoints {
  /** @param {SweepMessage} message */
  constructor({ axes, results, points, start, saturated, n_points: n }) {
    this.n = n;
    this.axes = axes;
    this.measures = results;
    this.values = points.map((each) => each.map(numberOfResult));
    this.start = start;
    // Fractions of saturated photosites, if a result depends on them.
    this.saturated = saturated;
  }

  // Settings of a point, in the order of the axes; the last axis varies fastest.
  /** @param {number} k */
  settings(k) {
    const [first, second] = this.axes;
    return second ? [first.values[Math.floor(k / second.values.length)], second.values[k % second.values.length]] : [first.values[k]];
  }

  // Titles of the settings and of the results.
  get titles() {
    return [...this.axes.map(({ label, unit }) => axisTitle(label, unit)),
      ...this.measures.map(({ subject, unit }) => axisTitle(subject, unit)), ...(this.saturated ? ["saturated / %"] : [])];
  }

  // Numbers of a point below these titles.
  /** @param {number} k */
  row(k) { return [...this.settings(k), ...this.values[k], ...(this.saturated ? [100 * this.saturated[k]] : [])]; }

  // Results of all points so far.
  /** @param {number} j */
  result(j) { return this.values.map((each) => each[j]); }

  // The point with these settings, or -1.
  /** @param {number[]} settings */
  indexOf(settings) { return this.values.findIndex((_, k) => this.settings(k).every((value, i) => value === settings[i])); }

  // Results of the present settings, if they are those of a point or of the start.
  /** @param {number[]} settings */
  present(settings) {
    const k = this.indexOf(settings), { start } = this;
    if (k >= 0) return this.values[k];
    return start.results && start.settings.every((value, i) => value === settings[i]) ? start.results.map(numberOfResult) : null;
  }

  /** @param {number} k */
  settingsText(k) {
    return this.settings(k).map((value, i) => this.axes[i].label + " " + quantity(value, this.axes[i].unit)).join(", ");
  }

  /** @param {number} k */
  text(k) {
    const results = this.values[k].map((value, j) => this.measures[j].subject + " "
      + figure(Number.isFinite(value) ? value : value > 0 ? ".inf" : value < 0 ? "-.inf" : null, this.measures[j].unit));
    return this.settingsText(k) + ": " + results.join(", ") + (this.saturated?.[k] ? ", " + percent(this.saturated[k]) + " saturated" : "");
  }

  // Rows of a file: the settings and results of all points so far, and further columns.
  /** @type {(more?: { [name: string]: (k: number) => string | number }) => (string | number)[][]} */
  rows(more = {}) {
    return [[...this.titles, ...Object.keys(more)], ...this.values.map((_, k) =>
      [...this.row(k).map((value) => (Number.isNaN(value) ? "" : value)), ...Object.values(more).map((of) => of(k))])];
  }
}
