// Table of the points of a sweep; a button in each row applies its settings.

import { make } from "/web/page_parts.js";

const cellText = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(4))) : value > 0 ? "∞" : value < 0 ? "−∞" : "–");

export class SweepTable {
  n = 0;

  /** @param {HTMLElement} root @param {(k: number) => void} choose */
  constructor(root, choose) {
    this.choose = choose;
    this.root = make("div", undefined, "sweep-table");
    // Tables scroll, also by keys.
    this.root.tabIndex = 0;
    this.root.setAttribute("role", "group");
    this.root.setAttribute("aria-label", "Points of the sweep");
    root.append(this.root);
  }

  // Takes over points: rows are added, so that the focus remains.
  use(points) {
    if (!this.body || points.values.length < this.n) this._create(points);
    for (; this.n < points.values.length; this.n++) this.body?.append(this._row(points, this.n));
  }

  _create({ titles }) {
    const table = make("table"), head = make("thead"), row = make("tr");
    row.append(make("td"));
    for (const title of titles) {
      const cell = make("th", title);
      cell.scope = "col";
      row.append(cell);
    }
    head.append(row);
    this.body = make("tbody");
    this.n = 0;
    table.append(head, this.body);
    this.root.replaceChildren(table);
  }

  _row(points, k) {
    const row = make("tr"), button = make("button", "Apply"), cell = make("td");
    button.type = "button";
    button.setAttribute("aria-label", "Apply " + points.settingsText(k));
    button.addEventListener("click", () => this.choose(k));
    cell.append(button);
    row.append(cell, ...[...points.settings(k), ...points.values[k]].map((value) => make("td", cellText(value))));
    return row;
  }
}
