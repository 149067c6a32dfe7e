// List of violations of design rules.

import { shown } from "./colours.js";
import { around, change, make, setChoices } from "./page_parts.js";
import { Violations } from "./violations.js";

const AT_A_TIME = 200;
export const VIOLATION_ARRAYS = [
  "violation_value", "violation_sites", "violation_site_counts", "marker_part_counts", "marker_sizes", "marker_xy_um",
];

export class RulesList {
  select; note; list; more; fly; listed = 0;
  /** @type {Violations | null} */ violations = null;
  /** @type {number | null} */ chosen = null;

  // Elements: a choice of rules, a note, the list, a button for more of it. fly(i) is called when a violation is chosen.
  constructor({ select, note, list, more }, fly) {
    Object.assign(this, { select, note, list, more, fly });
    this.rules = [];
    this.select.addEventListener("change", () => { this.choose(null); this._list(true); });
    this.more.addEventListener("click", () => this._list(false));
    this.list.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key], buttons = [...this.list.querySelectorAll("button")];
      const next = buttons[buttons.indexOf(document.activeElement) + step];
      if (step && next) { next.focus(); event.preventDefault(); }
    });
  }

  get rule() { return Number(this.select.value); }

  use(rules, arrays, sites) {
    const before = this.rules[this.rule]?.name;
    this.rules = rules;
    this.sites = sites;
    this.violations = rules.length && VIOLATION_ARRAYS.every((name) => arrays[name]) ? new Violations(arrays, rules, sites) : null;
    this.chosen = null;
    const total = rules.reduce((sum, rule) => sum + rule.count, 0);
    const textOf = ({ name, count, waiver }) => name + " (" + shown(count) + (waiver ? ", waived)" : ")");
    setChoices(this.select, [["-1", "all (" + shown(total) + ")"], ...rules.map((rule, k) => [String(k), textOf(rule)])]);
    change(this.select, { value: String(Math.max(-1, rules.findIndex((rule) => rule.name === before))), hidden: !rules.length });
    this._list(true);
  }

  _list(isNew) {
    const { rules, violations, rule } = this, of = [];
    if (isNew) { this.listed = 0; this.list.replaceChildren(); }
    if (violations) for (let i = 0; i < violations.n; i++) if (rule < 0 || violations.rule[i] === rule) of.push(i);
    const next = of.slice(this.listed, this.listed + AT_A_TIME);
    if (violations) this.list.append(...next.map((i) => this._item(violations, i)));
    this.listed += next.length;
    this.more.hidden = this.listed >= of.length;
    this.note.textContent = rules.length ? this._describe() : "The settings have no design rules.";
  }

  _describe() {
    const { rules, rule } = this, chosen = rule < 0 ? rules : [rules[rule]];
    const sum = (key) => chosen.reduce((total, each) => total + each[key], 0);
    const rest = sum("listed") < sum("count") ? " The worst " + shown(sum("listed")) + " are listed." : "";
    if (rule < 0) {
      const met = rules.filter((one) => !one.count).length, all = shown(rules.length);
      return (met === rules.length ? "All " + all + " rules are satisfied." : shown(met) + " of " + all + " rules are satisfied.") + rest;
    }
    const { description, limit, unit, waiver } = rules[rule];
    const bound = limit === null ? "" : "; the limit is " + shown(limit) + (unit ? " " + unit : "");
    return description + bound + "." + (waiver ? " Waived: " + waiver + "." : "") + rest;
  }

  _item(violations, i) {
    const { rule, sites, value } = violations.describe(i);
    const title = rule.name + ": " + sites + (value ? ", " + value : "");
    const button = around("button", { type: "button", title },
      make("span", this.rule < 0 ? rule.name + ": " + sites : sites), make("span", value));
    button.dataset.violation = i;
    button.addEventListener("click", () => { this.choose(i); this.fly(i); });
    return around("li", {}, button);
  }

  choose(i) {
    this.chosen = i;
    for (const button of this.list.querySelectorAll("button")) {
      if (Number(button.dataset.violation) === i) button.setAttribute("aria-current", "true");
      else button.removeAttribute("aria-current");
    }
  }

  // Position and scale at which a map shows a violation, or null.
  frameOf(i, map) {
    if (!this.violations) return null;
    const [a, b, c, d] = this.violations.boxes.subarray(4 * i, 4 * i + 4), wide = this.violations.widthOf(i, this.sites) || 1;
    return Number.isFinite(a) ? [0.5 * (a + c), 0.5 * (b + d), (0.3 * Math.min(map.width, map.height)) / wide] : null;
  }

  // Returns the chosen violation as a path with its box, or null; also for sites other than those of the violations.
  traceOn(sites) {
    const { violations, chosen } = this;
    if (!violations || chosen === null || sites !== this.sites) return null;
    return { path: (context, map) => violations.trace(context, chosen, map), box: violations.boxes.subarray(4 * chosen, 4 * chosen + 4) };
  }

  // Draws markers of the listed violations in view; none on sites other than those of the violations.
  draw(context, map, sites) {
    if (sites === this.sites) this.violations?.drawMarkers(context, map, this.rule);
  }
}
