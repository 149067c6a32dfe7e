// Design rules: their results, and violations that the map flies to.

import { shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";
import { Violations } from "/web/violations.js";

const AT_A_TIME = 100;
const ARRAYS = ["violation_value", "violation_sites", "violation_site_counts", "marker_part_counts", "marker_sizes", "marker_xy_um"];

export class RulesList {
  constructor(root, onChoose) {
    this.onChoose = onChoose;
    this.note = make("p", "", "quiet");
    this.select = make("select");
    this.select.setAttribute("aria-label", "Design rule");
    this.list = make("ol", undefined, "violations");
    this.more = make("button", "Show more");
    this.more.type = "button";
    root.append(this.select, this.note, this.list, this.more);
    this.violations = null;
    this.chosen = null;
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
    this.violations = rules.length && ARRAYS.every((name) => arrays[name]) ? new Violations(arrays, rules, sites) : null;
    this.chosen = null;
    const option = (value, text) => { const element = make("option", text); element.value = value; return element; };
    const total = rules.reduce((sum, rule) => sum + rule.count, 0);
    this.select.replaceChildren(option(-1, "all rules (" + shown(total) + ")"), ...rules.map((rule, k) => option(k, rule.name + " (" + shown(rule.count) + (rule.waiver ? ", waived)" : ")"))));
    this.select.value = Math.max(-1, rules.findIndex((rule) => rule.name === before));
    this.select.hidden = !rules.length;
    this._list(true);
  }

  _list(isNew) {
    const { rules, violations, rule } = this, of = [];
    if (isNew) { this.listed = 0; this.list.replaceChildren(); }
    if (violations) for (let i = 0; i < violations.n; i++) if (rule < 0 || violations.rule[i] === rule) of.push(i);
    const next = of.slice(this.listed, this.listed + AT_A_TIME);
    this.list.append(...next.map((i) => this._item(i)));
    this.listed += next.length;
    this.more.hidden = this.listed >= of.length;
    if (!rules.length) { this.note.textContent = "The settings have no design rules."; return; }
    if (rule < 0) {
      const met = rules.filter((one) => !one.count).length;
      this.note.textContent = met === rules.length ? "All " + shown(met) + " rules are satisfied." : shown(met) + " of " + shown(rules.length) + " rules are satisfied.";
    } else {
      const { description, limit, unit, waiver } = rules[rule];
      this.note.textContent = description + (limit === null ? "" : "; the limit is " + shown(limit) + (unit ? " " + unit : "")) + "." + (waiver ? " Waived: " + waiver + "." : "");
    }
  }

  _item(i) {
    const { rule, sites, value } = this.violations.describe(i);
    const item = make("li"), button = make("button");
    button.type = "button";
    button.dataset.violation = i;
    button.append(make("span", this.rule < 0 ? rule.name + ": " + sites : sites), make("span", value));
    button.addEventListener("click", () => { this.choose(i); this.onChoose(i); });
    item.append(button);
    return item;
  }

  choose(i) {
    this.chosen = i;
    for (const button of this.list.querySelectorAll("button")) {
      if (Number(button.dataset.violation) === i) button.setAttribute("aria-current", "true");
      else button.removeAttribute("aria-current");
    }
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
