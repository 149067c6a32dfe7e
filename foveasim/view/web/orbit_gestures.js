// Mouse, touch and keys that turn, pan and zoom a view in three dimensions.

import { listenToPointers } from "./gestures.js";
import { ARROWS } from "./shell.js";

/** @typedef {[number, number]} Direction azimuth and elevation */
/** @type {Direction} */
export const ASIDE = [Math.atan2(-0.9, 0.35), Math.atan2(0.75, Math.hypot(0.35, 0.9))];
/** @type {Direction} */
export const ABOVE = [-0.5 * Math.PI, 0.5 * Math.PI];

export class OrbitGestures {
  // Position of the mouse in CSS pixels, and the point on a surface under it, which stays there during zoom.
  /** @type {number[] | null} */ pointer = null;
  /** @type {Float64Array | null} */ anchor = null;

  // viewOf() is the SolidView, or null; ask() draws it; pin({ site, part }, isByKey); leave() when the mouse leaves.
  /**
   * @param {HTMLElement} canvas
   * @param {() => SolidView | null} viewOf
   * @param {{ ask: () => void, pin: (found: { site: number, part: number }, isByKey: boolean) => void, leave?: () => void }} on
   */
  constructor(canvas, viewOf, { ask, pin, leave }) {
    this.viewOf = viewOf;
    this.ask = ask;
    const point = new Float64Array(3);
    let held = 1;
    const ifView = (work) => (...args) => { const view = viewOf(); if (view) work(view.orbit, ...args); };
    const pick = (px, py, isByKey) => { const view = viewOf(); if (view) pin(view.pick(px, py), isByKey); };
    listenToPointers(canvas, {
      takesRightButton: true,
      press: ifView((orbit) => { held = this.anchor ? depthOf(orbit, this.anchor) : 1; }),
      drag: ifView((orbit, dx, dy, { isSecond, isMiddle }) => {
        if (isMiddle) orbit.zoom(Math.exp(0.005 * dy));
        else if (isSecond) orbit.pan(dx, dy, held);
        else orbit.turn((-2 * Math.PI * dx) / orbit.tall, (2 * Math.PI * dy) / orbit.tall);
        this.moved();
      }),
      pinch: ifView((orbit, factor, px, py) => { orbit.zoom(1 / factor, orbit.pointAt(px, py, 1, point)); this.moved(); }),
      // About the point under the mouse, cached since it arrived there; else in front of the target.
      wheel: ifView((orbit, factor, px, py) => {
        orbit.zoom(1 / factor, this.anchor || orbit.pointAt(px, py, 1, point));
        this.changed();
      }),
      click: (px, py) => pick(px, py, false),
      move: ifView((_orbit, px, py, isHeld) => { this.pointer = isHeld ? null : [px, py]; this.anchor = null; ask(); }),
      leave: ifView(() => { this.pointer = this.anchor = null; ask(); leave?.(); }),
    });
    canvas.addEventListener("keydown", (event) => {
      const orbit = viewOf()?.orbit, way = ARROWS[event.key];
      if (!orbit || event.ctrlKey || event.metaKey || event.altKey) return;
      if (way && event.shiftKey) { orbit.pan(-60 * way[0], 60 * way[1]); this.moved(); }
      else if (way) this.turn(0.12 * way[0], 0.1 * way[1]);
      else if (event.key === "Enter" || event.key === " ") pick(0.5 * orbit.width, 0.5 * orbit.tall, true);
      else if (!this.key(event)) return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // Zooms by a key, or looks from a direction; returns whether it does.
  key(event) {
    if (event.key === "+" || event.key === "=") this.approach(1.3);
    else if (event.key === "-" || event.key === "_") this.approach(1 / 1.3);
    else if (event.key === "0") this.look(ASIDE);
    else if (event.key === "t" || event.key === "T") this.look(ABOVE);
    else return false;
    return true;
  }

  // The site and part of the nearest surface under the mouse and the point on it, or null.
  under() {
    const { pointer } = this, view = this.viewOf();
    if (!view || !pointer) return null;
    const { site, part, depth } = view.pick(pointer[0], pointer[1]);
    const at = view.orbit.pointAt(pointer[0], pointer[1], depth, new Float64Array(3));
    this.anchor ||= at;
    return { site, part, at };
  }

  changed() {
    this.viewOf()?.change();
    this.ask();
  }

  // The view has changed, by more than a zoom about the mouse.
  moved() {
    this.anchor = null;
    this.changed();
  }

  look([azimuth, elevation]) { this.viewOf()?.orbit.look(azimuth, elevation); this.moved(); }
  turn(aside, up) { this.viewOf()?.orbit.turn(aside, up); this.moved(); }
  approach(factor) { this.viewOf()?.orbit.zoom(1 / factor); this.moved(); }
}

// Depth of a point, in units of the distance of the target.
function depthOf(orbit, position) {
  let depth = 1;
  for (let i = 0; i < 3; i++) depth -= (orbit.toEye[i] * (position[i] - orbit.target[i])) / orbit.distance;
  return Math.max(depth, 0.05);
}
