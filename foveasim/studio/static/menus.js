// Menus that open from a button, and dialogs with a text.

import { $, around, closeOutside, make, notice } from "/web/page_parts.js";
import { buttonOf } from "./elements.js";

// A menu of buttons: arrows move, Escape and clicks outside close it.
export function listenToMenu(button, menu) {
  const items = () => [...menu.querySelectorAll("button:not(:disabled)")].filter((item) => item.offsetParent);
  const show = (isOpen) => {
    menu.hidden = !isOpen;
    button.setAttribute("aria-expanded", String(isOpen));
    if (isOpen) items()[0]?.focus();
  };
  button.setAttribute("aria-haspopup", "true");
  button.setAttribute("aria-expanded", "false");
  button.addEventListener("click", () => show(menu.hidden));
  menu.addEventListener("click", (event) => { if (event.target.closest("button")) { show(false); button.focus(); } });
  menu.addEventListener("keydown", (event) => {
    const all = items(), at = all.indexOf(document.activeElement);
    const next = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: all.length - 1 }[event.key];
    if (event.key === "Escape") { show(false); button.focus(); event.stopPropagation(); }
    else if (next !== undefined) { all[(next + all.length) % all.length]?.focus(); event.preventDefault(); }
  });
  document.addEventListener("pointerdown", (event) => {
    if (!menu.hidden && !menu.contains(event.target) && !button.contains(event.target)) show(false);
  });
  menu.addEventListener("focusout", (event) => {
    if (event.relatedTarget && !menu.contains(event.relatedTarget) && event.relatedTarget !== button) show(false);
  });
}

// A button that opens a menu, which ends at its right, after fill().
/** @param {string} text @param {Partial<HTMLButtonElement>} about */
export function menuOf(text, about, fill = () => {}) {
  const button = buttonOf(text + " ", fill, about), menu = make("div", undefined, { className: "menu right", hidden: true });
  button.append(make("span", "▾", { ariaHidden: "true" }));
  listenToMenu(button, menu);
  return { menu, frame: around("div", "menu-frame", button, menu) };
}

export async function copyText(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    notice(what + " copied");
  } catch {
    showText(what, text);
  }
}

// Shows a text in a dialog, with a button to copy it.
export function showText(title, text) {
  $("text-title").textContent = title;
  const lines = text.split("\n").map((line) => make("span", line + "\n",
    /^\+(?!\+\+)/.test(line) ? "added" : /^-(?!--)/.test(line) ? "removed" : undefined));
  $("text").replaceChildren(...(title === "Differences" ? lines : [text]));
  if (!$("text-dialog").open) $("text-dialog").showModal();
}

// Answers the question of the dialog that is open.
/** @type {((isConfirmed: boolean) => void) | null} */
let answer = null;

// Resolves to whether the user confirms a question; the verb is that of the button.
/** @type {(question: string, verb: string) => Promise<boolean>} */
export function confirmed(question, verb) {
  const dialog = $("confirm-dialog");
  $("confirm-title").textContent = question;
  $("confirm-verb").textContent = verb;
  answer?.(false);
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => { answer = resolve; });
}

export function listenToDialogs() {
  $("confirm-dialog").addEventListener("close", () => {
    // The event of an earlier question may be late.
    if ($("confirm-dialog").open) return;
    answer?.($("confirm-dialog").returnValue === "yes");
    answer = null;
  });
  $("text-copy").addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText($("text").textContent || "");
      $("text-copy").textContent = "Copied";
    } catch {
      getSelection()?.selectAllChildren($("text"));
    }
    setTimeout(() => { $("text-copy").textContent = "Copy"; }, 1500);
  });
  document.querySelectorAll("dialog").forEach(closeOutside);
}
