// The list of edits of the layout: their order, and their numbers as fields.

import { around, make } from "/web/page_parts.js";
import { fieldText, listOf } from "../controls.js";
import { CHOICES, describe } from "../edits.js";
import { buttonOf, fieldOf, selectOf } from "../elements.js";

const BUTTONS = [["up", "↑", "Move up"], ["down", "↓", "Move down"], ["copy", "+", "Duplicate"], ["remove", "✕", "Delete"]];

// Parameters of an edit as [path, value]; those of its layer are one by one.
function* parametersOf(edit, path = []) {
  for (const [key, value] of Object.entries(edit)) {
    if (key === "kind" || key === "generator") continue;
    if (value !== null && typeof value === "object" && !Array.isArray(value)) yield* parametersOf(value, [...path, key]);
    else yield [[...path, key], value];
  }
}

function withValue(edit, path, value) {
  const [key, ...rest] = path, copy = { ...edit };
  if (rest.length) copy[key] = withValue(edit[key], rest, value);
  else if (value === undefined) delete copy[key];
  else copy[key] = value;
  return copy;
}

class Steps {
  root; editor; choose; opened = -1; shown = "";

  // editor: its edits; choose(index) shows an edit on the map.
  constructor(root, editor, choose) {
    Object.assign(this, { root, editor, choose });
    this.note = make("p", "No edits. Press E to draw, move and merge photosites.", "quiet");
    this.list = make("ol", undefined, "steps");
    root.append(this.note, this.list);
    this.list.addEventListener("keydown", (event) => {
      const heads = [.../** @type {NodeListOf<HTMLElement>} */ (this.list.querySelectorAll(".step-name"))];
      const at = heads.findIndex((head) => head === document.activeElement);
      const next = heads[at + { ArrowDown: 1, ArrowUp: -1 }[event.key]];
      if (at < 0) return;
      if (event.key === "Delete") this._act("remove", at);
      else if (next) next.focus();
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // Shows the edits if they changed; the focus stays at the same place.
  update() {
    const { edits } = this.editor, text = JSON.stringify([edits, this.opened]);
    if (text === this.shown) return;
    this.shown = text;
    const focused = this.root.contains(document.activeElement) ? document.activeElement?.getAttribute("data-at") : null;
    this.note.hidden = edits.length > 0;
    this.list.replaceChildren(...edits.map((edit, i) => this._item(edit, i, edits.length)));
    if (focused) (this.root.querySelector(`[data-at="${focused}"]`)
      || [...this.root.querySelectorAll(".step-name")].at(-1))?.focus({ preventScroll: true });
  }

  open(index) {
    this.opened = index;
    this.update();
    this.list.children[index]?.scrollIntoView({ block: "nearest" });
  }

  _item(edit, i, n) {
    const { name, detail } = describe(edit), isOpen = i === this.opened;
    const head = buttonOf("", () => {
      this.opened = this.opened === i ? -1 : i;
      this.choose(this.opened === i ? i : null);
      this.update();
    }, { className: "step-name", title: name + ": " + detail, ariaExpanded: String(isOpen) });
    head.append(make("span", i + 1 + ". " + name), make("span", detail));
    head.dataset.at = "name" + i;
    const actions = BUTTONS.map(([action, sign, title]) => {
      const button = buttonOf(sign, () => this._act(action, i), { className: "step-" + action, title,
        ariaLabel: title + ": step " + (i + 1), disabled: (action === "up" && i === 0) || (action === "down" && i === n - 1) });
      button.dataset.at = action + i;
      return button;
    });
    const line = around("div", "step", head, around("div", "step-actions", ...actions));
    return around("li", {}, line, ...(isOpen ? [this._fields(edit, i)] : []));
  }

  _fields(edit, i) {
    const grid = make("div", undefined, "step-fields");
    for (const [path, value] of parametersOf(edit)) {
      const key = path.at(-1), name = key.replace(/_um$/, " / µm").replaceAll("_", " "), choices = CHOICES[key];
      let field;
      if (choices && typeof value === "string") {
        field = selectOf(choices.map((choice) => [choice, choice.replaceAll("_", " ")]), name);
        field.value = value;
      } else if (typeof value === "boolean") field = make("input", undefined, { type: "checkbox", checked: value });
      else field = fieldOf(name, { value: fieldText(value) });
      field.dataset.at = "field" + i + path.join(".");
      field.addEventListener("change", () => this._set(i, path, field, value));
      grid.append(around("label", {}, name, field));
    }
    return grid;
  }

  // Empty fields remove a parameter, whose default then applies.
  _set(i, path, field, before) {
    const text = field.value.trim(), isList = Array.isArray(before) || /^[[{]/.test(text);
    const value = field.type === "checkbox" ? field.checked : text === "" ? undefined : isList ? listOf(text)
      : Number.isFinite(Number(text)) ? Number(text) : text;
    this._commit(this.editor.edits.map((edit, k) => (k === i ? withValue(edit, path, value) : edit)));
  }

  _act(action, i) {
    const edits = [...this.editor.edits];
    if (action === "remove") edits.splice(i, 1);
    else if (action === "copy") edits.splice(i + 1, 0, structuredClone(edits[i]));
    else {
      const k = action === "up" ? i - 1 : i + 1;
      if (k < 0 || k >= edits.length) return;
      [edits[i], edits[k]] = [edits[k], edits[i]];
      if (this.opened === i) this.opened = k;
    }
    if (action === "remove") { this.opened = -1; this.choose(null); }
    this._commit(edits);
  }

  _commit(edits) {
    this.shown = "";
    this.editor.commitAll(edits);
    this.update();
  }
}

export function create(root, { editor, flyToStep }) {
  const frame = make("div", undefined, { id: "steps" }), steps = new Steps(frame, editor, flyToStep);
  root.append(frame);
  return { onState: () => steps.update(), open: (index) => steps.open(index) };
}
