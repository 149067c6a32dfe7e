// Dialog of repairs: what each method would change, from the server, and a button that applies it.

import { make } from "/web/page_parts.js";

const METHODS = { best: "Merge small, cut close, drop others", drop: "Drop all that violate a rule", shrink: "Cut close, drop others",
  merge: "Merge small, drop others", refill: "Drop, and refill with hexagons" };
// Fractions of photosites and of the area below which a repair is marked.
const FEW = 0.9, SMALL = 0.99, LOSS = "\nloses more than a tenth of the photosites, or 1 % of the area";

export class RepairDialog {
  root = make("dialog"); list = make("ul", undefined, "repairs");
  // Number of the message that asked for the previews.
  /** @type {number | null} */ asked = null;

  // apply(method) applies a repair; cancel() stops the previews.
  constructor(on) {
    const title = make("h2", "Repair"), form = make("form");
    this.root.id = "repair-dialog";
    this.root.setAttribute("aria-labelledby", title.id = "repair-title");
    form.method = "dialog";
    form.append(make("button", "Cancel"));
    for (const [method, label] of Object.entries(METHODS)) {
      const item = make("li"), use = make("button", label);
      use.type = "button";
      use.addEventListener("click", () => { this.root.close(method); on.apply(method); });
      item.dataset.method = method;
      item.append(use, make("p"));
      this.list.append(item);
    }
    this.root.append(title, this.list, form);
    this.root.addEventListener("close", () => { if (!this.root.returnValue && this.list.querySelector(".pending")) on.cancel(); });
    document.body.append(this.root);
  }

  /** @param {number | null} asked */
  open(asked) {
    this.asked = asked;
    this.root.returnValue = "";
    for (const item of this.list.children) this._fill(item, "computing…", "pending");
    this.root.showModal();
  }

  _fill(item, text, state = "") {
    item.className = state;
    item.querySelector("button").disabled = ["pending", "impossible"].includes(state);
    item.querySelector("p").textContent = text;
  }

  /** @param {RepairPreview} found */
  show({ id, method, text, before, after }) {
    const isLost = before && after && (after.n_sites < FEW * before.n_sites || after.area_um2 < SMALL * before.area_um2);
    if (id === this.asked) this._fill(this.list.querySelector(`[data-method=${method}]`), text + (isLost ? LOSS : ""),
      after?.n_sites ? (isLost ? "lossy" : "") : "impossible");
  }
}
