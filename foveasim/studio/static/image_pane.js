// A picture on the sensor: the reconstructed picture or the optical image, with the cursor and the view of the map.

import { context2d, pixelRatio } from "/web/gl.js";
import { drawCross, drawView, outline } from "/web/marks.js";
import { make } from "/web/page_parts.js";
import { ARROWS } from "/web/shell.js";
import { sizeOf } from "./frames.js";
import { fitted } from "./site_pane.js";

// Distance in µm of one step of the gaze by an arrow key, as a fraction of the frame.
const GAZE_STEP = 0.02;

export class ImagePane {
  // Callbacks: hover(x, y, pane), leave(), click(x, y), on the layout; gaze(dx, dy, isFinal). canMove() is whether the gaze can be
  // dragged; mapOf() is the map whose view the picture can follow.
  constructor(root, on, { label, mapOf, canMove = () => false }) {
    this.root = root;
    this.on = on;
    this.mapOf = mapOf;
    this.canMove = canMove;
    this.image = make("canvas", undefined, { className: "image", ariaHidden: "true" });
    this.marks = make("canvas", undefined, { className: "marks", tabIndex: 0, role: "application", ariaLabel: label });
    root.append(this.image, this.marks);
    this.pixels = make("canvas");
    /** @type {number[] | null} */
    this.bounds = null;
    this.follows = false;
    // Position of the layout in the image.
    /** @type {Point} */
    this.position = [0, 0];
    // Drag of the outline: its position on the picture at the start, from the lower left corner, and its displacement.
    /** @type {{ from: Point, offset: Point } | null} */
    this.drag = null;
    // Path of the gaze, whose points can be dragged.
    /** @type {import("./gaze_marks.js").GazeMarks | null} */
    this.path = null;
    this._listen();
  }

  _listen() {
    const { marks, on } = this;
    // In CSS pixels.
    /** @type {(event: MouseEvent) => Point} */
    const onMarks = (event) => {
      const box = marks.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    // Point of the layout.
    /** @type {(event: MouseEvent) => Point} */
    const at = (event) => {
      const [x, y] = onMarks(event), view = this.view(), [px, py] = this.place;
      return [view.fromX(x) - px, view.fromY(y) - py];
    };
    /** @typedef {ReturnType<import("./gaze_marks.js").GazeMarks["grip"]>} Grip */
    /** @type {{ clientX: number, clientY: number, isOnLayout: boolean, grip: Grip } | null} */
    let start = null;
    marks.addEventListener("pointerdown", (event) => {
      if (!this.bounds || event.button !== 0) return;
      const grip = this.path?.grip(this.view(), ...onMarks(event)) ?? null;
      start = { grip,  clientX: event.clientX, clientY: event.clientY, isOnLayout: this._isInFrame(at(event)) };
      marks.setPointerCapture(event.pointerId);
    });
    marks.addEventListener("pointermove", (event) => {
      if (!this.bounds) return;
      if (start?.grip) { start.grip.move(...onMarks(event)); return; }
      if (!start || !start.isOnLayout || !this.canMove()) {
        on.hover(...at(event), this);
        return;
      }
      // In pixels: the image of a camera that turns moves during the drag.
      const dx = event.clientX - start.clientX, dy = start.clientY - event.clientY, { perUm } = this.view();
      if (!this.drag && Math.hypot(dx, dy) < 4) return;
      const [x0, y0] = this.bounds, [px, py] = this.place;
      /** @type {Point} */
      const offset = [dx / perUm, dy / perUm];
      this.drag = { from: this.drag ? this.drag.from : [px - x0, py - y0], offset };
      marks.classList.add("held");
      on.gaze(...offset, false);
    });
    const end = (event) => {
      const { drag } = this;
      if (start?.grip) start.grip.end(event.type === "pointerup");
      else if (drag) {
        if (event.type === "pointerup") on.gaze(...drag.offset, true);
        else on.gaze(0, 0, true);
      } else if (start && event.type === "pointerup") on.click(...at(event));
      this.drag = start = null;
      marks.classList.remove("held");
    };
    marks.addEventListener("pointerup", end);
    marks.addEventListener("pointercancel", end);
    marks.addEventListener("pointerleave", () => { if (!start) on.leave(); });
    marks.addEventListener("keydown", (event) => {
      const step = ARROWS[event.key];
      if (!step || !this.frame || !this.canMove() || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      const [a, , c] = this.frame, length = GAZE_STEP * (c - a) * (event.shiftKey ? 5 : 1);
      on.gaze(step[0] * length, step[1] * length, true);
    });
  }

  _isInFrame([x, y]) {
    if (!this.frame) return false;
    const [a, b, c, d] = this.frame;
    return x >= a && x <= c && y >= b && y <= d;
  }

  // Where the outline of the layout is: its position in the image, or that of a drag.
  /** @returns {Point} */
  get place() {
    if (!this.drag || !this.bounds) return this.position;
    const [x0, y0] = this.bounds, { from, offset } = this.drag;
    return [x0 + from[0] + offset[0], y0 + from[1] + offset[1]];
  }

  use({ width, height, bounds_um: bounds, frame_um: frame, position_um: position }, rgba) {
    this.bounds = bounds;
    this.position = position || [0, 0];
    this.frame = frame || null;
    this.pixels.width = width;
    this.pixels.height = height;
    const context = context2d(this.pixels, { willReadFrequently: true });
    context.putImageData(new ImageData(new Uint8ClampedArray(rgba.buffer, rgba.byteOffset, rgba.length), width, height), 0, 0);
  }

  // Conversions between µm on the sensor and CSS pixels: the complete picture, or the view of a map.
  view() {
    const { width, height } = sizeOf(this.root), [x0, y0, x1, y1] = this.bounds || [0, 0, 1, 1];
    let x = 0.5 * (x0 + x1), y = 0.5 * (y0 + y1), perUm = Math.min(width / (x1 - x0), height / (y1 - y0));
    const map = this.follows ? this.mapOf() : null;
    if (map) {
      [x, y] = [map.x + this.position[0], map.y + this.position[1]];
      perUm = map.scale * Math.min(width / map.width, height / map.height);
    }
    return {
      perUm, width, height,
      toX: (u) => 0.5 * width + (u - x) * perUm, toY: (v) => 0.5 * height - (v - y) * perUm,
      fromX: (px) => x + (px - 0.5 * width) / perUm, fromY: (py) => y - (py - 0.5 * height) / perUm,
    };
  }

  // Longer side of the complete picture in pixels of the screen.
  neededPixels() {
    const { width, height } = sizeOf(this.root), ratio = pixelRatio();
    if (!this.bounds || !width) return Math.min(width, height) * ratio;
    const [x0, y0, x1, y1] = this.bounds;
    return Math.max(x1 - x0, y1 - y0) * this.view().perUm * ratio;
  }

  get isShown() { return Boolean(this.bounds) && sizeOf(this.root).width > 0; }

  draw() {
    if (!this.bounds || !this.isShown) return;
    const { context } = fitted(this.image), view = this.view(), [x0, y0, x1, y1] = this.bounds;
    const wide = (x1 - x0) * view.perUm, tall = (y1 - y0) * view.perUm;
    // Pixels of several screen pixels have sharp edges.
    context.imageSmoothingEnabled = wide / this.pixels.width < 4;
    context.imageSmoothingQuality = wide > 0.7 * this.pixels.width ? "low" : "high";
    context.drawImage(this.pixels, view.toX(x0), view.toY(y1), wide, tall);
  }

  // Marks: cursor, the map whose view is a rectangle, the boundary of the layout.
  drawMarks({ cursor, map, boundary }) {
    if (!this.isShown) return;
    const view = this.view(), isAt = cursor && cursor.from !== this, [px, py] = this.place;
    const state = JSON.stringify([view.width, view.height, view.toX(0), view.toY(0), view.perUm, this.frame, px, py,
      this.path?.version, isAt && [cursor.x, cursor.y], map && !this.follows && [map.x, map.y, map.scale, map.width, map.height]]);
    // Drawn again only when the marks change: each layer costs time to compose the page.
    if (state === this.shown && boundary === this.shownBoundary) return;
    this.shown = state;
    this.shownBoundary = boundary;
    const { context, width, height } = fitted(this.marks);
    const onLayout = { ...view, toX: (/** @type {number} */ u) => view.toX(u + px), toY: (/** @type {number} */ v) => view.toY(v + py) };
    if (boundary && this.frame) {
      outline(context, () => boundary(context, onLayout.toX, onLayout.toY), [3.5, 1.5], ["rgb(0 0 0 / 60%)", "#ffd34d"]);
    }
    this.path?.draw(context, view);
    if (map && !this.follows) drawView(context, onLayout, map, width, height);
    if (isAt) drawCross(context, onLayout.toX(cursor.x), onLayout.toY(cursor.y), true);
  }
}
