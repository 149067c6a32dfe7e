// Work in the next frame of the browser, and sizes without a layout for each.

import { begin } from "./pending.js";

// Browsers may draw no frame for a long time, for example after their graphics process was busy: the work is then done anyway.
const LATE_MS = 1000;

/** @param {() => void} work */
export function inNextFrame(work) {
  let isDone = false;
  const end = begin();
  const once = () => {
    if (isDone) return;
    isDone = true;
    clearTimeout(timer);
    end();
    work();
  };
  const timer = setTimeout(once, LATE_MS);
  requestAnimationFrame(once);
}

const sizes = new WeakMap();
const observer = new ResizeObserver((entries) => { for (const { target } of entries) measure(target); });

/** @param {Element} element */
function measure(element) {
  const size = { width: element.clientWidth, height: element.clientHeight };
  sizes.set(element, size);
  return size;
}

// Size of an element in CSS pixels, as of the last layout of the page: reading it from the element would cause another layout.
// An element that was hidden until now is measured.
/** @type {(element: Element) => { width: number, height: number }} */
export function sizeOf(element) {
  const known = sizes.get(element);
  if (known && (known.width > 0 || element.closest("[hidden]"))) return known;
  if (!known) observer.observe(element);
  return measure(element);
}
