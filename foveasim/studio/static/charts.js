// Charts on canvases, with axes and units: curves with a readout, a histogram with a range, and bars of noise sources.

import { brief, clamp, roundStep, shown } from "/web/colours.js";
import { watchSize } from "/web/gl.js";
import { around, inkOf, make } from "/web/page_parts.js";
import { listenToRange } from "/web/shell.js";
import { addFiles } from "./chart_files.js";
import { svgOf } from "./elements.js";
import { sizeOf } from "./frames.js";
import { quantity, unitText } from "./numbers.js";
import { fitted } from "./site_pane.js";

export const FONT = "11px system-ui, sans-serif";
// Names of curves with a colour of their own; other curves have the next of the list, by theme.
const NAMED = { R: ["#c62828", "#ff7b72"], G: ["#1b7f3b", "#5fd37f"], B: ["#1f5fbf", "#7db3ff"], W: ["#566073", "#c3cad6"] };
const INKS = [["#1f5fbf", "#7db3ff"], ["#c2571a", "#ffa657"], ["#1b7f3b", "#5fd37f"], ["#8338a8", "#d2a8ff"], ["#a02c5a", "#ff8cc0"],
  ["#566073", "#c3cad6"]];
const STEPS = 72;
// Margins of the histogram.
const LEFT = 46, RIGHT = 10;
// Dashes of curves, which thus differ by more than their colour; those of variant A are thinner and end with a letter.
const DASHES = [[], [7, 3], [2, 2.5], [9, 3, 2, 3], [4, 3], [1, 4]];

const theme = () => (document.documentElement.dataset.theme === "dark" ? 1 : 0);
const isMain = (curve) => !curve.isDashed && !curve.isLimit;
/** @type {(curve: any, k: number) => string} */
const inkOfCurve = (curve, k) => (k < 0 ? inkOf("--quiet") : (NAMED[curve.name] || INKS[k % INKS.length])[theme()]);
export const axisTitle = (name, unit) => (unit ? name + " / " + unitText(unit) : name);

function ticksOf(low, high, most) {
  const step = roundStep((high - low) / most), ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(Number((k * step).toPrecision(12)));
  return ticks;
}

export function limitsOf(arrays) {
  let low = Infinity, high = -Infinity;
  for (const values of arrays) for (const v of values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  return low === Infinity ? [0, 1] : [low, high > low ? high : low + 1];
}

// Round numbers up to a largest one whose square roots are far apart, from the largest.
export function rootTicks(most, least = 0.22) {
  const ticks = [];
  for (let e = Math.floor(Math.log10(most)); e >= 0; e--) {
    for (const step of [8, 6, 5, 4, 3, 2, 1.5, 1]) {
      const tick = step * 10 ** e, root = Math.sqrt(tick / most);
      const above = ticks.length ? Math.sqrt(ticks[ticks.length - 1] / most) : Infinity;
      if (Number.isInteger(tick) && root <= 1 && root >= least && above - root >= least) ticks.push(tick);
    }
  }
  return ticks;
}

// Powers of ten in a range; with few of them also 2 and 5 times.
function decadesOf(low, high, most) {
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high)), skip = Math.ceil((last - first) / Math.max(1, most));
  const ticks = [];
  for (let e = first; e <= last; e++) {
    for (const step of 3 * (last - first) <= most ? [1, 2, 5] : [1]) {
      const tick = Number((step * 10 ** e).toPrecision(3));
      if ((e - first) % skip === 0 && tick >= 0.999 * low && tick <= 1.001 * high) ticks.push(tick);
    }
  }
  return ticks;
}

const decadeText = (value) => (value >= 1e-3 && value < 1e4 ? String(value) : value.toExponential(0).replace("e+", "e"));

// Conversion of numbers to fractions of an axis, and its ticks.
export function axisOf(low, high, isLog) {
  if (!isLog) return { low, high, isLog, at: (v) => (v - low) / (high - low), value: (t) => low + t * (high - low),
    ticks: (most) => ticksOf(low, high, most), text: brief };
  const span = Math.log(high / low);
  return { low, high, isLog, at: (v) => Math.log(v / low) / span, value: (t) => low * Math.exp(t * span),
    ticks: (most) => decadesOf(low, high, most), text: decadeText };
}

// Draws the grid of the vertical axis, the ticks of the horizontal one, and their numbers, in the area of a chart.
export function paintTicks(context, { left, top, w, h, width }, axisX, axisY) {
  context.strokeStyle = inkOf("--line");
  context.fillStyle = inkOf("--quiet");
  context.lineWidth = 1;
  context.beginPath();
  context.textAlign = "right";
  for (const tick of axisY.ticks(Math.max(2, h / (axisY.isLog ? 20 : 34)))) {
    const y = Math.round(top + h - axisY.at(tick) * h) + 0.5;
    context.moveTo(left, y);
    context.lineTo(left + w, y);
    context.fillText(axisY.text(tick), left - 5, y + 3.5);
  }
  context.textAlign = "center";
  for (const tick of axisX.ticks(Math.max(2, w / (axisX.isLog ? 40 : 60)))) {
    const x = Math.round(left + axisX.at(tick) * w) + 0.5;
    context.moveTo(x, top + h);
    context.lineTo(x, top + h + 4);
    context.fillText(axisX.text(tick), clamp(x, left + 4, width - 14), top + h + 15);
  }
  context.stroke();
}

// Writes the titles of both axes below and left of the area of a chart.
export function paintTitles(context, { left, top, w, h, height }, x, y) {
  context.fillStyle = inkOf("--quiet");
  context.textAlign = "center";
  context.fillText(x, left + 0.5 * w, height - 4);
  context.save();
  context.translate(9, top + 0.5 * h);
  context.rotate(-Math.PI / 2);
  context.fillText(y, 0, 0);
  context.restore();
}

// Limits of positive numbers for a logarithmic axis.
function decadeLimits(arrays) {
  let low = Infinity, high = 0;
  for (const values of arrays) for (const v of values) if (v > 0 && v < Infinity) { low = Math.min(low, v); high = Math.max(high, v); }
  return low === Infinity ? [1, 10] : [low, Math.max(high, 1.01 * low)];
}

// Curves y of x with their legend; those with isDashed are of variant A, those with isLimit are limits of the others. Axes in
// "log" (such as "xy") are logarithmic; with hasZero, others begin at zero.
export class CurveChart {
  root; nameX; nameY; label; log; hasZero; marks = []; lines = [];
  // Conversion of numbers to CSS pixels, of the last drawing on the page.
  /** @type {((x: number, y: number) => Point) | null} */ place = null;

  constructor(root, { nameX, nameY, label, log = "", hasZero = true }) {
    Object.assign(this, { root, nameX, nameY, label, log, hasZero });
    this.canvas = make("canvas", undefined, { role: "img" });
    this.legend = make("ul", undefined, "chart-legend");
    this.note = make("p", "", { className: "chart-note quiet", hidden: true });
    root.append(this.canvas, this.legend, this.note);
    this.curves = [];
    this.at = null;
    watchSize(this.canvas, () => this.draw());
    this.canvas.addEventListener("pointermove", (event) => {
      this.at = event.clientX - this.canvas.getBoundingClientRect().left;
      this.draw();
    });
    this.canvas.addEventListener("pointerleave", () => { this.at = null; this.draw(); });
  }

  // Curves: [{ label, name, unit_x, unit_y, x, y, isDashed, isLimit }]; marks on them: [{ x, y, name, kind }], "end" for a bar,
  // "point" for a small dot, "open" for a ring, else a dot; vertical lines: [{ x, label, of }].
  use(curves, { marks = [], lines = [], note = "" } = {}) {
    Object.assign(this, { curves, marks, lines });
    this.note.textContent = unitText(note);
    this.note.hidden = !note;
    const own = curves.filter(isMain);
    const largest = own.map((curve) => curve.label + ", largest value " + shown(Number(limitsOf([curve.y])[1].toPrecision(3))));
    this.canvas.ariaLabel = this.label + ": " + (largest.join("; ") || "no data");
    this.draw();
  }

  // Rows of a file: the curves one below the other.
  rows() {
    const { curves } = this, [first] = curves;
    if (!first) return [];
    const head = ["curve", axisTitle(this.nameX, first.unit_x), axisTitle(this.nameY, first.unit_y)];
    const name = (curve) => (curve.isDashed ? "A: " : "") + curve.label;
    return [head, ...curves.flatMap((curve) => Array.from(curve.x, (x, i) => [name(curve), x, curve.y[i]]))];
  }

  draw() {
    if (sizeOf(this.root).width) this.paint(null);
  }

  // Draws the chart on its canvas, or a file, which has the legend in the drawing.
  paint(target) {
    const { curves } = this, own = curves.filter(isMain), left = 46, right = 10, bottom = 32;
    const top = target ? 8 + 15 * curves.length : 8;
    const indices = curves.map((curve) => own.findIndex((one) => one.label === curve.label));
    const inks = curves.map((curve, k) => inkOfCurve(curve, indices[k]));
    const dashes = curves.map((curve, k) => DASHES[curve.isLimit ? 2 : Math.max(indices[k], 0) % DASHES.length]);
    const isLogX = this.log.includes("x"), isLogY = this.log.includes("y");
    const allX = [...curves.map((curve) => curve.x), this.marks.map((mark) => mark.x)];
    const axisX = axisOf(...(isLogX ? decadeLimits(allX) : limitsOf(allX)), isLogX);
    const wide = (target || sizeOf(this.canvas)).width - left - right;
    const here = target || this.at === null || !own.length ? null : axisX.value(clamp((this.at - left) / wide, 0, 1));
    // The legend first: the rest of the height is for the canvas.
    if (!target) this._listCurves(curves, inks, dashes, here, own);
    const { context, width, height } = target || fitted(this.canvas);
    context.font = FONT;
    if (target) this._paintLegend(context, inks, dashes);
    if (!own.length) {
      context.fillStyle = inkOf("--quiet");
      context.fillText("no data", 8, 20);
      return;
    }
    const allY = curves.map((curve) => curve.y), [low, high] = limitsOf(allY), [lowest, highest] = decadeLimits(allY);
    const edge = 0.04 * (high - low), linear = this.hasZero ? [Math.min(0, low), high * 1.04] : [low - edge, high + edge];
    const axisY = isLogY ? axisOf(0.9 * lowest, 1.3 * highest, true) : axisOf(linear[0], linear[1], false);
    const w = width - left - right, h = height - top - bottom;
    const toX = (v) => left + axisX.at(v) * w, toY = (v) => top + h - axisY.at(v) * h;
    if (!target) this.place = (x, y) => [toX(x), toY(y)];
    const area = { left, top, w, h, width, height };
    paintTicks(context, area, axisX, axisY);
    this._drawLines(context, curves, inks, { toX, top, h, right: left + w });
    paintTitles(context, area, axisTitle(this.nameX, own[0].unit_x), axisTitle(this.nameY, own[0].unit_y));
    context.textAlign = "left";
    curves.forEach((curve, k) => {
      context.strokeStyle = inks[k];
      context.lineWidth = isMain(curve) ? 2 : 1;
      context.setLineDash(dashes[k]);
      context.beginPath();
      let isDown = false;
      /** @type {Point | null} */
      let last = null;
      for (let i = 0; i < curve.x.length; i++) {
        if (!Number.isFinite(curve.y[i])) { isDown = false; continue; }
        if (isDown) context.lineTo(toX(curve.x[i]), toY(curve.y[i]));
        else context.moveTo(toX(curve.x[i]), toY(curve.y[i]));
        isDown = true;
        last = [toX(curve.x[i]), toY(curve.y[i])];
      }
      context.stroke();
      if (!curve.isDashed || !last) return;
      context.fillStyle = inks[k];
      context.fillText("A", clamp(last[0] - 9, left, left + w - 9), clamp(last[1] - 4, top + 9, top + h - 2));
    });
    context.setLineDash([]);
    for (const mark of this.marks) this._drawMark(context, mark, toX(mark.x), toY(Math.max(mark.y, axisY.low)), own, inks);
    if (here !== null) {
      context.fillStyle = inkOf("--quiet");
      context.fillRect(toX(here), top, 1, h);
    }
  }

  _paintLegend(context, inks, dashes) {
    this.curves.forEach((curve, k) => {
      const y = 12 + 15 * k;
      context.strokeStyle = inks[k];
      context.lineWidth = isMain(curve) ? 2 : 1;
      context.setLineDash(dashes[k]);
      context.beginPath();
      context.moveTo(50, y);
      context.lineTo(78, y);
      context.stroke();
      context.fillStyle = inkOf("--text");
      context.textAlign = "left";
      context.fillText((curve.isDashed ? "A: " : "") + curve.label, 84, y + 4);
    });
    context.setLineDash([]);
  }

  // Vertical lines in the colours of the curves of the same label, with a triangle on the axis.
  _drawLines(context, curves, inks, { toX, top, h, right }) {
    for (const line of this.lines) {
      const k = curves.findIndex((curve) => curve.label === line.label && isMain(curve)), x = Math.round(toX(line.x)) + 0.5;
      if (!(x <= right + 1)) continue;
      context.strokeStyle = context.fillStyle = k < 0 ? inkOf("--quiet") : inks[k];
      context.lineWidth = 1;
      context.setLineDash([2, 3]);
      context.beginPath();
      context.moveTo(x, top);
      context.lineTo(x, top + h);
      context.stroke();
      context.setLineDash([]);
      context.beginPath();
      context.moveTo(x, top + h - 6);
      context.lineTo(x - 4, top + h);
      context.lineTo(x + 4, top + h);
      context.fill();
    }
  }

  _drawMark(context, mark, x, y, own, inks) {
    const k = own.findIndex((curve) => curve.name === mark.name);
    context.fillStyle = mark.name && k >= 0 ? inks[this.curves.indexOf(own[k])] : inkOf("--text");
    context.strokeStyle = inkOf("--raised");
    context.lineWidth = 1.5;
    context.beginPath();
    if (mark.kind === "end") context.rect(x - 1.25, y - 6, 2.5, 12);
    else context.arc(x, y, mark.kind === "point" || mark.kind === "open" ? 3 : 4.5, 0, 7);
    context.stroke();
    context.fill();
    if (mark.kind !== "open") return;
    context.fillStyle = inkOf("--raised");
    context.beginPath();
    context.arc(x, y, 1.75, 0, 7);
    context.fill();
  }

  _listCurves(curves, inks, dashes, here, own) {
    const items = curves.map((curve, k) => {
      const value = here === null ? "" : " " + brief(Number(valueAt(curve, here).toPrecision(3)));
      const line = isMain(curve) ? this.lines.find((one) => one.label === curve.label) : null;
      const text = (curve.isDashed ? "A: " : "") + curve.label + value
        + (line && here === null ? ", " + line.of + " " + quantity(line.x, own[0].unit_x, 3) : "");
      return around("li", {}, swatchOf(inks[k], dashes[k], !isMain(curve)), make("span", text));
    });
    if (here !== null) items.unshift(make("li", quantity(here, own[0].unit_x)));
    this.legend.replaceChildren(...items);
  }
}

// Calls choose() with the nearest point of a click, of curves that have the indices of their points.
/** @param {CurveChart} chart @param {(k: number) => void} choose */
export function listenToPoints(chart, choose) {
  chart.canvas.addEventListener("click", ({ clientX, clientY }) => {
    const box = chart.canvas.getBoundingClientRect(), found = { distance: Infinity, point: -1 };
    for (const { x, y, points } of chart.curves) {
      points.forEach((point, i) => {
        const [px, py] = chart.place?.(x[i], y[i]) ?? [NaN, NaN], distance = Math.hypot(px + box.left - clientX, py + box.top - clientY);
        if (distance < found.distance) Object.assign(found, { distance, point });
      });
    }
    if (found.point >= 0) choose(found.point);
  });
}

// A short line as in the chart.
function swatchOf(ink, dash, isThin) {
  const swatch = svgOf("svg", { width: 26, height: 8, viewBox: "0 0 26 8", "aria-hidden": true });
  swatch.append(svgOf("line", { x1: 0, x2: 26, y1: 4, y2: 4, stroke: ink, "stroke-dasharray": dash.join(" "),
    "stroke-width": isThin ? 1 : 2.5 }));
  return swatch;
}

const curvesOf = ({ about, arrays }, isDashed) =>
  about.curves.map((curve, k) => ({ ...curve, x: arrays["x-" + k], y: arrays["y-" + k], isDashed }));
const isSame = (one, other) => one.label === other.label && one.y.length === other.y.length && one.y.every((v, i) => v === other.y[i]);

// Returns the function "create" of a view that shows curves of the server, with those of variant A as dashed ones.
export const curveView = (options) => (root) => {
  const frame = make("div", undefined, { className: "chart", id: root.id.replace("tile-", "") }), chart = new CurveChart(frame, options);
  root.append(frame);
  addFiles(root, root.querySelector("h2")?.textContent ?? options.label, () => chart);
  return {
    chart,
    draw: () => chart.draw(),
    use(part, before) {
      const curves = curvesOf(part, false), others = before ? curvesOf(before, true) : [];
      // Curves of A that are equal in B would be hidden.
      chart.use([...curves, ...others.filter((one) => !curves.some((other) => isSame(one, other)))], part.about);
    },
  };
};

// Linear interpolation on increasing x.
function valueAt({ x, y }, at) {
  let i = 1;
  while (i < x.length - 1 && x[i] < at) i++;
  const t = clamp((at - x[i - 1]) / (x[i] - x[i - 1] || 1), 0, 1);
  return y[i - 1] + t * (y[i] - y[i - 1]);
}

// Histogram of a column along its scale; dragging selects a range of values. Heights are square roots of counts, so that
// a few sites among many are visible.
export class Histogram {
  // Range and value of the last drawing; the left end of the scale and its width in CSS pixels.
  /** @type {[Interval?, number?]} */ drawn = [];
  left = 0; wide = 1;

  constructor(root, onRange) {
    this.canvas = make("canvas", undefined, { role: "img" });
    this.root = root;
    root.append(this.canvas);
    watchSize(this.canvas, () => this.draw(...this.drawn));
    const fractionOf = (event) => (event.clientX - this.canvas.getBoundingClientRect().left - this.left) / this.wide;
    listenToRange(this.canvas, () => this.scale, fractionOf, onRange);
  }

  use(scale, other) {
    this.scale = scale;
    this.counts = scale.histogram(STEPS);
    this.others = other ? other.histogram(STEPS) : null;
  }

  draw(range, value) {
    this.drawn = [range, value];
    if (!this.scale || !sizeOf(this.root).width) return;
    const target = fitted(this.canvas);
    this.left = LEFT;
    this.wide = target.width - LEFT - RIGHT;
    this.paint(target);
  }

  // Rows of a file: the values at the ends of the steps, and the number of photosites.
  rows() {
    const { scale, counts } = this;
    if (!scale) return [];
    const { label, unit } = scale.column, value = (k) => Number(scale.value(k / counts.length).toPrecision(8));
    return [[axisTitle(label + " from", unit), axisTitle(label + " to", unit), "photosites"],
      ...Array.from(counts, (count, k) => [value(k), value(k + 1), count])];
  }

  // Draws the histogram on its canvas, or a file.
  paint({ context, width, height }) {
    const { scale, counts, others, drawn: [range, value] } = this, left = LEFT, top = 8, bottom = 32, w = width - left - RIGHT;
    const h = height - top - bottom;
    if (!scale || !counts) return;
    const most = Math.max(1, ...counts, ...(others || [])), tall = (count) => (count ? Math.max(1.5, Math.sqrt(count / most) * h) : 0);
    const step = w / counts.length, inside = inkOf("--accent"), outside = inkOf("--line");
    const [from, to] = range ? range.map((v) => left + scale.fraction(v) * w) : [-1, width + 1];
    context.font = FONT;
    context.fillStyle = inkOf("--quiet");
    context.textAlign = "right";
    for (const count of rootTicks(most)) {
      const y = Math.round(top + h - Math.sqrt(count / most) * h) + 0.5;
      context.fillText(brief(count), left - 5, y + 3.5);
      context.fillStyle = inkOf("--line");
      context.fillRect(left, y - 0.5, w, 1);
      context.fillStyle = inkOf("--quiet");
    }
    counts.forEach((count, i) => {
      const x = left + i * step;
      context.fillStyle = x + step > from && x < to ? inside : outside;
      context.fillRect(x, top + h - tall(count), Math.max(step - (step > 3 ? 0.75 : 0), 0.5), tall(count));
    });
    if (others && others.length === counts.length) {
      context.strokeStyle = inkOf("--text");
      context.lineWidth = 1;
      context.beginPath();
      others.forEach((count, i) => {
        const y = top + h - tall(count);
        context.lineTo(left + i * step, y);
        context.lineTo(left + (i + 1) * step, y);
      });
      context.stroke();
    }
    context.fillStyle = inkOf("--line");
    context.fillRect(left, top + h, w, 1);
    context.fillStyle = inkOf("--quiet");
    context.textAlign = "center";
    const { column } = scale, isKinds = column.kind === "kinds";
    const ticks = isKinds && column.names && column.names.length <= 12 ? column.names.map((_, k) => k) : scale.ticks(Math.max(2, w / 48));
    for (const tick of ticks) {
      const at = isKinds ? (tick - scale.from + 0.5) * step : scale.fraction(tick) * w;
      if (at >= -0.5 && at <= w + 0.5) context.fillText(isKinds && column.names ? column.names[tick] : brief(tick),
        clamp(left + at, left, width - 14), top + h + 15);
    }
    paintTitles(context, { left, top, w, h, height }, axisTitle(column.label, column.unit), "photosites");
    if (value !== undefined && Number.isFinite(value)) {
      context.fillStyle = inkOf("--text");
      context.fillRect(clamp(left + scale.fraction(value) * w - 1, left, left + w - 2), top, 2, h);
    }
    this.canvas.ariaLabel = "Histogram of " + column.label + " from " + shown(scale.lowest) + " to " + shown(scale.highest);
  }
}

// Rows of horizontal bars: sources of noise by size, with those of variant A as a line.
export function barRows(sources, others, unit) {
  const before = new Map((others || []).map((source) => [source.name, source.values]));
  const most = Math.max(1e-12, ...sources.map((source) => source.values), ...before.values());
  return [...sources].sort((a, b) => b.values - a.values).map((source) => {
    const bar = make("i", undefined, source.is_temporal === false ? "fixed" : {}), was = before.get(source.name);
    const track = around("span", "track", bar), name = source.label || source.name.replaceAll("_", " ");
    bar.style.width = (100 * source.values) / most + "%";
    if (was !== undefined) {
      const mark = make("b", undefined, { title: "A: " + quantity(was, unit, 3) });
      mark.style.left = (100 * was) / most + "%";
      track.append(mark);
    }
    return around("li", {}, make("span", name), track, make("span", quantity(source.values, unit, 3)));
  });
}
