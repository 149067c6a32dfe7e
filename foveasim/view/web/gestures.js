// Mouse, pen and touch events on a canvas as drags, pinches, wheel steps and clicks; positions are in its CSS pixels.

import { clamp } from "./colours.js";

// A pointer that moves less than this between down and up is a click.
const CLICK_PIXELS = 4;

// Calls the callbacks that are given: press(px, py), drag(dx, dy, { px, py, isSecond, isMiddle }), pinch(factor, px, py),
// wheel(factor, px, py), click(px, py), move(px, py, isHeld), leave(). Factors above 1 zoom in. isSecond: with
// two fingers, the right button, or Shift, Ctrl or Meta.
/** @param {HTMLElement} canvas @param {PointerCallbacks} on */
export function listenToPointers(canvas, on) {
  /** @type {Map<number, Point>} */
  const pointers = new Map();
  let travelled = 0, pinch = 0, isSecond = false, isMiddle = false;
  /** @type {(event: MouseEvent) => Point} */
  const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const apart = () => {
    const [a, b] = [...pointers.values()];
    return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
    on.wheel(Math.exp(-clamp(event.deltaY * lines, -400, 400) * (event.ctrlKey ? 0.01 : 0.002)), ...at(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    on.press?.(...at(event));
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at(event));
    travelled = 0;
    pinch = apart();
    isSecond = event.button === 2 || event.shiftKey || event.ctrlKey || event.metaKey;
    isMiddle = event.button === 1;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [px, py] = at(event), before = pointers.get(event.pointerId);
    if (before) {
      const part = 1 / pointers.size, dx = (px - before[0]) * part, dy = (py - before[1]) * part;
      travelled += Math.abs(dx) + Math.abs(dy);
      pointers.set(event.pointerId, [px, py]);
      if (travelled > CLICK_PIXELS) {
        canvas.classList.add("held");
        on.drag(dx, dy, { px, py, isSecond: isSecond || pointers.size > 1, isMiddle });
        if (pointers.size === 2) {
          const [a, b] = [...pointers.values()], now = apart();
          if (pinch > 0) on.pinch(now / pinch, 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]));
          pinch = now;
        }
      }
    }
    on.move(px, py, pointers.size > 0);
  });
  /** @param {PointerEvent} event */
  const release = (event) => {
    pointers.delete(event.pointerId);
    pinch = apart();
    if (!pointers.size) canvas.classList.remove("held");
  };
  canvas.addEventListener("pointerup", (event) => {
    const isClick = pointers.has(event.pointerId) && pointers.size === 1 && travelled <= CLICK_PIXELS;
    release(event);
    if (isClick && event.button === 0) on.click(...at(event));
  });
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => { if (!pointers.size) on.leave(); });
  canvas.addEventListener("contextmenu", (event) => { if (on.takesRightButton) event.preventDefault(); });
}
