// Table of the rows of a gaze path: fields, deletion, and the row of the present time.

import { around, make } from "/web/page_parts.js";
import { fieldOf, titledButton } from "./elements.js";
import { rowAt } from "./gaze_rows.js";
import { numberOf } from "./numbers.js";

/** @typedef {import("./gaze_rows.js").GazeRow} GazeRow */

// Name, unit, and decimals that fields show.
/** @type {[string, string, number][]} */
const COLUMNS = [["time", "s", 4], ["x", "µm", 2], ["y", "µm", 2]];
// Rows that are shown at a time.
const MOST_ROWS = 50;

export class GazeTable {
  /** @type {GazeRow[]} */ rows = [];
  first = 0; current = -1; label = "";

  // Callbacks: changed(index, row), removed(index), inserted() for a row at the present time.
  /** @param {{ changed: (index: number, row: GazeRow) => void, removed: (index: number) => void, inserted: () => void }} on */
  constructor(on) {
    this.on = on;
    this.root = make("div", undefined, { className: "gaze-table", id: "gaze-table", role: "group", ariaLabel: "Rows of the gaze path" });
    this.insert = titledButton("Insert", "Insert the present gaze at the present time", () => this.on.inserted());
    this.earlier = titledButton("◂", "Earlier rows", () => this._turn(-MOST_ROWS));
    this.later = titledButton("▸", "Later rows", () => this._turn(MOST_ROWS));
    this.note = make("span", undefined, "quiet");
    const titles = COLUMNS.map(([name, unit]) => make("th", name + "\u00a0/\u00a0" + unit, { scope: "col" }));
    const heading = around("thead", {}, around("tr", {}, ...titles, make("td")));
    this.body = make("tbody");
    this.root.append(around("div", "gaze-head", this.insert, this.note, this.earlier, this.later),
      around("div", "gaze-rows", around("table", {}, heading, this.body)));
  }

  // Shows rows; those at the present time are marked, and shown first if the time has changed.
  /** @param {GazeRow[]} rows @param {number} t @param {number} step */
  use(rows, t, step) {
    const current = rowAt(rows, t, step), isMoved = current !== this.current;
    this.current = current;
    if (isMoved && !this.root.contains(document.activeElement)) this.first = this._pageOf(Math.max(0, current));
    if (rows !== this.rows) {
      this.rows = rows;
      this.first = Math.min(this.first, this._pageOf(Math.max(0, rows.length - 1)));
    }
    this._show();
    if (isMoved) this.body.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  }

  /** @param {number} index */
  _pageOf(index) { return MOST_ROWS * Math.floor(index / MOST_ROWS); }

  /** @param {number} by */
  _turn(by) {
    this.first = Math.max(0, Math.min(this._pageOf(this.rows.length - 1), this.first + by));
    this._show();
  }

  _show() {
    const { rows, first, body } = this, shown = rows.slice(first, first + MOST_ROWS), last = first + shown.length;
    while (body.rows.length > shown.length) body.deleteRow(-1);
    while (body.rows.length < shown.length) body.append(this._newRow(body.rows.length));
    shown.forEach((row, i) => this._fill(body.rows[i], first + i, row));
    const all = rows.length + (rows.length === 1 ? " row" : " rows");
    this.note.textContent = rows.length > MOST_ROWS ? (first + 1) + "–" + last + " of " + all : all;
    this.earlier.hidden = this.later.hidden = rows.length <= MOST_ROWS;
    this.earlier.disabled = first === 0;
    this.later.disabled = last >= rows.length;
  }

  // A line of the table, for the row at this distance from the first one.
  /** @param {number} i */
  _newRow(i) {
    const line = make("tr");
    COLUMNS.forEach((_, column) => {
      const field = fieldOf("", { inputMode: "decimal" });
      field.addEventListener("change", () => this._change(this.first + i, column, field));
      line.append(around("td", {}, field));
    });
    line.append(around("td", {}, titledButton("✕", "Delete", () => { this.on.removed(this.first + i); })));
    return line;
  }

  /** @param {HTMLTableRowElement} line @param {number} index @param {GazeRow} row */
  _fill(line, index, row) {
    line.querySelectorAll("input").forEach((field, column) => {
      const [name, unit, decimals] = COLUMNS[column], text = String(Number(row[column].toFixed(decimals)));
      field.ariaLabel = name + " of row " + (index + 1) + ", " + unit;
      // A text that is being typed stays.
      if (field !== document.activeElement || field.dataset.text !== text) field.value = text;
      field.dataset.text = text;
      field.removeAttribute("aria-invalid");
    });
    const button = line.querySelector("button");
    if (button) button.title = button.ariaLabel = "Delete row " + (index + 1);
    line.ariaCurrent = index === this.current ? "true" : null;
  }

  /** @param {number} index @param {number} column @param {HTMLInputElement} field */
  _change(index, column, field) {
    const value = numberOf(field.value, COLUMNS[column][1]), row = /** @type {GazeRow} */ ([...this.rows[index]]);
    if (!Number.isFinite(value)) {
      field.setAttribute("aria-invalid", "true");
      return;
    }
    row[column] = value;
    this.on.changed(index, row);
  }

  // Shows the values of the rows again, after a change that the server has rejected.
  restore() {
    for (const field of this.body.querySelectorAll("input")) field.value = field.dataset.text ?? "";
  }
}
