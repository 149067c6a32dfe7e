// Requirements of the settings: each with its result and its margin, and a form for new ones.

import { around, make, notice } from "/web/page_parts.js";
import { ConditionForm } from "../condition_form.js";
import { buttonOf } from "../elements.js";
import { quantity } from "../numbers.js";
import { percent } from "../problems.js";

// Results may be infinite, or have no value.
export function figure(value, unit) {
  if (typeof value !== "number") return value === ".inf" ? "∞" : value === "-.inf" ? "−∞" : "–";
  return quantity(value, unit === "fraction" ? "" : unit);
}

export function create(root, studio) {
  const list = make("ul", undefined, { className: "requirements", id: "requirements" }), form = new ConditionForm(studio.page);
  const note = make("p", "No requirements yet.", "quiet");
  form.root.append(buttonOf("Add", add));
  root.append(note, list, form.root);
  form.value.addEventListener("keydown", (event) => { if (event.key === "Enter") add(); });
  const present = () => studio.state?.settings.requirements || [];
  const use = (requirements) => studio.connection.set("requirements", requirements, true);

  function add() {
    const { requirement, problem } = form.read();
    if (problem) notice(problem);
    else use([...present(), requirement]);
  }

  function itemOf(row, i) {
    const margin = row.margin === null ? row.problem : "got " + figure(row.value, row.unit) + ", margin " + figure(row.margin, row.unit)
      + (row.saturated_fraction ? ", " + percent(row.saturated_fraction) + " saturated" : "");
    const mark = make("b", row.is_met ? "✓" : "✗", { ariaLabel: row.is_met ? "met" : "not met" });
    const remove = buttonOf("✕", () => use(present().filter((_, k) => k !== i)),
      { className: "step-remove", ariaLabel: "Remove: " + row.text });
    const text = around("span", {}, row.text, make("br"), make("small", margin));
    return around("li", row.is_met ? {} : "wrong", mark, text, remove);
  }

  return {
    form,
    use({ about: { rows, measures } }) {
      form.use(measures);
      note.hidden = rows.length > 0;
      list.replaceChildren(...rows.map(itemOf));
    },
  };
}
