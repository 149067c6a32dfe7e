// A gaze path on the optical image: its line, points that can be dragged, and the present position.

import { clamp } from "/web/colours.js";
import { outline } from "/web/marks.js";

/** @typedef {import("./gaze_rows.js").GazeRow} GazeRow */

const SHADE = "rgb(0 0 0 / 65%)", INK = "#7fd4ff", RECORDED = "#ff8f85";
// Radii of points in CSS pixels, and distance within which one is taken.
const POINT = 3.2, CURRENT = 6, REACH = 7;
// Points that are closer than this in CSS pixels to the one before are not marked.
const APART = 7;
const DRAG_PIXELS = 3;

export class GazeMarks {
  /** @type {GazeRow[]} */ rows = [];
  /** @type {Point | null} */ position = null;
  isShown = false; isRecording = false; version = 0;
  // Point that is dragged.
  /** @type {{ index: number, row: GazeRow } | null} */ dragged = null;

  // Callbacks: moved(index, row) after a drag, chosen(index) after a click, redraw().
  /**
   * @param {ImagePane} pane
   * @param {{ moved: (index: number, row: GazeRow) => void, chosen: (index: number) => void, redraw: () => void }} on
   */
  constructor(pane, on) {
    this.pane = pane;
    this.on = on;
  }

  /** @param {GazeRow[]} rows @param {Point} position @param {{ isShown: boolean, isRecording: boolean }} about */
  use(rows, position, about) {
    const isSame = rows === this.rows && position.join() === this.position?.join() && about.isShown === this.isShown
      && about.isRecording === this.isRecording;
    if (isSame) return;
    Object.assign(this, { rows, position }, about);
    this._redraw();
  }

  _redraw() {
    this.version++;
    this.on.redraw();
  }

  // Displacement of the path in the picture: that of a camera that turns is centred on its gaze.
  get shift() {
    const [px, py] = this.pane.position, [x, y] = this.position || [px, py];
    return [px - x, py - y];
  }

  // Positions of rows in CSS pixels; of a drag for the point that is dragged.
  /** @param {View} view @returns {Point[]} */
  _points(view) {
    const [sx, sy] = this.shift, { dragged } = this;
    return this.rows.map((row, k) => {
      const [, x, y] = dragged?.index === k ? dragged.row : row;
      return [view.toX(x + sx), view.toY(y + sy)];
    });
  }

  // Indices of the points that are marked.
  /** @param {Point[]} points */
  _marked(points) {
    const found = [];
    for (let k = 0; k < points.length; k++) {
      const before = found.length ? points[found[found.length - 1]] : null;
      if (!before || Math.hypot(points[k][0] - before[0], points[k][1] - before[1]) >= APART) found.push(k);
    }
    return found;
  }

  /** @param {CanvasRenderingContext2D} context @param {View} view */
  draw(context, view) {
    if (!this.isShown) return;
    const points = this._points(view), ink = this.isRecording ? RECORDED : INK;
    const dots = this._marked(points).map((k) => points[k]);
    outline(context, () => { for (const [x, y] of points) context.lineTo(x, y); }, [3.5, 1.5], [SHADE, ink]);
    const circles = (/** @type {Point[]} */ centres, /** @type {number} */ radius) => {
      for (const [x, y] of centres) {
        context.moveTo(x + radius, y);
        context.arc(x, y, radius, 0, 7);
      }
    };
    outline(context, () => circles(dots, POINT), [3, 1], [SHADE, ink]);
    context.fillStyle = ink;
    context.fill();
    if (!this.position) return;
    const [sx, sy] = this.shift, [x, y] = this.position;
    outline(context, () => circles([[view.toX(x + sx), view.toY(y + sy)]], CURRENT), [4, 2], [SHADE, "#ffffff"]);
  }

  // Takes the point at a position in CSS pixels; null without one. The grip follows the pointer until its end.
  /** @param {View} view @param {number} px @param {number} py */
  grip(view, px, py) {
    if (!this.isShown || this.isRecording) return null;
    const points = this._points(view), distances = points.map(([x, y]) => Math.hypot(x - px, y - py));
    const near = this._marked(points).filter((k) => distances[k] < REACH).sort((a, b) => distances[a] - distances[b]);
    if (!near.length) return null;
    const index = near[0], [t, x, y] = this.rows[index];
    return {
      move: (/** @type {number} */ mx, /** @type {number} */ my) => {
        if (!this.dragged && Math.hypot(mx - px, my - py) < DRAG_PIXELS) return;
        const to = (/** @type {number} */ from, /** @type {number} */ by) => {
          const { perUm } = this.pane.view(), digits = clamp(Math.ceil(Math.log10(perUm)) + 1, 1, 4);
          return Number((from + by / perUm).toFixed(digits));
        };
        this.dragged = { index, row: [t, to(x, mx - px), to(y, py - my)] };
        this._redraw();
      },
      end: (/** @type {boolean} */ isDone) => {
        const { dragged } = this;
        this.dragged = null;
        if (dragged && isDone) this.on.moved(index, dragged.row);
        else if (isDone) this.on.chosen(index);
        this._redraw();
      },
    };
  }
}
