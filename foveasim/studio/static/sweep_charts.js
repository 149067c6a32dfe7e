// Charts of a sweep whose points can be chosen: a map of two settings, and two results against each other.

import { brief, clamp } from "/web/colours.js";
import { COLOUR_MAPS, mapColour } from "/web/colour_maps.js";
import { watchSize } from "/web/gl.js";
import { inkOf, make } from "/web/page_parts.js";
import { FONT, axisOf, axisTitle, limitsOf, paintTicks, paintTitles } from "./charts.js";
import { sizeOf } from "./frames.js";
import { isWide } from "./number_settings.js";
import { fitted } from "./site_pane.js";
import { paretoFront } from "./sweep_points.js";

/** @typedef {import("./sweep_points.js").SweepPoints} SweepPoints */

// Points within this distance of the mouse are chosen, CSS pixels.
const REACH = 24;
export const HINT = "Click a point to apply its settings.";
// Colours of a bar, and pixels between two labels of an axis.
const BAR_STEPS = 48, WIDE_STEP = 54, TALL_STEP = 17;

// A canvas with points; choose(k) is called when one is clicked.
class PointChart {
  margins = { left: 50, right: 12, top: 10, bottom: 32 };
  area = { left: 0, top: 0, w: 1, h: 1, width: 1, height: 1 };
  // The point below the mouse, or -1.
  at = -1;

  /**
   * present: present settings; result: index of the result; isSmaller(): whether smaller values of each result are better.
   * @typedef {{ points: SweepPoints, present: number[], choose: (k: number) => void, result?: number, isSmaller?: () => boolean[] }} About
   * @param {HTMLElement} root @param {About} about
   */
  constructor(root, { points, present, choose, result = 0, isSmaller = () => [] }) {
    this.root = root;
    this.points = points;
    this.present = present;
    this.choose = choose;
    this.result = result;
    this.isSmaller = isSmaller;
    this.canvas = make("canvas", undefined, { className: "choosable", role: "img" });
    this.note = make("p", HINT, "chart-note quiet");
    root.append(this.canvas, this.note);
    watchSize(this.canvas, () => this.draw());
    this.canvas.addEventListener("pointermove", (event) => this._point(event));
    this.canvas.addEventListener("pointerleave", () => this._show(-1));
    this.canvas.addEventListener("click", (event) => {
      this._point(event);
      if (this.at >= 0) this.choose(this.at);
    });
  }

  // For screen readers.
  get label() { return ""; }

  // The point at a position on the canvas, or -1.
  /** @type {(px: number, py: number) => number} */
  find() { return -1; }

  /** @type {(context: any, area: { left: number, top: number, w: number, h: number }, isShown: boolean) => void} */
  paintPoints() {}

  // Takes over further points, or other present settings.
  use(points, present) {
    this.points = points;
    this.present = present;
    if (this.at >= points.values.length) this.at = -1;
    this.draw();
  }

  _point(event) {
    const box = this.canvas.getBoundingClientRect();
    this._show(this.find(event.clientX - box.left, event.clientY - box.top));
  }

  _show(k) {
    if (k === this.at) return;
    this.at = k;
    this.note.textContent = k < 0 ? HINT : this.points.text(k);
    this.draw();
  }

  draw() { if (sizeOf(this.root).width) this.paint(null); }

  // Draws the chart on its canvas, or a file.
  paint(target) {
    const { context, width, height } = target || fitted(this.canvas), { left, right, top, bottom } = this.margins;
    context.font = FONT;
    context.lineWidth = 1;
    this.area = { left, top, w: width - left - right, h: height - top - bottom, width, height };
    this.canvas.ariaLabel = this.label;
    this.paintPoints(context, this.area, !target);
  }

  // A ring in both colours of the theme, visible on any colour.
  _ring(context, x, y, radius = 6) {
    for (const [ink, width] of Object.entries({ "--raised": 4, "--text": 1.5 })) {
      context.strokeStyle = inkOf(ink);
      context.lineWidth = width;
      context.beginPath();
      context.arc(x, y, radius, 0, 7);
      context.stroke();
    }
  }
}

// Positions of the values of an axis and of the borders between them, from 0 to 1.
function cellsOf({ values, is_log: isLog }) {
  const at = values.map((value) => (isLog ? Math.log(value) : value)), n = at.length;
  if (n === 1) return { borders: [0, 1], toUnit: () => 0.5 };
  const inner = at.slice(1).map((value, i) => 0.5 * (value + at[i]));
  const borders = [2 * at[0] - inner[0], ...inner, 2 * at[n - 1] - inner[n - 2]], span = borders[n] - borders[0];
  const toUnit = (value) => ((isLog ? Math.log(value) : value) - borders[0]) / span;
  return { borders: borders.map((border) => (border - borders[0]) / span), toUnit };
}

// A result over two settings, as colours.
export class HeatMap extends PointChart {
  margins = { left: 54, right: 58, top: 22, bottom: 32 };

  get label() {
    const [x, y] = this.points.axes, [low, high] = limitsOf([this.points.result(this.result)]);
    return "Map of " + this.points.measures[this.result].subject + " against " + x.label + " and " + y.label + ", from " + brief(low)
      + " to " + brief(high);
  }

  rows() { return this.points.rows(); }

  find(px, py) {
    const { left, top, w, h } = this.area, [x, y] = this.points.axes.map(cellsOf);
    const of = ({ borders }, t) => borders.findIndex((border, i) => t >= border && t < borders[i + 1]);
    const i = of(x, (px - left) / w), j = of(y, (top + h - py) / h);
    const k = i * this.points.axes[1].values.length + j;
    return i >= 0 && j >= 0 && k < this.points.values.length ? k : -1;
  }

  paintPoints(context, { left, top, w, h }, isShown) {
    const { points, result, present, at } = this, [axisX, axisY] = points.axes;
    const [x, y] = [cellsOf(axisX), cellsOf(axisY)], values = points.result(result), [low, high] = limitsOf([values]);
    const scale = axisOf(low, high, isWide(low, high)), n = axisY.values.length;
    /** @type {(k: number) => [number, number, number, number]} */
    const box = (k) => {
      const i = Math.floor(k / n), j = k % n, x0 = left + x.borders[i] * w, y1 = top + h - y.borders[j] * h;
      return [x0, top + h - y.borders[j + 1] * h, left + x.borders[i + 1] * w - x0, y1 - (top + h - y.borders[j + 1] * h)];
    };
    values.forEach((value, k) => this._cell(context, value, scale, box(k)));
    this._frame(context, [x, y]);
    this._bar(context, scale);
    const [px, py] = present.map((value, i) => [x, y][i].toUnit(value));
    if (px >= 0 && px <= 1 && py >= 0 && py <= 1) this._ring(context, left + px * w, top + h - py * h);
    if (isShown && at >= 0) {
      const [bx, by, bw, bh] = box(at);
      context.strokeStyle = inkOf("--text");
      context.lineWidth = 2;
      context.beginPath();
      context.rect(bx + 1, by + 1, bw - 2, bh - 2);
      context.stroke();
    }
  }

  // A cell; one without a result is crossed out.
  _cell(context, value, scale, [x, y, w, h]) {
    if (!Number.isNaN(value)) {
      context.fillStyle = "rgb(" + mapColour(COLOUR_MAPS[0], clamp(scale.at(value), 0, 1)).join(",") + ")";
      context.fillRect(x, y, w + 0.5, h + 0.5);
      return;
    }
    context.fillStyle = inkOf("--sunken");
    context.fillRect(x, y, w, h);
    const size = Math.min(w, h, 14) / 4, [cx, cy] = [x + 0.5 * w, y + 0.5 * h];
    context.strokeStyle = inkOf("--quiet");
    context.beginPath();
    for (const sign of [-1, 1]) {
      context.moveTo(cx - size, cy - sign * size);
      context.lineTo(cx + size, cy + sign * size);
    }
    context.stroke();
  }

  _frame(context, [x, y]) {
    const { left, top, w, h } = this.area, [axisX, axisY] = this.points.axes;
    context.strokeStyle = inkOf("--line");
    context.beginPath();
    context.rect(left, top, w, h);
    context.stroke();
    context.fillStyle = inkOf("--quiet");
    context.textAlign = "center";
    // Labels of some values, which do not overlap.
    const label = (axis, cells, length, step, draw) => {
      let last = -Infinity;
      for (const value of axis.values) {
        const at = cells.toUnit(value) * length;
        if (at - last >= step) { draw(String(Number(value.toPrecision(3))), at); last = at; }
      }
    };
    label(axisX, x, w, WIDE_STEP, (text, at) => context.fillText(text, left + at, top + h + 14));
    context.textAlign = "right";
    label(axisY, y, h, TALL_STEP, (text, at) => context.fillText(text, left - 5, top + h - at + 4));
    paintTitles(context, this.area, axisTitle(axisX.label, axisX.unit), axisTitle(axisY.label, axisY.unit));
  }

  // The bar of colours with its title above.
  _bar(context, scale) {
    const { left, top, w, h, width } = this.area, x = left + w + 8, { subject, unit } = this.points.measures[this.result];
    for (let step = 0; step < BAR_STEPS; step++) {
      context.fillStyle = "rgb(" + mapColour(COLOUR_MAPS[0], (step + 0.5) / BAR_STEPS).join(",") + ")";
      context.fillRect(x, top + h - ((step + 1) * h) / BAR_STEPS, 9, h / BAR_STEPS + 0.5);
    }
    context.fillStyle = inkOf("--quiet");
    context.textAlign = "left";
    for (const tick of scale.ticks(Math.max(2, h / 34))) {
      const t = scale.at(tick);
      if (t >= -1e-9 && t <= 1 + 1e-9) context.fillText(scale.text(tick), x + 12, top + h - t * h + 4);
    }
    context.textAlign = "right";
    context.fillText(axisTitle(subject, unit === "fraction" ? "" : unit), width - 6, 13);
  }
}

// Two results against each other, with the points that no other one dominates.
export class ParetoChart extends PointChart {
  get front() { return paretoFront(this.points.values, this.isSmaller()); }

  get label() {
    const [x, y] = this.points.measures, { front } = this;
    return "Pareto chart of " + y.subject + " against " + x.subject + ": " + front.length + " of " + this.points.values.length
      + " points are not dominated";
  }

  rows() {
    const front = new Set(this.front);
    return this.points.rows({ "not dominated": (k) => (front.has(k) ? "yes" : "no") });
  }

  _axes() {
    const span = (values) => {
      const [low, high] = limitsOf([values]), isLog = isWide(low, high), edge = 0.06 * (high - low);
      return isLog ? axisOf(low / 1.2, high * 1.2, true) : axisOf(low - edge, high + edge, false);
    };
    const present = this.points.present(this.present);
    return [0, 1].map((j) => span([...this.points.result(j), ...(present ? [present[j]] : [])]));
  }

  /** @type {(results: number[]) => Point} */
  _place([x, y]) {
    const { left, top, w, h } = this.area, [axisX, axisY] = this._axes();
    return [left + axisX.at(x) * w, top + h - axisY.at(y) * h];
  }

  find(px, py) {
    const distances = this.points.values.map((values) => {
      const [x, y] = this._place(values);
      return Number.isFinite(x) && Number.isFinite(y) ? Math.hypot(x - px, y - py) : Infinity;
    });
    const nearest = distances.indexOf(Math.min(...distances));
    return distances[nearest] <= REACH ? nearest : -1;
  }

  paintPoints(context, area, isShown) {
    const [axisX, axisY] = this._axes(), { points, at } = this, front = this.front, isFront = new Set(front);
    const [x, y] = points.measures, places = points.values.map((values) => this._place(values));
    const title = ({ subject, unit }) => axisTitle(subject, unit === "fraction" ? "" : unit);
    paintTicks(context, area, axisX, axisY);
    paintTitles(context, area, title(x), title(y));
    context.strokeStyle = inkOf("--accent");
    context.lineWidth = 1.5;
    context.beginPath();
    const corners = front.map((k) => places[k]).filter((place) => place.every(Number.isFinite));
    corners.forEach(([px, py], i) => (i ? context.lineTo(px, py) : context.moveTo(px, py)));
    context.stroke();
    places.forEach(([px, py], k) => {
      if (Number.isFinite(px) && Number.isFinite(py)) this._dot(context, px, py, isFront.has(k));
    });
    const present = points.present(this.present);
    const ring = (place, radius) => this._ring(context, place[0], place[1], radius);
    if (present?.every(Number.isFinite)) ring(this._place(present), 8);
    if (isShown && at >= 0) ring(places[at], 5);
  }

  // Points on the front are filled and larger.
  _dot(context, x, y, isFront) {
    context.beginPath();
    context.arc(x, y, isFront ? 4.5 : 3, 0, 7);
    context.fillStyle = inkOf(isFront ? "--accent" : "--raised");
    context.fill();
    context.strokeStyle = inkOf(isFront ? "--accent" : "--quiet");
    context.lineWidth = 1.5;
    context.stroke();
  }
}
