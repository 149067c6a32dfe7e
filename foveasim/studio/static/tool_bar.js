// The tools of the editor next to the map, and the options of the chosen one above it.

import { around, change, make, notice, setChoices } from "/web/page_parts.js";
import { buttonOf, fieldOf, selectOf, svgOf } from "./elements.js";

// Name, key, heading, icon (lines in a square of 16), and hint.
export const TOOLS = [
  ["select", "v", "Select and pan", "M3.5 2l9 6-4.2.8L6.3 13z", "Click selects a site, Shift adds; drag pans, Shift-drag selects an area."],
  ["polygon", "p", "Draw polygon", "M8 2l6 4.6-2.3 7H4.3L2 6.6z",
    "Click vertices; Enter, a double click or the first vertex closes; Backspace removes the last."],
  ["rectangle", "r", "Draw rectangle", "M2.5 4h11v8.5h-11z", "Drag, or click two corners; Shift draws a square."],
  ["move", "m", "Move photosites", "M8 1.5v13M1.5 8h13M6 3.5l2-2 2 2M6 12.5l2 2 2-2M3.5 6l-2 2 2 2M12.5 6l2 2-2 2",
    "Drag a site, or all selected ones; arrows move the selection by the grid."],
  ["vertex", "n", "Move vertex", "M2 13.5L8 5l6 8.5M6.2 1.8h3.6v3.6H6.2z",
    "Drag a vertex of all its sites, or an edge for a new one; Delete or Alt-click removes."],
  ["cut", "c", "Cut", "M2.5 4h11v8.5h-11zM11.5 1.5l-7 13",
    "Click a line across sites, then Enter; with a selection, only selected sites are cut."],
  ["merge", "j", "Merge", "M1.5 8H6M4 5.5L6.5 8 4 10.5M14.5 8H10M12 5.5L9.5 8l2.5 2.5M8 2.5v11", "Click adjacent sites, then Enter."],
  ["split", "d", "Split", "M2.5 3h11v10h-11zM8 3v10M2.5 8h11", "Click sites, then Enter."],
  ["channel", "f", "Set filter", "M8 1.8C5.5 5.2 3.8 7.5 3.8 9.8a4.2 4.2 0 0 0 8.4 0C12.2 7.5 10.5 5.2 8 1.8z", "Click sites, then Enter."],
  ["layer", "l", "Add layer…", "M8 2l6.5 3.5L8 9 1.5 5.5zM1.5 9L8 12.5 14.5 9",
    "Drag a rectangle for it, or click its centre; Enter for the centre of the view."],
];
const ACTIONS = [
  ["remove", "Delete selected sites (Delete)", "M3 4.5h10M6.5 4.5v-2h3v2M4.5 4.5l.7 9h5.6l.7-9M6.8 7v4.5M9.2 7v4.5"],
  ["repair", "Repair violations of the design rules",
    "M10.5 2.2a3.6 3.6 0 0 0-3.3 5L2.4 12l1.9 1.9 4.8-4.8a3.6 3.6 0 0 0 4.6-4.6l-2.1 2.1-2-2z"],
];
const APPLY = { polygon: "Close", cut: "Cut", merge: "Merge", split: "Split", channel: "Set", layer: "Add" };
const PLACING = ["polygon", "rectangle", "cut", "move", "vertex", "layer"];
const OVERLAPS = [["cut", "cuts sites"], ["fill", "fills gaps"], ["keep", "overlaps"]];
const OPERATIONS = [["replace", "replaces sites"], ["fill", "fills gaps"], ["union", "overlaps"], ["clip", "clips sites"],
  ["cut_out", "cuts sites out"]];

function icon(path) {
  const picture = svgOf("svg", { viewBox: "0 0 16 16", "aria-hidden": true });
  picture.append(svgOf("path", { d: path, fill: "none", stroke: "currentColor", "stroke-width": 1.4, "stroke-linejoin": "round" }));
  return picture;
}

function iconButton(name, title, path, act) {
  const button = buttonOf("", act, { title });
  button.dataset.tool = name;
  button.append(icon(path), make("span", title, "unseen"));
  return button;
}

export class ToolBar {
  // Elements of the options.
  /** @type {{ [name: string]: HTMLInputElement | HTMLSelectElement } & { at: HTMLInputElement, grid: HTMLInputElement }} */ fields;
  /** @type {HTMLButtonElement} */ applyButton;
  /** @type {HTMLButtonElement} */ rulesButton;
  /** @type {HTMLElement} */ hint;
  /** @type {HTMLElement} */ problem;
  // Options with the tools that have them.
  /** @type {[string[], HTMLElement][]} */ parts = [];
  usual = "";

  // Callbacks: use(tool), act(action), apply(), typed(text), grid(), rules().
  constructor(pane, on) {
    const stage = pane.querySelector(".stage");
    this.on = on;
    this.strip = make("div", undefined, { className: "tool-strip", role: "toolbar", ariaLabel: "Tools", ariaOrientation: "vertical" });
    this.buttons = new Map(TOOLS.map(([name, key, title, path]) =>
      [name, iconButton(name, title + " (" + key.toUpperCase() + ")", path, () => on.use(name))]));
    const [remove, repair] = ACTIONS.map(([name, title, path]) => iconButton(name, title, path, () => on.act(name)));
    this.actions = { remove, repair };
    for (const button of this.buttons.values()) button.ariaPressed = "false";
    this.strip.append(...this.buttons.values(), make("hr"), remove, repair);
    this.strip.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[event.key];
      const all = [...this.strip.querySelectorAll("button")].filter((button) => !button.disabled);
      if (!step) return;
      all[(all.findIndex((button) => button === document.activeElement) + step + all.length) % all.length]?.focus();
      event.preventDefault();
      event.stopPropagation();
    });
    this.row = make("div", undefined, { className: "tool-options", role: "group", ariaLabel: "Options of the tool" });
    this._buildOptions();
    stage.prepend(this.strip);
    stage.before(this.row);
    this.show(false);
  }

  _buildOptions() {
    const { on } = this;
    this.fields = {
      overlap: selectOf(OVERLAPS, "What happens to sites below"), channel: selectOf([["", "nearest filter"]], "Filter"),
      n_x: fieldOf("Parts along x", { size: 2, value: "2", inputMode: "numeric" }),
      n_y: fieldOf("Parts along y", { size: 2, value: "1", inputMode: "numeric" }),
      generator: selectOf([], "Generator"), operation: selectOf(OPERATIONS, "Operation"),
      margin_um: fieldOf("Margin in µm", { size: 3, value: "0", inputMode: "decimal" }),
      at: fieldOf("Position in µm: x, y, or @dx, dy from the last one", { size: 11, placeholder: "x, y", inputMode: "text" }),
      grid: fieldOf("Grid in µm", { size: 3, inputMode: "decimal" }),
    };
    this.applyButton = buttonOf("Apply", on.apply, { className: "apply" });
    this.rulesButton = buttonOf("", on.rules, { className: "rules-button" });
    this.hint = make("p", "", "tool-hint");
    this.problem = make("p", "", { className: "tool-problem", role: "alert" });
    const part = (tools, label, ...nodes) => {
      const span = around("label", {}, label, ...nodes);
      this.parts.push([tools, span]);
      return span;
    };
    const { fields } = this, note = around("div", "tool-note", this.hint, this.problem, this.rulesButton);
    this.row.append(
      part(["polygon", "rectangle"], "", fields.overlap), part(["polygon", "rectangle", "channel"], "", fields.channel),
      part(["split"], "x", fields.n_x), part(["split"], "y", fields.n_y),
      part(["layer"], "", fields.generator), part(["layer"], "", fields.operation), part(["layer"], "margin", fields.margin_um),
      part(PLACING, "at", fields.at), this.applyButton, part(PLACING.filter((tool) => tool !== "layer"), "grid", fields.grid,
        make("span", "µm")), note,
    );
    fields.at.addEventListener("input", () => { this.isTyping = true; });
    fields.at.addEventListener("blur", () => { this.isTyping = false; });
    fields.at.addEventListener("keydown", (event) => {
      if (event.key === "Enter") {
        if (this.isTyping) {
          if (on.typed(fields.at.value)) {
            this.isTyping = false;
            fields.at.select();
          } else notice("A position is two numbers in µm, such as 12.5, -3 or @10, 0");
        }
        else on.apply();
      } else if (event.key === "Escape") { this.isTyping = false; fields.at.blur(); } else return;
      event.preventDefault();
      event.stopPropagation();
    });
    fields.grid.addEventListener("change", on.grid);
  }

  show(isOn) { this.strip.hidden = this.row.hidden = !isOn; }

  use(tool) {
    for (const [name, button] of this.buttons) button.ariaPressed = String(name === tool);
    const [, , title, , hint] = TOOLS.find(([name]) => name === tool) || TOOLS[0];
    this.usual = title.replace("…", "") + ": " + hint[0].toLowerCase() + hint.slice(1);
    for (const [tools, span] of this.parts) span.hidden = !tools.includes(tool);
    this.applyButton.hidden = !APPLY[tool];
    this.applyButton.textContent = APPLY[tool] || "";
  }

  // Values of the options, numbers where they are.
  value(name) { return this.fields[name].value.trim(); }
  number(name) { const text = this.value(name); return text !== "" && Number.isFinite(Number(text)) ? Number(text) : null; }

  fill(name, choices) { setChoices(/** @type {HTMLSelectElement} */ (this.fields[name]), choices); }

  // What is typed next replaces the position.
  _showPosition(position) {
    const { at } = this.fields;
    if (this.isTyping || at.value === position) return;
    at.value = position;
    if (document.activeElement === at) at.select();
  }

  // note: instead of the usual hint; error: the last answer of the server; isReady: whether the button applies something.
  describe({ note, error, isReady, isSelected, rules, position, step }) {
    const hint = note || this.usual;
    change(this.hint, { textContent: hint, title: hint, hidden: Boolean(error) });
    this.hint.classList.toggle("warm", Boolean(note));
    change(this.problem, { textContent: error || "", hidden: !error });
    this.applyButton.disabled = !isReady;
    this.actions.remove.disabled = !isSelected;
    change(this.rulesButton, { textContent: rules.text, title: rules.title });
    this.rulesButton.classList.toggle("wrong", rules.isWrong);
    this.actions.repair.disabled = !rules.exist;
    this._showPosition(position);
    this.fields.grid.placeholder = String(step);
  }
}
