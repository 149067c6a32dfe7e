// Table of the points of a sweep; a button in each row applies its settings.

import { around, make } from "/web/page_parts.js";
import { buttonOf } from "./elements.js";

const cellText = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(4))) : value > 0 ? "∞" : value < 0 ? "−∞" : "–");

export class SweepTable {
  n = 0;

  /** @param {HTMLElement} root @param {(k: number) => void} choose */
  constructor(root, choose) {
    this.choose = choose;
    // Tables scroll, also by keys.
    this.root = make("div", undefined, { className: "sweep-table", tabIndex: 0, role: "group", ariaLabel: "Points of the sweep" });
    root.append(this.root);
  }

  // Takes over points: rows are added, so that the focus remains.
  use(points) {
    if (!this.body || points.values.length < this.n) this._create(points);
    for (; this.n < points.values.length; this.n++) this.body?.append(this._row(points, this.n));
  }

  _create({ titles }) {
    const row = around("tr", {}, make("td"), ...titles.map((title) => make("th", title, { scope: "col" })));
    this.body = make("tbody");
    this.n = 0;
    this.root.replaceChildren(around("table", {}, around("thead", {}, row), this.body));
  }

  _row(points, k) {
    const button = buttonOf("Apply", () => this.choose(k), { ariaLabel: "Apply " + points.settingsText(k) });
    return around("tr", {}, around("td", {}, button), ...points.row(k).map((value) => make("td", cellText(value))));
  }
}
