// The map: stores the visible part of the sensor, and draws all sites by WebGL2.

import { clamp } from "./colours.js";
import { TEXTURE_WIDTH, bindIntegers, buildProgram, createLookup, fitCanvas, sendLookup, textureSize } from "./gl.js";

const VERTEX_SHADER = `#version 300 es
in ivec2 position;
in uint site;
uniform ivec2 centre;
uniform vec2 rest;
uniform vec2 zoom;
uniform highp sampler2D colours;
flat out vec4 colour;
void main() {
  colour = texelFetch(colours, ivec2(int(site) % ${TEXTURE_WIDTH}, int(site) / ${TEXTURE_WIDTH}), 0);
  // Integers subtract exactly, so that outlines are sharp at any zoom.
  gl_Position = vec4((vec2(position - centre) - rest) * zoom, 0.0, 1.0);
}`;
const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
flat in vec4 colour;
out vec4 pixel;
void main() { pixel = colour; }`;
// Positions as integers: number of steps along the longer side of the layout.
const LATTICE = 2 ** 30;
// Largest zoom: ratio of the width of the layout to that of the view.
const DEEPEST = 1e7;

// The visible part of a sensor on a canvas: its centre in µm, and the scale in CSS pixels per µm.
export class MapView {
  // Given by use().
  /** @type {Sites} */ sites;
  // Another map with the same view, whose sites are shown, too.
  /** @type {MapView | null} */ compared = null;
  /** @type {Uint32Array<ArrayBuffer>} */ colours;
  /** @type {number} */ extent;
  /** @type {number} */ x;
  /** @type {number} */ y;

  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.scale = 1;
    this.width = this.height = 1;
  }

  // Shows sites, at first with their centre in the middle.
  /** @param {Sites} sites */
  use(sites) {
    const [x0, y0, x1, y1] = sites.bounds;
    this.sites = sites;
    this.extent = Math.max(x1 - x0, y1 - y0);
    if (this.x === undefined) [this.x, this.y] = this.middle;
    this.colours = new Uint32Array(textureSize(sites.n));
  }

  // Conversion from µm on the sensor to CSS pixels of the map, and back; y points up on the sensor.
  /** @param {number} x */
  toX(x) { return 0.5 * this.width + (x - this.x) * this.scale; }
  /** @param {number} y */
  toY(y) { return 0.5 * this.height - (y - this.y) * this.scale; }
  /** @param {number} px */
  fromX(px) { return this.x + (px - 0.5 * this.width) / this.scale; }
  /** @param {number} py */
  fromY(py) { return this.y - (py - 0.5 * this.height) / this.scale; }

  /** @param {number} width @param {number} height */
  resize(width, height) {
    this.width = Math.max(1, width);
    this.height = Math.max(1, height);
    fitCanvas(this.canvas, this.width, this.height);
  }

  // Bounds of all sites, also of those of the compared map.
  get bounds() {
    const { bounds } = this.sites, other = this.compared?.sites.bounds;
    return other ? Array.from(bounds, (value, k) => (k < 2 ? Math.min : Math.max)(value, other[k])) : bounds;
  }

  /** @returns {Point} */
  get middle() {
    const [x0, y0, x1, y1] = this.bounds;
    return [0.5 * (x0 + x1), 0.5 * (y0 + y1)];
  }

  // The scale at which all sites are in view.
  fitScale() {
    const [x0, y0, x1, y1] = this.bounds;
    return 0.94 * Math.min(this.width / (x1 - x0), this.height / (y1 - y0));
  }

  /** @param {number} x @param {number} y @param {number} scale */
  set(x, y, scale) {
    const [x0, y0, x1, y1] = this.bounds, fit = this.fitScale();
    this.scale = clamp(scale, 0.5 * fit, DEEPEST * fit);
    this.x = clamp(x, x0, x1);
    this.y = clamp(y, y0, y1);
  }

  // Zooms by a factor about a pixel.
  /** @param {number} factor @param {number} px @param {number} py */
  zoom(factor, px, py) {
    const x = this.fromX(px), y = this.fromY(py), fit = this.fitScale();
    const scale = clamp(this.scale * factor, 0.5 * fit, DEEPEST * fit);
    this.set(x - (px - 0.5 * this.width) / scale, y + (py - 0.5 * this.height) / scale, scale);
  }
}

export class SensorMap extends MapView {
  // Given by use().
  /** @type {number} */ perUm;
  /** @type {{ reach: number[], from: number, to: number }[]} */ tiles;

  /** @param {HTMLCanvasElement} canvas @param {Sites} sites @param {Renderer} renderer */
  constructor(canvas, sites, renderer) {
    super(canvas);
    this.gl = canvas.getContext("webgl2", { antialias: !renderer.isSlow, alpha: false, depth: false, powerPreference: "high-performance" });
    this.use(sites);
  }

  /** @param {Sites} sites */
  use(sites) {
    super.use(sites);
    this.perUm = LATTICE / this.extent;
    if (!this.gl) return;
    this._free();
    this._load();
  }

  _load() {
    const { gl, sites } = this;
    if (!gl) return;
    this.built = this.built || buildProgram(gl, VERTEX_SHADER, FRAGMENT_SHADER, ["position", "site"]);
    gl.useProgram(this.built.program);
    this.at = this.built.at;

    const n = sites.position.length, positions = new Int32Array(2 * n), owners = new Uint32Array(n);
    for (let v = 0; v < n; v++) {
      const p = 2 * sites.position[v];
      positions[2 * v] = Math.round((sites.xy[p] - this.middle[0]) * this.perUm);
      positions[2 * v + 1] = Math.round((sites.xy[p + 1] - this.middle[1]) * this.perUm);
    }
    for (let site = 0; site < sites.n; site++) owners.fill(site, sites.firstVertex(site), sites.firstVertex(site + 1));
    const outlines = gl.createVertexArray(), indices = gl.createBuffer();
    gl.bindVertexArray(outlines);
    const buffers = [bindIntegers(gl, 0, positions, 2, gl.INT), bindIntegers(gl, 1, owners, 1, gl.UNSIGNED_INT), indices];
    const { corners, tiles } = sites.triangles();
    this.tiles = tiles;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.loaded = { outlines, buffers, lookup: createLookup(gl) };
  }

  // Frees the GPU resources of the sites before.
  _free() {
    const { gl } = this;
    if (!gl || !this.loaded) return;
    const { outlines, buffers, lookup } = this.loaded;
    gl.deleteVertexArray(outlines);
    for (const buffer of buffers) gl.deleteBuffer(buffer);
    gl.deleteTexture(lookup);
    this.loaded = null;
  }

  sendColours() { sendLookup(this.gl, new Uint8Array(this.colours.buffer)); }

  // Restores all GPU resources after the graphics context was lost.
  restore() {
    this.built = null;
    this._load();
    this.sendColours();
  }

  /** @param {number[]} ground */
  draw(ground) {
    const { gl, canvas } = this;
    if (!gl) return;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(ground[0] / 255, ground[1] / 255, ground[2] / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const centre = [(this.x - this.middle[0]) * this.perUm, (this.y - this.middle[1]) * this.perUm];
    const whole = centre.map(Math.round);
    gl.uniform2i(this.at.centre, whole[0], whole[1]);
    gl.uniform2f(this.at.rest, centre[0] - whole[0], centre[1] - whole[1]);
    gl.uniform2f(this.at.zoom, (2 * this.scale) / this.perUm / this.width, (2 * this.scale) / this.perUm / this.height);
    const x0 = this.fromX(0), x1 = this.fromX(this.width), y0 = this.fromY(this.height), y1 = this.fromY(0);
    let from = -1, to = -1;
    const flush = () => { if (to > from) gl.drawElements(gl.TRIANGLES, to - from, gl.UNSIGNED_INT, 4 * from); };
    for (const tile of this.tiles) {
      const [a, b, c, d] = tile.reach;
      if (a > x1 || c < x0 || b > y1 || d < y0) continue;
      if (tile.from !== to) { flush(); from = tile.from; }
      to = tile.to;
    }
    flush();
  }
}
