// Dialog of repairs: what each method would change, from the server, and a button that applies it.

import { $ } from "/web/page_parts.js";

// Fractions of photosites and of the area below which a repair is marked.
const FEW = 0.9, SMALL = 0.99, LOSS = "\nloses more than a tenth of the photosites, or 1 % of the area";

export class RepairDialog {
  root = $("repair-dialog");
  // Number of the message that asked for the previews.
  /** @type {number | null} */ asked = null;

  // apply(method) applies a repair; cancel() stops the previews.
  constructor(on) {
    this.root.addEventListener("close", () => {
      const { returnValue: method } = this.root;
      if (method) on.apply(method);
      else if (this.root.querySelector(".pending")) on.cancel();
    });
  }

  /** @param {number | null} asked */
  open(asked) {
    this.asked = asked;
    this.root.returnValue = "";
    for (const item of this.root.querySelectorAll("li")) this._fill(item, "computing…", "pending");
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
    if (id === this.asked) this._fill(this.root.querySelector(`[data-method=${method}]`), text + (isLost ? LOSS : ""),
      after?.n_sites ? (isLost ? "lossy" : "") : "impossible");
  }
}
