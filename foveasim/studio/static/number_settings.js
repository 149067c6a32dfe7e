// Settings that are numbers, for forms that change one or two of them.

import { valueAt } from "./controls.js";
import { selectOf } from "./elements.js";

// Positive ranges from this ratio of their ends are logarithmic.
const WIDE_RATIO = 50;
// Without a range of its own, a number is changed by this factor.
const FACTOR = 10;

/** @type {(low: number, high: number) => boolean} */
export const isWide = (low, high) => low > 0 && high / low >= WIDE_RATIO;

// The exposure is a number, also where it is automatic.
const isNumber = ({ kind, key }) => kind === "number" || kind === "integer" || (kind === "text" && key === "exposure_s");

// The present value of a setting; NaN for none.
/** @type {(state: State, control: { key: string, default?: any }) => number} */
export function presentOf({ settings, solved, summary }, { key, default: initial }) {
  const value = valueAt(settings, key) ?? solved?.[key] ?? initial;
  if (key === "exposure_s" && typeof value !== "number") return summary.exposure_s ?? NaN;
  return typeof value === "number" ? value : NaN;
}

// The suggested range of a setting around its present value.
/** @type {(control: Control, present: number) => Interval} */
export function rangeAround({ suggested }, present) {
  const [low, high] = suggested ?? (present > 0 ? [present / FACTOR, present * FACTOR] : [0, 1]);
  return Number.isFinite(present) ? [Math.min(low, present), Math.max(high, present)] : [low, high];
}

// A choice of a setting that is a number; its list follows the controls.
export class SettingSelect {
  /** @type {Map<string, { name: string, control: Control }>} */ rows = new Map();
  /** @type {string | undefined} */ none;
  /** @type {string[]} */ without;
  names = "";

  // none: text of the choice of no setting; without: keys that cannot be chosen; wanted: key that is chosen at first.
  /** @param {string} label @param {{ none?: string, without?: string[], wanted?: string }} [options] */
  constructor(label, { none, without = [], wanted = "exposure_s" } = {}) {
    this.none = none;
    this.without = without;
    this.wanted = none === undefined ? wanted : "";
    this.root = selectOf([], label);
  }

  get control() { return this.rows.get(this.root.value)?.control; }

  // Takes over the controls; returns whether another setting is chosen.
  follow(controls) {
    const rows = [...controls.rows.values()].filter(({ control }) => isNumber(control) && !this.without.includes(control.key));
    const before = this.root.value, names = rows.map(({ name, control }) => name + control.key).join();
    this.rows = new Map(rows.map((row) => [row.control.key, row]));
    if (names === this.names) return false;
    this.names = names;
    const chosen = before || this.wanted;
    const none = this.none === undefined ? [] : [new Option(this.none, "")];
    this.root.replaceChildren(...none, ...rows.map(({ name, control: { key } }) => new Option(name, key)));
    this.root.value = this.rows.has(chosen) ? chosen : this.none === undefined ? rows[0]?.control.key ?? "" : "";
    return this.root.value !== before;
  }
}
