// Variants: named states with notes, which are applied again, compared, and kept in the directory for saved files.

import { make } from "/web/page_parts.js";
import { confirmed } from "../menus.js";

function fieldOf(label, value, placeholder) {
  const field = make("input");
  Object.assign(field, { type: "text", value, placeholder, autocomplete: "off", spellcheck: false });
  field.setAttribute("aria-label", label);
  return field;
}

function buttonOf(text, label, act) {
  const button = make("button", text);
  button.type = "button";
  button.title = label;
  button.setAttribute("aria-label", label);
  button.addEventListener("click", act);
  return button;
}

// The first name that no variant has.
function freeName(variants) {
  const names = new Set(variants.map(({ name }) => name));
  let k = variants.length + 1;
  while (names.has("variant " + k)) k++;
  return "variant " + k;
}

export function create(root, studio) {
  const list = make("ul", undefined, "variants"), form = make("form"), add = make("button", "Keep");
  const field = fieldOf("Name of the variant", "", "");
  const note = make("p", "Keep the present state under a name, to return to it and to compare it with others.", "quiet");
  list.id = "variants";
  form.id = "keep-variant";
  form.append(field, add);
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
    const item = make("li"), box = make("input"), title = fieldOf("Name", name, ""), about = fieldOf("Note on " + name, text, "note");
    box.type = "checkbox";
    box.checked = isCompared;
    box.setAttribute("aria-label", "Compare " + name);
    box.title = "Compare with the present state";
    box.addEventListener("change", () => compare(id, box.checked));
    const describe = () => send({ do: "variant", action: "describe", variant: id, name: title.value, note: about.value });
    for (const each of [title, about]) each.addEventListener("change", describe);
    const ask = async (action, question, verb) => {
      if (await confirmed(question, verb)) send({ do: "variant", action, variant: id });
    };
    const actions = make("div", undefined, "variant-actions"), replace = "Replace " + name + " by the present state";
    actions.append(
      buttonOf("Apply", "Apply " + name, () => send({ do: "apply", variant: id })),
      buttonOf("As A", "Show " + name + " as A", () => studio.freeze(id)),
      buttonOf("Update", replace, () => ask("update", replace + "?", "Replace")),
      buttonOf("Delete", "Delete " + name, () => ask("delete", "Delete " + name + "?", "Delete")),
    );
    for (const [k, each] of [box, title, about, ...actions.children].entries()) each.setAttribute("data-at", k + id);
    const line = make("div", undefined, "variant");
    line.append(box, title, about);
    item.append(line, actions);
    if (problem) item.append(make("p", problem, "error"));
    return item;
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
