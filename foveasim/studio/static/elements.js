// Buttons, fields, choices and drawings of the page.

import { make } from "/web/page_parts.js";

// A button that calls act() when it is pressed.
/** @type {(text: string, act: () => void, about?: Partial<HTMLButtonElement>) => HTMLButtonElement} */
export function buttonOf(text, act, about) {
  const button = make("button", text, { type: "button", ...about });
  button.addEventListener("click", act);
  return button;
}

// A button whose title is also its name, for texts that are signs or have no object.
/** @type {(text: string, title: string, act: () => void) => HTMLButtonElement} */
export const titledButton = (text, title, act) => buttonOf(text, act, { title, ariaLabel: title });

/** @type {(label: string, about?: Partial<HTMLInputElement>) => HTMLInputElement} */
export const fieldOf = (label, about) => make("input", undefined, { type: "text", autocomplete: "off", spellcheck: false, ariaLabel: label,
  ...about });

// Choices are pairs of a value and its text.
/** @type {(choices: string[][], label: string) => HTMLSelectElement} */
export function selectOf(choices, label) {
  const select = make("select", undefined, { ariaLabel: label });
  select.append(...choices.map(([value, text]) => new Option(text, value)));
  return select;
}

// An element of a drawing.
/** @type {(name: string, attributes: { [name: string]: unknown }) => SVGElement} */
export function svgOf(name, attributes) {
  const element = /** @type {SVGElement} */ (document.createElementNS("http://www.w3.org/2000/svg", name));
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  return element;
}
