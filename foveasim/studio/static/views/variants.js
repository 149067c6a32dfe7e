// Variants: named states with notes, which are applied again, compared, and kept in the directory for saved files.

import { around, make } from "/web/page_parts.js";
import { fieldOf, titledButton } from "../elements.js";
import { confirmed } from "../menus.js";

// The first name that no variant has.
function freeName(variants) {
  const names = new Set(variants.map(({ name }) => name));
  let k = variants.length + 1;
  while (names.has("variant " + k)) k++;
  return "variant " + k;
}

export function create(root, studio) {
  const list = make("ul", undefined, { className: "variants", id: "variants" }), field = fieldOf("Name of the variant");
  const form = around("form", { id: "keep-variant" }, field, make("button", "Keep"));
  const note = make("p", "Keep the present state under a name, to return to it and to compare it with others.", "quiet");
  root.append(form, note, list);
  let shown = "";
  const all = () => studio.state?.variants || [];
  const send = (message) => studio.connection.send(message);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    send({ do: "variant", action: "keep", name: field.value.trim() || field.placeholder });
    field.value = "";
  });

  // Several variants are compared in a table; the page remembers them for a new connection.
  function compare(id, isCompared) {
    const wanted = all().filter((each) => (each.id === id ? isCompared : each.is_compared)).map((each) => each.id);
    studio.compare(wanted);
    if (isCompared) studio.views.show("comparison", true);
  }

  function itemOf({ id, name, note: text, is_compared: isCompared, problem }) {
    const title = fieldOf("Name", { value: name }), about = fieldOf("Note on " + name, { value: text, placeholder: "note" });
    const box = make("input", undefined, { type: "checkbox", checked: isCompared, title: "Compare with the present state",
      ariaLabel: "Compare " + name });
    box.addEventListener("change", () => compare(id, box.checked));
    const describe = () => send({ do: "variant", action: "describe", variant: id, name: title.value, note: about.value });
    for (const each of [title, about]) each.addEventListener("change", describe);
    const ask = async (action, question, verb) => {
      if (await confirmed(question, verb)) send({ do: "variant", action, variant: id });
    };
    const replace = "Replace " + name + " by the present state", actions = around("div", "variant-actions",
      titledButton("Apply", "Apply " + name, () => send({ do: "apply", variant: id })),
      titledButton("As A", "Show " + name + " as A", () => studio.freeze(id)),
      titledButton("Update", replace, () => ask("update", replace + "?", "Replace")),
      titledButton("Delete", "Delete " + name, () => ask("delete", "Delete " + name + "?", "Delete")),
    );
    for (const [k, each] of [box, title, about, ...actions.children].entries()) each.setAttribute("data-at", k + id);
    const problems = problem ? [make("p", problem, "error")] : [];
    return around("li", {}, around("div", "variant", box, title, about), actions, ...problems);
  }

  return {
    onState() {
      const variants = all(), text = JSON.stringify(variants);
      field.placeholder = freeName(variants);
      if (text === shown) return;
      shown = text;
      note.hidden = variants.length > 0;
      const focused = list.contains(document.activeElement) ? document.activeElement?.getAttribute("data-at") : null;
      list.replaceChildren(...variants.map(itemOf));
      const again = focused ? [...list.querySelectorAll("[data-at]")].find((each) => each.getAttribute("data-at") === focused) : null;
      if (again instanceof HTMLElement) again.focus({ preventScroll: true });
    },
  };
}
