// Common parts of all pages: elements by id, themes, short notices, downloads, the list of keys.

/** @typedef {HTMLInputElement & HTMLSelectElement & HTMLDialogElement & HTMLCanvasElement} PageElement */

// The element with an id.
/** @type {(id: string) => PageElement} */
export function $(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error("the page has no element " + id);
  return /** @type {PageElement} */ (found);
}

// The first element of a selector in another one.
/** @type {(root: ParentNode, selector: string) => HTMLElement} */
export function find(root, selector) {
  const found = root.querySelector(selector);
  if (!(found instanceof HTMLElement)) throw new Error("the page has no element " + selector);
  return found;
}

// Makes an element; about: its class, or its properties, such as ariaLabel.
/**
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {string | number} [text]
 * @param {string | Partial<HTMLElementTagNameMap[Tag]>} [about]
 * @returns {HTMLElementTagNameMap[Tag]}
 */
export function make(tag, text, about = {}) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = String(text);
  return Object.assign(element, typeof about === "string" ? { className: about } : about);
}

// Makes an element around others, or texts.
/**
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {string | Partial<HTMLElementTagNameMap[Tag]>} about
 * @param {(Node | string)[]} content
 * @returns {HTMLElementTagNameMap[Tag]}
 */
export function around(tag, about, ...content) {
  const element = make(tag, undefined, about);
  element.append(...content);
  return element;
}

// Sets properties of an element that differ: the page is laid out again after each change.
/** @param {any} element @param {{ [name: string]: unknown }} properties */
export function change(element, properties) {
  for (const [name, value] of Object.entries(properties)) if (element[name] !== value) element[name] = value;
}

// Sets the choices of a select, pairs of a value and its label, if they are others; the value stays if it is among them. Browsers
// examine all forms of a page again when choices or values are set.
/** @type {(select: HTMLSelectElement, choices: [string, string][]) => void} */
export function setChoices(select, choices) {
  const text = JSON.stringify(choices), { value } = select;
  if (select.dataset.choices === text) return;
  select.dataset.choices = text;
  select.replaceChildren(...choices.map(([each, label]) => new Option(label, each)));
  if (choices.some(([each]) => each === value)) select.value = value;
}

const inks = new Map();

// Colour of the theme by the name of its variable.
/** @type {(name: string) => string} */
export function inkOf(name) {
  if (!inks.has(name)) inks.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return inks.get(name);
}

// -- themes ---------------------------------------------------------------------------------------------------------------

/** @type {string | null} */
let chosenTheme = null;
let themeChanged = () => {};

// Shows a theme, "dark" or "light", unless the user has chosen one.
/** @param {string} theme */
export function useTheme(theme) {
  if (chosenTheme || document.documentElement.dataset.theme === theme) return;
  document.documentElement.dataset.theme = theme;
  inks.clear();
  themeChanged();
}

// Uses the theme chosen on an earlier page, else that of the system; onChange is called when the theme changes.
/** @param {() => void} onChange */
export function startTheme(onChange) {
  const root = document.documentElement, system = matchMedia("(prefers-color-scheme: dark)");
  themeChanged = onChange;
  try { chosenTheme = localStorage.getItem("foveasim-theme"); } catch { /* not kept */ }
  if (chosenTheme !== "dark" && chosenTheme !== "light") chosenTheme = null;
  const show = () => { root.dataset.theme = chosenTheme || (system.matches ? "dark" : "light"); inks.clear(); };
  show();
  system.addEventListener("change", () => { if (!chosenTheme) { show(); onChange(); } });
  $("theme").addEventListener("click", () => {
    chosenTheme = root.dataset.theme === "dark" ? "light" : "dark";
    try { localStorage.setItem("foveasim-theme", chosenTheme); } catch { /* kept for this page alone */ }
    show();
    onChange();
  });
}

// -- notices, visible and for screen readers ----------------------------------------------------------------------------------

let noticing = 0, speaking = 0, isProblem = false;

// Shows a text for some seconds; a problem at most until its cause ends.
/** @param {string} text */
export function notice(text, ofProblem = false) {
  $("notice").textContent = text;
  $("notice").hidden = false;
  isProblem = ofProblem;
  clearTimeout(noticing);
  noticing = setTimeout(() => { $("notice").hidden = true; }, 2600);
}

// The cause of a problem has ended.
export function endProblem() { if (isProblem) $("notice").hidden = true; }

// Shows a notice until it is null.
/** @param {string | null} text */
export function stayingNotice(text) {
  clearTimeout(noticing);
  $("notice").hidden = text === null;
  if (text !== null) $("notice").textContent = text;
}

// Announces a text to screen readers after a short delay; null for none.
/** @param {(() => string) | null} textOrNull */
export function speak(textOrNull) {
  clearTimeout(speaking);
  if (textOrNull) speaking = setTimeout(() => { $("live").textContent = textOrNull(); }, 300);
}

// -- files ------------------------------------------------------------------------------------------------------------------

/** @param {Blob} blob @param {string} name @param {string} extension */
export function download(blob, name, extension) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name.replace(/[^\p{L}\p{N}_-]+/gu, "_").slice(0, 60) + "." + extension;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 5000);
}

/** @param {HTMLCanvasElement} canvas @param {string} name */
export function downloadPicture(canvas, name) { canvas.toBlob((blob) => { if (blob) download(blob, name, "png"); }); }

/** @param {string} text @param {string} name @param {string} extension @param {string} type */
export function downloadText(text, name, extension, type) {
  download(new Blob([text], { type: type + ";charset=utf-8" }), name, extension);
}

// -- keys -------------------------------------------------------------------------------------------------------------------

// Whether a key event is for the page: no text input, no selection, no open dialog, no modifier key.
/** @param {KeyboardEvent} event */
export function isForPage(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return false;
  return !(event.target instanceof Element && event.target.closest("input[type='text'], select"));
}

// The list of keys opens by its button and by "?", and closes by "?", Escape and a click outside.
export function listenToHelp() {
  const keys = $("keys");
  $("help").addEventListener("click", () => keys.showModal());
  document.addEventListener("keydown", (event) => {
    if (event.key !== "?" || event.ctrlKey || event.metaKey || event.altKey) return;
    if (keys.open) keys.close();
    else if (isForPage(event)) keys.showModal();
    else return;
    event.preventDefault();
  });
  closeOutside(keys);
}

// Closes a dialog by a click outside.
/** @param {HTMLDialogElement} dialog */
export function closeOutside(dialog) {
  dialog.addEventListener("click", ({ target, clientX: x, clientY: y }) => {
    const box = dialog.getBoundingClientRect();
    if (target === dialog && (x < box.left || x > box.right || y < box.top || y > box.bottom)) dialog.close();
  });
}
