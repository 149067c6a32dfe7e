// Controls of all settings, generated from the list of the server: sliders, fields, choices, with errors and resets.

import { clamp, roundStep, shown } from "/web/colours.js";
import { around, change, make } from "/web/page_parts.js";
import { buttonOf, fieldOf } from "./elements.js";
import { numberOf, unitText } from "./numbers.js";

// Sections that are open at first; settings outside all sections are in the first of them.
const OPEN = ["exposure", "layout", "optics", "sensor"];
// Keys that select one of several sections.
const TAGS = ["kind", "generator"];
// A step of a logarithmic slider is at least this factor.
const LOG_STEP = 1.02;
const LINEAR_STEPS = 200;
const HINT = "Point at a setting, or select it, for its meaning.";

export const valueAt = (settings, key) => key.split(".").reduce((part, name) =>
  (part === null || part === undefined ? undefined : part[name]), settings);

// Formats a value of a setting for its field.
export function fieldText(value) {
  if (value === null || value === undefined) return "";
  if (typeof value === "number") return String(Number(value.toPrecision(12)));
  if (Array.isArray(value) && value.every((item) => item === null || typeof item !== "object")) return value.map(fieldText).join(", ");
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

// Exposures may also be words or exposure values.
const hasNumbers = ({ kind, unit, key }) => kind === "number" || kind === "integer" || (kind === "text" && unit && key === "exposure_s");

const asNumber = (text) => (text.trim() !== "" && Number.isFinite(Number(text)) ? Number(text) : text.trim());

// Parses the text of a list: JSON, or numbers and words with commas.
export function listOf(text) {
  const trimmed = text.trim();
  if (/^[[{]/.test(trimmed)) {
    try { return JSON.parse(trimmed); } catch { return trimmed; }
  }
  return trimmed.split(/[\s,;]+/).filter(Boolean).map(asNumber);
}

// Positions of a slider for a range of values, linear or logarithmic.
function sliderOf({ minimum, maximum, suggested, scale, kind }, value) {
  let [low, high] = suggested || [minimum, maximum];
  if (!Number.isFinite(low) || !Number.isFinite(high) || !(high > low)) return null;
  if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
  const isLog = scale === "log" && low > 0, isInteger = kind === "integer";
  if (isLog) {
    const span = Math.log(high / low), steps = clamp(Math.round(span / Math.log(LOG_STEP)), 20, 400);
    return {
      steps,
      toStep: (v) => (steps * Math.log(clamp(v, low, high) / low)) / span,
      toValue: (step) => {
        const found = step <= 0 ? low : step >= steps ? high : Number((low * Math.exp((span * step) / steps)).toPrecision(3));
        return isInteger ? Math.round(found) : found;
      },
    };
  }
  const unit = isInteger ? Math.max(1, roundStep((high - low) / 1000, true)) : roundStep((high - low) / LINEAR_STEPS);
  const steps = Math.ceil((high - low) / unit - 1e-9);
  return {
    steps, unit,
    toStep: (v) => (clamp(v, low, high) - low) / unit,
    toValue: (step) => {
      const found = step >= steps ? high : step <= 0 ? low : Math.round((low + step * unit) / unit) * unit;
      return isInteger ? Math.round(found) : Number(clamp(found, low, high).toPrecision(12));
    },
  };
}

// Index of the choice that a value belongs to: an equal one, a section of the same kind, or a value of the same type.
function chosenOf({ choices, selected }, value) {
  const isSection = (item) => item !== null && typeof item === "object" && !Array.isArray(item), text = JSON.stringify(value ?? null);
  const equal = choices.findIndex((choice) => JSON.stringify(choice.value) === text);
  if (equal >= 0) return equal;
  if (isSection(value)) {
    const tag = value.kind !== undefined ? "kind" : "generator";
    const found = value[tag] === undefined ? -1 : choices.findIndex((choice) => isSection(choice.value)
      && choice.value[tag] === value[tag]);
    return found >= 0 ? found : selected ?? -1;
  }
  if (value === null || value === undefined) return selected ?? -1;
  const kind = Array.isArray(value) ? Array.isArray : (item) => typeof item === typeof value;
  const found = choices.findIndex((choice) => !isSection(choice.value) && kind(choice.value));
  return found >= 0 ? found : selected ?? -1;
}

const choicesOf = (control) => (control.choices || []).map((choice) =>
  (choice !== null && typeof choice === "object" && "value" in choice ? choice : { label: fieldText(choice), value: choice }));

// What the elements of a control depend on, without its values and ranges.
function shapeOf(control) {
  const { key, kind, label, unit, help, section, is_value: isValue, default: initial } = control;
  return JSON.stringify([key, kind, label, unit, help, section, isValue, initial, choicesOf(control).map((choice) => choice.label),
    Boolean(sliderOf(control, NaN))]);
}

let made = 0;

function fillTrack(slider) {
  slider.style.setProperty("--filled", (100 * Number(slider.value)) / Math.max(1, Number(slider.max)) + "%");
}

// A row with one control. send(value, isFinal), reset() and remove() are called by the user. He chooses the file of
// chooseFile(), which returns its path, and of chooseSection(choice), which returns the section; null without one.
class Row {
  /** @type {HTMLInputElement | HTMLSelectElement | undefined} */ field;
  /** @type {HTMLInputElement | undefined} */ slider;
  // Of rows with a slider.
  /** @type {NonNullable<ReturnType<typeof sliderOf>>} */ range;
  /** @type {Choice[]} */ choices = [];

  constructor(control, on) {
    this.control = control;
    this.on = on;
    this.id = "control-" + ++made;
    this.isDirty = false;
    this.sent = 0;
    this.value = undefined;
    this.root = make("div", undefined, "control kind-" + control.kind);
    this.root.dataset.key = control.key;
    this.root.dataset.id = control.id || control.key;
    this.root.style.setProperty("--depth", String(Math.max(0, control.key.split(".").length - 2 + (control.is_value ? 1 : 0))));
    // Names of controls and their help for screen readers; the page shows the help of the focused control.
    this.help = make("span", control.help || "", { className: "unseen", id: this.id + "-help" });
    this.name = control.label + (control.is_value ? ", value" : "") + (control.context ? ", " + control.context : "");
    this.label = make("label", control.is_value ? "value" : control.label, { htmlFor: this.id });
    this.reset = buttonOf("↺", () => { this.field?.focus(); on.reset(); },
      { className: "reset", title: "Reset to the value at the start", ariaLabel: "Reset " + this.name, hidden: true });
    this.error = make("p", undefined, { className: "error", id: this.id + "-error", hidden: true });
    this.unit = make("span", unitText(control.unit || ""), "unit");
    if (control.kind === "group") this._buildHeading();
    else if (control.kind === "sections") this._buildAdder();
    else this._build();
    for (const input of [this.field, this.slider]) input?.setAttribute("aria-describedby", this.help.id + " " + this.error.id);
    if (this.field) this.field.ariaLabel = this.name + (control.unit ? ", " + control.unit : "");
    this.adder?.setAttribute("aria-describedby", this.help.id);
    this.root.append(this.help, this.error);
    const plain = (...texts) => texts.join(" ").toLowerCase().replaceAll("_", " ");
    this.phrases = [control.label, ...(control.synonyms || "").split(",")].map((text) => plain(text).trim());
    this.words = plain(...this.phrases, control.key, control.help, control.section, control.context);
  }

  _makeField() {
    const { control } = this, { kind } = control;
    if (kind === "choice") {
      const field = make("select");
      this.choices = choicesOf(control);
      field.append(...this.choices.map(({ label, value, file }, i) =>
        new Option(String(label ?? fieldText(value)).replaceAll("_", " ") + (file ? "…" : ""), String(i))));
      field.addEventListener("change", () => {
        const choice = this.choices[Number(field.value)];
        if (choice) this._choose(choice, (value) => value);
      });
      return field;
    }
    if (kind === "boolean") {
      const box = make("input", undefined, { type: "checkbox" });
      box.addEventListener("change", () => this._send(box.checked, true));
      return box;
    }
    const field = fieldOf("");
    if (kind === "number" || kind === "integer") field.inputMode = "decimal";
    field.addEventListener("input", () => { this.isDirty = true; this.isCurrent = false; });
    field.addEventListener("change", () => this._commit(field));
    field.addEventListener("keydown", (event) => this._key(event, field));
    return field;
  }

  // How well a row matches a search: its name, one of its other names, words at their beginning, or any words; 0 if it does not.
  /** @param {string} text @param {string[]} words */
  rank(text, words) {
    if (!words.every((word) => this.words.includes(word))) return 0;
    const [label, ...others] = this.phrases;
    const starts = (/** @type {string} */ name) => words.every((word) => (" " + name).includes(" " + word));
    const rank = label === text ? 5 : others.includes(text) ? 4 : starts(label) ? 3 : starts(this.phrases.join(" ")) ? 2 : 1;
    return rank + (this.isExtra ? 0 : 0.5) + 0.4 / label.length;
  }

  // Sends the value of a choice, with a file and parameters that the user chooses if it requires them.
  /** @type {(choice: Choice, wrapped: (value: any) => any) => Promise<void>} */
  async _choose(choice, wrapped) {
    if (choice.file) this._show();
    const value = choice.file ? await this.on.chooseSection(choice) : choice.value;
    if (value !== null || !choice.file) this._send(wrapped(value), true);
  }

  _build() {
    const field = this._makeField(), { kind } = this.control;
    this.field = field;
    field.id = this.id;
    this.root.append(around("div", "line", this.label, this.reset, field, kind === "file" ? this._fileButton() : this.unit));
    if (kind === "number" || kind === "integer") this._buildSlider(field);
  }

  _fileButton() {
    return buttonOf("…", async () => {
      const path = await this.on.chooseFile();
      if (path) this._send(path, true);
    }, { className: "choose", title: "Choose a file", ariaLabel: "Choose a file for " + this.name });
  }

  _buildSlider(field) {
    if (!sliderOf(this.control, NaN)) return;
    const slider = make("input", undefined, { type: "range", min: "0", step: "1", ariaLabel: this.name + " slider" });
    this.slider = slider;
    const value = () => this.range.toValue(Number(slider.value));
    const release = () => {
      if (!this.isHeld) return;
      this.isHeld = false;
      this._send(value(), true);
    };
    slider.addEventListener("input", () => {
      this.isHeld = true;
      this.isCurrent = false;
      // No change is reported when the slider returns to its start.
      for (const type of ["pointerup", "pointercancel"]) addEventListener(type, release, { once: true });
      field.value = fieldText(value());
      fillTrack(slider);
      this._send(value(), false);
    });
    for (const type of ["change", "blur"]) slider.addEventListener(type, release);
    this._place(slider, NaN);
    this.root.append(slider);
  }

  // Heading of a section; one of a list can be removed.
  _buildHeading() {
    const { control } = this, heading = make("h3", control.label);
    this.root.append(heading);
    if (control.is_item) heading.append(buttonOf("✕", () => this.on.remove(),
      { className: "remove", title: "Remove", ariaLabel: "Remove " + control.label }));
  }

  // A list of sections, to which the user adds one.
  _buildAdder() {
    const adder = make("select", undefined, { id: this.id });
    this.choices = choicesOf(this.control);
    adder.append(new Option("Add…", "-1"), ...this.choices.map(({ label, file }, i) => new Option(label + (file ? "…" : ""), String(i))));
    adder.addEventListener("change", () => {
      const choice = this.choices[Number(adder.value)];
      adder.value = "-1";
      if (choice) this._choose(choice, (value) => [...(this.value || []), value]);
    });
    this.root.append(around("div", "line", this.label, this.reset, adder, this.unit));
    this.adder = adder;
  }

  // Takes over a description with other values and ranges; the elements stay, with their focus.
  refresh(control) {
    this.isCurrent = false;
    this.control = control;
    if (control.kind === "choice" || control.kind === "sections") this.choices = choicesOf(control);
  }

  // Moves the slider to a value.
  _place(slider, value) {
    const range = sliderOf(this.control, value) || this.range;
    this.range = range;
    slider.max = String(range.steps);
    const base = Number.isFinite(value) ? value : typeof this.control.default === "number" ? this.control.default : range.toValue(0);
    const isSet = Number.isFinite(value) || typeof this.control.default === "number";
    slider.value = String(range.toStep(base));
    slider.classList.toggle("unset", !isSet);
    slider.setAttribute("aria-valuetext", isSet ? fieldText(base) + " " + (this.control.unit || "") : "not set");
    fillTrack(slider);
  }

  _key(event, field) {
    const { kind } = this.control;
    if (event.key === "Escape" && this.isDirty) {
      this._show();
      event.stopPropagation();
    }
    const sign = { ArrowUp: 1, ArrowDown: -1 }[event.key], value = Number(field.value);
    if (!sign || (kind !== "number" && kind !== "integer") || field.value.trim() === "" || !Number.isFinite(value)) return;
    event.preventDefault();
    // A step of the second digit, or ten times that with Shift.
    const step = kind === "integer" ? 1 : this.range?.unit || 10 ** (Math.floor(Math.log10(Math.abs(value) || 1)) - 1);
    const { minimum, maximum } = this.control;
    const next = clamp(value + sign * step * (event.shiftKey ? 10 : 1), minimum ?? -Infinity, maximum ?? Infinity);
    field.value = fieldText(Number(next.toPrecision(9)));
    this.isDirty = true;
    this.isCurrent = false;
    this._commit(field);
  }

  // Text of a value in its field: of a file that was sent, its name.
  _text(value) {
    const text = fieldText(value);
    return this.control.kind === "file" && /[\\/]foveasim-studio-/.test(text) ? text.replace(/.*[\\/]/, "") : text;
  }

  _commit(field) {
    if (!this.isDirty) return;
    this.isDirty = false;
    const { kind } = this.control, text = field.value;
    if (text === this._text(this.value) && this.error.hidden) return;
    if (text.trim() === "" && kind !== "text" && kind !== "file") this.on.remove();
    else {
      const number = hasNumbers(this.control) ? numberOf(text, this.control.unit) : NaN;
      this._send(kind === "list" ? listOf(text) : Number.isFinite(number) ? number : text.trim(), true);
    }
  }

  _send(value, isFinal) {
    this.isCurrent = false;
    this.sent = this.on.send(value, isFinal) ?? this.sent;
  }

  // Shows the value that the generator has solved for, or the default, where none is given.
  solve(value) {
    const { default: initial } = this.control, text = fieldText(value ?? initial) || "not set";
    if (this.field instanceof HTMLInputElement && this.field.type === "text" && this.field.placeholder !== text) {
      this.field.placeholder = text;
      this.field.classList.toggle("solved", value !== undefined);
    }
    if (value !== this.solved) this.isCurrent = false;
    this.solved = value;
  }

  // Shows the value of a state, unless the user is changing it or it has an error.
  update(value, isChanged, error, id) {
    if (this.isCurrent && value === this.value && isChanged === this.isMarked && !error) return;
    this.isMarked = isChanged;
    this.isCurrent = !this.field && !error;
    this.root.classList.toggle("changed", isChanged);
    this.reset.hidden = !isChanged;
    this.error.hidden = !error;
    this.error.textContent = error || "";
    if (this.field) this.field.ariaInvalid = error ? "true" : null;
    this.value = value;
    // Settings that are absent and may be are behind a button.
    this.isExtra = Boolean(this.control.is_optional) && !this.control.is_value && this.control.kind !== "group"
      && (value === null || value === undefined) && !isChanged && !error;
    if (!this.field || error || this.isDirty || this.isHeld || (id !== null && id < this.sent)) return;
    this._show();
  }

  _show() {
    const { control, value, field, slider } = this;
    if (!field) return;
    this.isDirty = false;
    this.isCurrent = true;
    if (control.kind === "choice") {
      const chosen = chosenOf({ ...control, choices: this.choices }, value ?? control.default);
      const other = field.querySelector("option[value='-1']");
      if (chosen < 0 && !other) field.prepend(new Option("not set", "-1"));
      else if (chosen >= 0) other?.remove();
      change(field, { value: String(chosen) });  // browsers examine all forms again when a choice is set
    } else if (control.kind === "boolean") Object.assign(field, { checked: Boolean(value ?? control.default) });
    else {
      const text = this._text(value);
      if (field.value !== text) field.value = text;
      if (control.kind === "file") field.title = fieldText(value);
    }
    if (slider) this._place(slider, typeof value === "number" ? value : typeof this.solved === "number" ? this.solved : NaN);
  }
}

export class Controls {
  root; search; onlyChanged; on; hint; sorted = "";

  // Callbacks: send(key, value, isFinal) and act(do, name) return the number of the message; reset(key), remove(key);
  // chooseFile() and chooseSection(choice), as those of rows.
  constructor(root, search, onlyChanged, hint, on) {
    Object.assign(this, { root, search, onlyChanged, hint, on });
    hint.textContent = HINT;
    this.rows = new Map();
    this.sections = new Map();
    this.state = null;
    search.addEventListener("input", () => this._filter());
    search.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !search.value) return;
      search.value = "";
      this._filter();
      event.stopPropagation();
    });
    // The help of the control with the focus, or under the mouse.
    for (const type of ["focusin", "pointerover"]) root.addEventListener(type, (event) => this._hint(event.target));
    root.addEventListener("pointerleave", () => this._hint(document.activeElement));
    root.addEventListener("focusout", () => this._hint(null));
    onlyChanged.addEventListener("click", () => {
      onlyChanged.setAttribute("aria-pressed", String(onlyChanged.getAttribute("aria-pressed") !== "true"));
      this._filter();
    });
  }

  // Shows a list of controls; rows that are the same keep their state and focus.
  describe(list) {
    const focused = document.activeElement, wasSlider = Boolean(focused?.matches("input[type=range]"));
    const focusedKey = focused?.closest(".control")?.getAttribute("data-id");
    const before = this.rows;
    this.rows = new Map();
    const groups = new Map();
    const forms = new Set(list.filter((one) => one.id === one.key + ":form").map((one) => one.key));
    for (const described of list) {
      // The value after the choice of its form.
      const control = { ...described, is_value: forms.has(described.key) && described.id === described.key };
      if (/\.per_um2$/.test(control.key)) control.unit = "";
      const id = control.id || control.key, known = before.get(id), shape = shapeOf(control);
      // The heading of a section is enough.
      if (control.kind === "group" && !control.key.includes(".")) continue;
      const act = control.do;
      const row = known && known.shape === shape ? known : new Row(control, {
        send: (value, isFinal) => (act ? this.on.act(act, value) : this.on.send(control.key, value, isFinal)),
        reset: () => this.on.reset(control.key),
        remove: () => this.on.remove(control.key),
        chooseFile: this.on.chooseFile, chooseSection: this.on.chooseSection,
      });
      row.shape = shape;
      row.refresh(control);
      this.rows.set(id, row);
      const isAlone = control.section === control.key && !list.some((one) => one.key.startsWith(control.key + "."))
        && control.kind !== "choice";
      const section = isAlone || control.key === "integration_order" ? OPEN[0] : control.section || control.key.split(".")[0];
      if (!groups.has(section)) groups.set(section, []);
      groups.get(section).push(row);
    }
    if (groups.has(OPEN[0])) {
      const first = groups.get(OPEN[0]);
      groups.delete(OPEN[0]);
      const rest = [...groups];
      groups.clear();
      for (const [name, rows] of [[OPEN[0], first], ...rest]) groups.set(name, rows);
    }
    for (const [name, section] of this.sections) if (!groups.has(name)) { section.root.remove(); this.sections.delete(name); }
    for (const [name, rows] of groups) this._fillSection(name, rows);
    if (this.sorted) this._sort(this.sorted, this.sorted.split(" "));
    if (focusedKey && document.activeElement !== focused) {
      const row = this.rows.get(focusedKey);
      (wasSlider && row?.slider ? row.slider : row?.field)?.focus({ preventScroll: true });
    }
    if (this.state) this.update(this.state);
    this._filter();
  }

  // Messages of an earlier connection may be lost: the next state shows what the server has.
  forgetSent() { for (const row of this.rows.values()) { row.sent = 0; row.isCurrent = false; } }

  // Shows the help of the control that contains an element; none for others.
  /** @param {EventTarget | null} target */
  _hint(target) {
    const id = target instanceof Element ? target.closest(".control")?.getAttribute("data-id") : null, row = id ? this.rows.get(id) : null;
    if (!row) { change(this.hint, { textContent: HINT }); return; }
    const { unit, help, key } = row.control;
    this.hint.replaceChildren(make("b", row.name + (unit ? " / " + unit : "")), " " + (help || "") + " ", make("code", key));
  }

  _fillSection(name, rows) {
    let section = this.sections.get(name);
    if (!section) {
      const count = make("span", "", "count"), body = make("div", undefined, "body");
      const heading = around("summary", {}, make("span", name.replaceAll("_", " ")), count);
      const more = buttonOf("", () => { section.isFull = !section.isFull; this._filter(); }, { className: "more" });
      const root = around("details", { className: "section", open: OPEN.includes(name) }, heading, body, more);
      root.dataset.section = name;
      section = { root, body, count, more, wasOpen: null, isFull: false };
      this.sections.set(name, section);
    }
    section.rows = rows;
    this.root.append(section.root);
    const nodes = rows.map((row) => row.root);
    if (nodes.length !== section.body.children.length
      || nodes.some((node, i) => section.body.children[i] !== node)) section.body.replaceChildren(...nodes);
  }

  // Orders sections and rows by how well they match; all as they are listed without a search.
  /** @param {string} text @param {string[]} words */
  _sort(text, words) {
    this.sorted = text;
    const best = [...this.sections.values()].map((section) => {
      const ranks = new Map(section.rows.map((row) => [row, words.length ? row.rank(text, words) : 0]));
      section.body.append(...[...section.rows].sort((a, b) => (ranks.get(b) || 0) - (ranks.get(a) || 0)).map((row) => row.root));
      return { section, rank: Math.max(...ranks.values()) };
    });
    this.root.append(...best.sort((a, b) => b.rank - a.rank).map(({ section }) => section.root));
    this.root.scrollTop = 0;
  }

  _filter() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean), text = words.join(" ");
    const isOnly = this.onlyChanged.getAttribute("aria-pressed") === "true";
    const isFiltered = words.length > 0 || isOnly;
    let found = 0;
    if (text !== this.sorted) this._sort(text, words);
    for (const section of this.sections.values()) {
      let visible = 0, extra = 0;
      for (const row of section.rows) {
        if (!isFiltered && row.isExtra) extra++;
        const isFound = (isFiltered || section.isFull || !row.isExtra || row.root.contains(document.activeElement))
          && words.every((word) => row.words.includes(word)) && (!isOnly || row.root.classList.contains("changed"));
        const isShown = isFound || !row.error.hidden;
        change(row.root, { hidden: !isShown });
        change(row.label, { textContent: words.length ? row.name : row.control.is_value ? "value" : row.control.label });
        visible += Number(isShown);
      }
      found += visible;
      change(section.root, { hidden: visible === 0 && extra === 0 });
      change(section.more, {
        hidden: extra === 0, textContent: section.isFull ? "Hide settings that are not set" : "Show " + shown(extra) + " more",
        ariaExpanded: String(section.isFull),
      });
      if (isFiltered && section.wasOpen === null) section.wasOpen = section.root.open;
      if (isFiltered) section.root.open = true;
      else if (section.wasOpen !== null) { section.root.open = section.wasOpen; section.wasOpen = null; }
    }
    this.root.classList.toggle("nothing", found === 0);
  }

  update(state) {
    this.state = state;
    const changed = new Set(state.changed);
    // A change of "sensor" marks its parts; a change of a part marks a choice among sections only if it is the one that is chosen.
    const isChanged = ({ key, kind }) => changed.has(key) || [...changed].some((one) => key.startsWith(one + ".") ||
      (one.startsWith(key + ".") && (kind !== "choice" || TAGS.includes(one.slice(key.length + 1)))));
    const errors = { ...(state.errors || {}) }, rest = [], isWrong = (row) => !row.error.hidden, rows = [...this.rows.values()];
    const known = new Set(rows.filter(isWrong));
    // A value of its own after a choice shows the error.
    for (const row of [...rows].reverse()) {
      const { key } = row.control;
      if (row.control.do) { row.update(row.control.value, false, undefined, null); continue; }
      row.solve(state.solved?.[key]);
      row.update(valueAt(state.settings, key), row.control.kind !== "group" && isChanged(row.control), errors[key], state.id ?? null);
      delete errors[key];
    }
    for (const [key, text] of Object.entries(errors)) rest.push(key && !text.includes(key) ? key + ": " + text : text);
    for (const section of this.sections.values()) {
      const n = section.rows.filter((row) => row.root.classList.contains("changed")).length;
      const hasError = section.rows.some(isWrong);
      change(section.count, { textContent: n ? shown(n) : "", title: n ? shown(n) + " changed" : "" });
      section.root.classList.toggle("wrong", hasError);
    }
    this._filter();
    // A new error stays in view with its field.
    const wrong = rows.find((row) => isWrong(row) && !known.has(row)), section = wrong?.root.closest("details");
    if (section) section.open = true;
    wrong?.root.scrollIntoView({ block: "nearest" });
    return rest;
  }
}
