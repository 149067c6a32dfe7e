// Files of a chart: its numbers as CSV, and its drawing as SVG or PNG.

import { context2d } from "/web/gl.js";
import { downloadPicture, downloadText, inkOf, make, notice } from "/web/page_parts.js";
import { selectOf, svgOf } from "./elements.js";

// Size of files in CSS pixels, and pixels of a PNG per CSS pixel.
export const WIDE = 640, TALL = 400, SHARP = 2;

// The part of a drawing context that charts use, which makes elements of SVG.
export class SvgContext {
  fillStyle = "#000"; strokeStyle = "#000"; lineWidth = 1; font = "11px sans-serif"; textAlign = "left";
  /** @type {number[]} */ dash = [];
  path = ""; transform = "";
  /** @type {{ [name: string]: any }[]} */ saved = [];

  constructor(width, height, background) {
    this.root = svgOf("svg", { viewBox: `0 0 ${width} ${height}`, width, height, "font-family": "system-ui, sans-serif" });
    this._add("rect", { width, height, fill: background });
  }

  _add(name, values, text = "") {
    const element = svgOf(name, values);
    if (this.transform) element.setAttribute("transform", this.transform);
    if (text) element.textContent = text;
    this.root.append(element);
  }

  beginPath() { this.path = ""; }
  moveTo(x, y) { this.path += `M${x.toFixed(2)} ${y.toFixed(2)}`; }
  // A line from nowhere begins there, as on a canvas.
  lineTo(x, y) { this.path += `${this.path ? "L" : "M"}${x.toFixed(2)} ${y.toFixed(2)}`; }
  rect(x, y, w, h) { this.path += `M${x} ${y}h${w}v${h}h${-w}z`; }
  arc(x, y, r) { this.path += `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`; }
  stroke() {
    if (this.path) this._add("path", { d: this.path, fill: "none", stroke: this.strokeStyle, "stroke-width": this.lineWidth,
      ...(this.dash.length ? { "stroke-dasharray": this.dash.join(" ") } : {}) });
  }
  fill() { if (this.path) this._add("path", { d: this.path, fill: this.fillStyle }); }
  fillRect(x, y, width, height) {
    this._add("rect", { x, y, width: Math.max(0, width), height: Math.max(0, height), fill: this.fillStyle });
  }
  fillText(text, x, y) {
    const anchor = { center: "middle", right: "end" }[this.textAlign] || "start";
    this._add("text", { x, y, fill: this.fillStyle, "font-size": parseFloat(this.font), "text-anchor": anchor }, text);
  }
  setLineDash(dash) { this.dash = dash; }
  translate(x, y) { this.transform += `translate(${x} ${y})`; }
  rotate(angle) { this.transform += `rotate(${(180 * angle) / Math.PI})`; }
  save() { this.saved.push({ transform: this.transform, fillStyle: this.fillStyle, strokeStyle: this.strokeStyle, dash: this.dash }); }
  restore() { Object.assign(this, this.saved.pop()); }
  toString() { return new XMLSerializer().serializeToString(this.root); }
}

// Text of a field of CSV.
const quoted = (text) => '"' + text.replaceAll('"', '""') + '"';
const cell = (value) => (typeof value === "number" ? String(value) : /[",\n]/.test(value) ? quoted(value) : value);

/** @type {(rows: (string | number)[][]) => string} */
export const csvOf = (rows) => rows.map((row) => row.map(cell).join(",")).join("\n") + "\n";

// Adds a choice of files to the heading of a tile. chart() returns an object with rows(), and paint({ context, width, height }).
/** @param {Element} root @param {string} name @param {() => any} chart */
export function addFiles(root, name, chart) {
  const select = selectOf(["Save…", "CSV", "SVG", "PNG"].map((text) => [text.toLowerCase(), text]), "Save " + name + " as");
  const file = name.toLowerCase().replaceAll(" ", "_");
  select.className = "chart-file";
  select.addEventListener("change", () => {
    const kind = select.value, found = chart();
    select.selectedIndex = 0;
    if (!found?.rows().length) notice("The chart has no data");
    else save(found, kind, file);
  });
  root.querySelector("h2")?.append(select);
}

function save(chart, kind, file) {
  if (kind === "csv") { downloadText(csvOf(chart.rows()), file, "csv", "text/csv"); return; }
  if (kind === "svg") {
    const context = new SvgContext(WIDE, TALL, inkOf("--raised"));
    chart.paint({ context, width: WIDE, height: TALL });
    downloadText(context.toString(), file, "svg", "image/svg+xml");
    return;
  }
  const canvas = make("canvas", undefined, { width: SHARP * WIDE, height: SHARP * TALL }), context = context2d(canvas);
  context.scale(SHARP, SHARP);
  context.fillStyle = inkOf("--raised");
  context.fillRect(0, 0, WIDE, TALL);
  chart.paint({ context, width: WIDE, height: TALL });
  downloadPicture(canvas, file);
}
