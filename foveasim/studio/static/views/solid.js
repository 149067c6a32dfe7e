// Three dimensions: photosites as columns of their values, and the layers of the sensor. Only computed while it is shown.

import { Bodies } from "/web/bodies.js";
import { brief, bytesOfHex, clamp } from "/web/colours.js";
import { listenToPointers } from "/web/gestures.js";
import { findRenderer, pixelRatio, textureSize, watchSize } from "/web/gl.js";
import { titleOf } from "/web/legend.js";
import { drawCross } from "/web/marks.js";
import { Orbit } from "/web/orbit.js";
import { $, inkOf } from "/web/page_parts.js";
import { ARROWS } from "/web/shell.js";
import { SolidView } from "/web/solid_view.js";
import { Columns } from "../columns.js";
import { inNextFrame } from "../frames.js";
import { fitted } from "../site_pane.js";

const NO_WEBGL = "This browser has no WebGL2, which three dimensions need; enable graphics acceleration, or use another browser.";
const ASIDE = [Math.atan2(-0.9, 0.35), Math.atan2(0.75, Math.hypot(0.35, 0.9))], ABOVE = [-0.5 * Math.PI, 0.5 * Math.PI];
// Height of prisms of categories, as a fraction of the tallest.
const KIND_HEIGHT = 0.2;
// Height of the layers in the first view, as a fraction of the longer side.
const STACK_HEIGHT = 0.05;
// Each upper layer is cut further by this fraction of the depth of the sensor.
const TERRACE = 0.06;
const LAYERS = ["wells", "trenches", "filters", "lenses"];

const PAGE = `<div class="bar">
    <div class="group" role="group" aria-label="Content">
      <button type="button" data-solid="columns" aria-pressed="true" title="Photosites as columns of their values">Columns</button>
      <button type="button" data-solid="stack" aria-pressed="false"
        title="Layers of the sensor: silicon, trenches, colour filters, microlenses">Layers</button>
    </div>
    <span class="space"></span>
    <button type="button" id="solid-above" title="Top view (T)">Top</button>
    <button type="button" id="solid-fit" title="Show all (0)" aria-label="Show all"></button>
  </div>
  <div class="stage"><div class="half" id="solid">
    <canvas class="cells" aria-hidden="true"></canvas>
    <canvas class="marks" tabindex="0" role="application" aria-label="The sensor in three dimensions. Arrow keys rotate, with Shift
      they pan, plus and minus zoom, 0 shows all, T shows the top view, Enter pins the photosite in the centre."></canvas>
    <p id="solid-note" hidden></p>
  </div></div>
  <div class="bar sliders">
    <label>Height <input type="range" id="solid-height" min="-2" max="7" step="0.25" value="0"> <span id="solid-factor">× 1</span></label>
    <label hidden>Cut <input type="range" id="solid-cut" min="0" max="100" step="1" value="30"></label>
    <span id="solid-text" class="quiet"></span>
  </div>`;

export const create = (root, studio) => new SolidPane(root, studio);

class SolidPane {
  root; studio; cursor = null; mode = "columns"; view = null; shown = {}; hovered = -1; pinned = -1; isAsked = false; source = null;
  stack = null; pointer = null; anchor = null; factors = {};

  constructor(root, studio) {
    Object.assign(this, { root, studio });
    this._build();
    this.half = $("solid");
    this.canvas = this.half.querySelector(".cells");
    this.marks = /** @type {HTMLCanvasElement} */ (this.half.querySelector(".marks"));
    watchSize(this.half, () => this._resize());
    for (const button of this.buttons) button.addEventListener("click", () => this.setMode(button.dataset.solid));
    $("solid-height").addEventListener("input", () => this._setHeight(2 ** Number($("solid-height").value)));
    $("solid-cut").addEventListener("input", () => this._cut());
    $("solid-fit").addEventListener("click", () => this._look(ASIDE));
    $("solid-above").addEventListener("click", () => this._look(ABOVE));
    this._listen();
  }

  // A pane next to the map instead of a tile.
  _build() {
    const { root } = this, heading = root.querySelector("h2");
    root.className = "pane";
    root.dataset.view = "solid";
    root.removeAttribute("tabindex");
    root.insertAdjacentHTML("beforeend", PAGE);
    root.querySelector(".bar").prepend(heading);
    this.buttons = [...root.querySelectorAll("[data-solid]")];
    $("solid-fit").append($("fit").firstElementChild.cloneNode(true));
    $("pane-picture").before(root);
  }

  get isShown() { return !this.root.hidden && this.half.clientWidth > 0; }

  // Layers are data of the server, columns those of the map.
  get wantsData() { return this.mode === "stack"; }

  setMode(mode) {
    this.mode = mode;
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.solid === mode));
    this.studio.sendViews();
    this.ask();
  }

  onShown(isShown) { document.body.classList.toggle("solid", isShown); }

  // Takes sites, scale and range of the map of photosites.
  onMap() {
    const { sites, scale, range } = this.studio.panes.b;
    this.source = scale ? { sites, scale, range } : null;
    this.ask();
  }

  use(part) {
    this.stack = part;
    this.ask();
  }

  ask() {
    if (this.isAsked || this.root.hidden) return;
    this.isAsked = true;
    inNextFrame(() => { this.isAsked = false; this._draw(); });
  }

  // -- content ----------------------------------------------------------------------------------------------------------

  // Returns whether there is something to show; text explains when there is not.
  _update() {
    const { source, mode, shown } = this, ground = inkOf("--map");
    if (!source) return false;
    if (this.renderer === undefined) this.renderer = findRenderer();
    if (!this.renderer) return this._explain(NO_WEBGL);
    const content = mode === "columns" ? source.sites : this.stack;
    if (!content || (mode === "stack" && !content.about.bodies)) return this._explain(content ? content.about.note
      : "Computing the layers…");
    if (mode === "stack" && content.about.n_sites !== source.sites.n) return Boolean(this.view) && shown.content !== undefined;
    this._explain("");
    if (shown.content !== content) this._useBodies(mode === "columns" ? new Columns(source.sites)
      : new Bodies(content.about.bodies, content.arrays), content);
    if (shown.scale !== source.scale || shown.range !== source.range || shown.ground !== ground) this._paint(ground);
    return true;
  }

  _explain(text) {
    const note = $("solid-note");
    note.hidden = !text;
    note.textContent = text;
    this.half.classList.toggle("empty", Boolean(text));
    return false;
  }

  _useBodies(bodies, content) {
    const { mode, shown, source } = this, nSites = source.sites.n, isNew = shown.mode !== mode;
    if (this.view) {
      const { orbit } = this.view, before = orbit.fitDistance();
      this.view.use(bodies, nSites);
      orbit.corners = [bodies.low, bodies.high];
      orbit.nearest = this._nearest(bodies);
      // The view stays unless the size of the sensor differs.
      if (isNew || Math.abs(orbit.fitDistance() / before - 1) > 0.02) orbit.look(orbit.azimuth, orbit.elevation);
      else orbit.turn(0, 0);
    } else {
      this.view = new SolidView(this.canvas, bodies, new Orbit(bodies.low, bodies.high, this._nearest(bodies)), nSites, this.renderer);
      this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
      this.canvas.addEventListener("webglcontextrestored", () => { this.view.load(); this.ask(); });
      this._resize();
      this.view.orbit.look(...ASIDE);
    }
    this.shown = { content, mode };
    if (isNew) {
      const wide = Math.max(bodies.high[0] - bodies.low[0], bodies.high[1] - bodies.low[1]), tall = bodies.high[2] - bodies.low[2];
      const first = mode === "columns" ? 1 : 2 ** clamp(Math.round(Math.log2((STACK_HEIGHT * wide) / tall)), 0, 7);
      $("solid-height").value = String(Math.log2(this.factors[mode] || first));
      this._setHeight(this.factors[mode] || first);
      this.view.orbit.look(this.view.orbit.azimuth, this.view.orbit.elevation);
    }
    $("solid-cut").closest("label").hidden = mode !== "stack";
    this._cut();
  }

  _nearest(bodies) { return Math.max(4096 * bodies.lattice, 1e-3 * (bodies.high[0] - bodies.low[0])); }

  // Colours of the map for columns and for the silicon of the layers; heights of columns.
  _paint(ground) {
    const { view, source: { scale, range, sites }, mode, shown } = this, words = new Uint32Array(textureSize(sites.n + 1));
    Object.assign(shown, { scale, range, ground });
    view.setGround(bytesOfHex(ground));
    scale.paint(words.subarray(1), range, bytesOfHex(ground));
    const bytes = new Uint8Array(words.buffer), { column } = scale;
    if (mode === "stack") {
      const wells = view.parts.find((part) => part.name === LAYERS[0]);
      if (wells) view.setColours(wells, bytes);
      $("solid-text").textContent = this.stack.about.note;
      return;
    }
    const heights = new Float32Array(words.length), isKinds = column.kind === "kinds";
    for (let site = 0; site < sites.n; site++) {
      const fraction = isKinds ? KIND_HEIGHT : scale.fraction(column.values[site]);
      heights[site + 1] = fraction > 0 ? Math.min(fraction, 1) : 0;
    }
    view.setColours(view.parts[0], bytes);
    view.setHeights(heights);
    $("solid-text").textContent = isKinds ? "Colour: " + titleOf(column)
      : "Height and colour: " + titleOf(column) + (scale.isLog ? ", log" : "") + ", " + brief(scale.from) + " to " + brief(scale.to);
  }

  // -- view -------------------------------------------------------------------------------------------------------------

  _draw() {
    if (!this.isShown || !this._update()) return;
    const { view } = this;
    if (view.gl.isContextLost()) return;
    // Ids are drawn one frame after the view has stopped; during motion only the image is drawn.
    const isMoving = view.isImageStale && view.areIdsStale, needsIds = Boolean(this.pointer) || this.hovered >= 0;
    if (!isMoving && this.pointer) this._hover();
    if (!isMoving && needsIds) view.updateIds();
    view.hovered = this.hovered;
    if (view.pinned !== this.pinned) view.setPinned(this.pinned);
    view.draw();
    this._drawMarks();
    if (isMoving && needsIds) this.ask();
  }

  // Marks the cursor of another view.
  onMarks({ cursor, hovered, pinned }) {
    const state = [cursor && cursor.from !== this ? [cursor.x, cursor.y] : null, hovered, pinned].join();
    if (state === this.state) return;
    this.state = state;
    Object.assign(this, { cursor: cursor && cursor.from !== this ? cursor : null, hovered, pinned });
    this.ask();
  }

  _drawMarks() {
    const { context } = fitted(this.marks), { cursor, view: { orbit } } = this;
    if (!cursor) return;
    const heights = this.view.heights, [px, py] = orbit.project(cursor.x, cursor.y,
      heights && this.hovered >= 0 ? heights[this.hovered + 1] * this.view.bodies.high[2] : this.view.bodies.high[2], [0, 0]);
    drawCross(context, px, py);
  }

  _resize() {
    const { clientWidth, clientHeight } = this.half;
    if (clientWidth && this.view) {
      const size = [clientWidth, clientHeight, pixelRatio()].join();
      if (size === this.size) return;
      this.size = size;
      this.view.resize(clientWidth, clientHeight);
    }
    this.ask();
  }

  _moved() {
    this.anchor = null;
    this.view.change();
    this.ask();
  }

  _look(direction) {
    if (!this.view) return;
    this.view.orbit.look(...direction);
    this._moved();
  }

  _setHeight(factor) {
    $("solid-factor").textContent = "× " + Number(factor.toPrecision(2));
    if (!this.view) return;
    this.factors[this.shown.mode] = factor;
    this.view.setHeight(factor);
    this._moved();
  }

  // Removes the front of the layers; upper layers further.
  _cut() {
    const { view, shown: { mode } } = this;
    if (!view) return;
    const fraction = Number($("solid-cut").value) / 100, { low, high } = view.bodies, deep = high[1] - low[1];
    for (const part of view.parts) part.cutShift = Math.max(0, LAYERS.indexOf(part.name) - 1) * TERRACE * deep;
    view.setCut(mode === "stack" && fraction > 0 ? { axis: 1, sign: -1, position: low[1] + fraction * deep } : null);
    this.ask();
  }

  // The site under the pointer is that of the common cursor.
  _hover() {
    const { view, pointer } = this, found = view.pick(...pointer);
    const at = view.orbit.pointAt(pointer[0], pointer[1], found.depth, new Float64Array(3));
    if (!this.anchor) this.anchor = at;
    if (found.site < 0) this.studio.leave();
    else this.studio.hover(at[0], at[1], this, found.site);
    this.hovered = found.site;
  }

  _pin(px, py) {
    const { site } = this.view.pick(px, py);
    if (site >= 0) this.studio.pin(site);
  }

  _listen() {
    const { marks } = this, point = new Float64Array(3);
    const orbit = () => this.view.orbit;
    const depthOf = (position) => {
      let depth = 1;
      for (let i = 0; i < 3; i++) depth -= (orbit().toEye[i] * (position[i] - orbit().target[i])) / orbit().distance;
      return Math.max(depth, 0.05);
    };
    let held = 1;
    const ifView = (work) => (...args) => { if (this.view) work(...args); };
    listenToPointers(marks, {
      takesRightButton: true,
      press: ifView(() => { held = this.anchor ? depthOf(this.anchor) : 1; }),
      drag: ifView((dx, dy, { isSecond, isMiddle }) => {
        if (isMiddle) orbit().zoom(Math.exp(0.005 * dy));
        else if (isSecond) orbit().pan(dx, dy, held);
        else orbit().turn((-2 * Math.PI * dx) / orbit().tall, (2 * Math.PI * dy) / orbit().tall);
        this._moved();
      }),
      pinch: ifView((factor, px, py) => { orbit().zoom(1 / factor, orbit().pointAt(px, py, 1, point)); this._moved(); }),
      wheel: ifView((factor, px, py) => {
        orbit().zoom(1 / factor, this.anchor || orbit().pointAt(px, py, 1, point));
        this.view.change();
        this.ask();
      }),
      click: ifView((px, py) => this._pin(px, py)),
      move: ifView((px, py, isHeld) => { this.pointer = isHeld ? null : [px, py]; this.anchor = null; this.ask(); }),
      leave: () => { this.pointer = this.anchor = null; this.studio.leave(); },
    });
    marks.addEventListener("keydown", (event) => {
      if (!this.view || event.ctrlKey || event.metaKey || event.altKey) return;
      const way = ARROWS[event.key];
      if (way && event.shiftKey) orbit().pan(-60 * way[0], 60 * way[1]);
      else if (way) orbit().turn(0.12 * way[0], 0.1 * way[1]);
      else if (event.key === "+" || event.key === "=") orbit().zoom(1 / 1.3);
      else if (event.key === "-" || event.key === "_") orbit().zoom(1.3);
      else if (event.key === "0") orbit().look(...ASIDE);
      else if (event.key === "t" || event.key === "T") orbit().look(...ABOVE);
      else if (event.key === "Enter" || event.key === " ") this._pin(0.5 * orbit().width, 0.5 * orbit().tall);
      else return;
      this._moved();
      event.preventDefault();
      event.stopPropagation();
    });
  }
}
