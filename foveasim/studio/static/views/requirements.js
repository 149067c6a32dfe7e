// Requirements of the settings: each with its result and its margin, and a form for new ones.

import { make, notice } from "/web/page_parts.js";
import { ConditionForm } from "../condition_form.js";
import { quantity } from "../numbers.js";
import { percent } from "../problems.js";

// Results may be infinite, or have no value.
export function figure(value, unit) {
  if (typeof value !== "number") return value === ".inf" ? "∞" : value === "-.inf" ? "−∞" : "–";
  return quantity(value, unit === "fraction" ? "" : unit);
}

export function create(root, studio) {
  const list = make("ul", undefined, "requirements"), form = new ConditionForm(studio.page), add = make("button", "Add");
  const note = make("p", "No requirements yet.", "quiet");
  list.id = "requirements";
  add.type = "button";
  form.root.append(add);
  root.append(note, list, form.root);
  const present = () => studio.state?.settings.requirements || [];
  add.addEventListener("click", () => {
    const { requirement, problem } = form.read();
    if (problem) notice(problem);
    else studio.connection.set("requirements", [...present(), requirement], true);
  });
  form.value.addEventListener("keydown", (event) => { if (event.key === "Enter") add.click(); });

  function itemOf(row, i) {
    const item = make("li"), mark = make("b", row.is_met ? "✓" : "✗"), remove = make("button", "✕", "step-remove");
    const margin = row.margin === null ? row.problem : "got " + figure(row.value, row.unit) + ", margin " + figure(row.margin, row.unit)
      + (row.saturated_fraction ? ", " + percent(row.saturated_fraction) + " saturated" : "");
    item.classList.toggle("wrong", !row.is_met);
    mark.setAttribute("aria-label", row.is_met ? "met" : "not met");
    remove.type = "button";
    remove.setAttribute("aria-label", "Remove: " + row.text);
    remove.addEventListener("click", () => studio.connection.set("requirements", present().filter((_, k) => k !== i), true));
    const text = make("span", row.text);
    text.append(make("br"), make("small", margin));
    item.append(mark, text, remove);
    return item;
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
