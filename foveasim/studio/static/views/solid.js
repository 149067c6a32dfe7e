// Three dimensions: photosites as columns of their values, and the layers of the sensor. Only computed while it is shown.

import { Bodies } from "/web/bodies.js";
import { brief, bytesOfHex, clamp } from "/web/colours.js";
import { findRenderer, pixelRatio, textureSize, watchSize } from "/web/gl.js";
import { titleOf } from "/web/legend.js";
import { drawCross } from "/web/marks.js";
import { Orbit } from "/web/orbit.js";
import { ABOVE, ASIDE, OrbitGestures } from "/web/orbit_gestures.js";
import { $, find, inkOf } from "/web/page_parts.js";
import { SolidView } from "/web/solid_view.js";
import { Columns } from "../columns.js";
import { inNextFrame } from "../frames.js";
import { fitted } from "../site_pane.js";

const NO_WEBGL = "This browser has no WebGL2, which three dimensions need; enable graphics acceleration, or use another browser.";
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
    <label id="solid-cut-label" hidden>Cut <input type="range" id="solid-cut" min="0" max="100" step="1" value="30"></label>
    <span id="solid-text" class="quiet"></span>
  </div>`;

export const create = (root, studio) => new SolidPane(root, studio);

class SolidPane {
  root; studio; mode = "columns"; hovered = -1; pinned = -1; isAsked = false;
  /** @type {SolidView | null} */ view = null;
  /** @type {Renderer | null | undefined} */ renderer;
  /** @type {Cursor | null} */ cursor = null;
  // Data of the map and of the server.
  /** @type {{ sites: Sites, scale: Scale, range: Interval | null } | null} */ source = null;
  /** @type {Part | null} */ stack = null;
  // What the view shows, and heights by mode.
  /** @type {{ content?: Sites | Part, mode?: string, scale?: Scale, range?: Interval | null, ground?: string }} */ shown = {};
  /** @type {{ [mode: string]: number }} */ factors = {};

  constructor(root, studio) {
    Object.assign(this, { root, studio });
    this._build();
    /** @type {HTMLButtonElement[]} */
    this.buttons = [...root.querySelectorAll("[data-solid]")];
    this.half = $("solid");
    this.canvas = /** @type {HTMLCanvasElement} */ (find(this.half, ".cells"));
    this.marks = /** @type {HTMLCanvasElement} */ (find(this.half, ".marks"));
    this.gestures = new OrbitGestures(this.marks, () => this.view, {
      ask: () => this.ask(), leave: () => studio.leave(), pin: ({ site }) => { if (site >= 0) studio.pin(site); },
    });
    watchSize(this.half, () => this._resize());
    for (const button of this.buttons) button.addEventListener("click", () => this.setMode(button.dataset.solid));
    $("solid-height").addEventListener("input", () => this._setHeight(2 ** Number($("solid-height").value)));
    $("solid-cut").addEventListener("input", () => this._cut());
    $("solid-fit").addEventListener("click", () => this.gestures.look(ASIDE));
    $("solid-above").addEventListener("click", () => this.gestures.look(ABOVE));
  }

  // A pane next to the map instead of a tile.
  _build() {
    const { root } = this, heading = root.querySelector("h2");
    root.className = "pane";
    root.dataset.view = "solid";
    root.removeAttribute("tabindex");
    root.insertAdjacentHTML("beforeend", PAGE);
    root.querySelector(".bar").prepend(heading);
    $("solid-fit").append(...[...$("fit").children].map((icon) => icon.cloneNode(true)));
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

  // Returns the view if there is something to show; a text explains when there is not.
  _update() {
    const { source, mode, shown } = this, ground = inkOf("--map");
    if (!source) return null;
    if (this.renderer === undefined) this.renderer = findRenderer();
    if (!this.renderer) return this._explain(NO_WEBGL);
    const { renderer, stack } = this, isStack = mode === "stack", content = isStack ? stack : source.sites;
    if (!content) return this._explain("Computing the layers…");
    if (isStack && !stack?.about.bodies) return this._explain(stack?.about.note);
    if (isStack && stack?.about.n_sites !== source.sites.n) return shown.content ? this.view : null;
    this._explain("");
    const bodies = () => (isStack ? new Bodies(stack?.about.bodies, stack?.arrays) : new Columns(source.sites));
    const view = this.view && shown.content === content ? this.view : this._useBodies(bodies(), content, source.sites.n, renderer);
    if (shown.scale !== source.scale || shown.range !== source.range || shown.ground !== ground) this._paint(view, source, ground);
    return view;
  }

  _explain(text) {
    const note = $("solid-note");
    note.hidden = !text;
    note.textContent = text;
    this.half.classList.toggle("empty", Boolean(text));
    return null;
  }

  _useBodies(bodies, content, nSites, renderer) {
    const { mode, shown } = this, isNew = shown.mode !== mode, view = this.view || this._createView(bodies, nSites, renderer);
    const { orbit } = view;
    if (view.bodies !== bodies) {
      const before = orbit.fitDistance();
      view.use(bodies, nSites);
      orbit.corners = [bodies.low, bodies.high];
      orbit.nearest = this._nearest(bodies);
      // The view stays unless the size of the sensor differs.
      if (isNew || Math.abs(orbit.fitDistance() / before - 1) > 0.02) orbit.look(orbit.azimuth, orbit.elevation);
      else orbit.turn(0, 0);
    }
    this.shown = { content, mode };
    if (isNew) {
      const wide = Math.max(bodies.high[0] - bodies.low[0], bodies.high[1] - bodies.low[1]), tall = bodies.high[2] - bodies.low[2];
      const first = mode === "columns" ? 1 : 2 ** clamp(Math.round(Math.log2((STACK_HEIGHT * wide) / tall)), 0, 7);
      $("solid-height").value = String(Math.log2(this.factors[mode] || first));
      this._setHeight(this.factors[mode] || first);
      orbit.look(orbit.azimuth, orbit.elevation);
    }
    $("solid-cut-label").hidden = mode !== "stack";
    this._cut();
    return view;
  }

  _createView(bodies, nSites, renderer) {
    const view = new SolidView(this.canvas, bodies, new Orbit(bodies.low, bodies.high, this._nearest(bodies)), nSites, renderer);
    this.view = view;
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => { view.load(); this.ask(); });
    this._resize();
    view.orbit.look(...ASIDE);
    return view;
  }

  _nearest(bodies) { return Math.max(4096 * bodies.lattice, 1e-3 * (bodies.high[0] - bodies.low[0])); }

  // Colours of the map for columns and for the silicon of the layers; heights of columns.
  _paint(view, { scale, range, sites }, ground) {
    const { mode, stack } = this, words = new Uint32Array(textureSize(sites.n + 1));
    Object.assign(this.shown, { scale, range, ground });
    view.setGround(bytesOfHex(ground));
    scale.paint(words.subarray(1), range, bytesOfHex(ground));
    const bytes = new Uint8Array(words.buffer), { column } = scale;
    if (mode === "stack") {
      const wells = view.parts.find((part) => part.name === LAYERS[0]);
      if (wells) view.setColours(wells, bytes);
      $("solid-text").textContent = stack?.about.note;
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
    const view = this.isShown ? this._update() : null;
    if (!view || view.gl.isContextLost()) return;
    // Ids are drawn one frame after the view has stopped; during motion only the image is drawn.
    const isMoving = view.isImageStale && view.areIdsStale, needsIds = Boolean(this.gestures.pointer) || this.hovered >= 0;
    if (!isMoving) this._hover();
    if (!isMoving && needsIds) view.updateIds();
    view.hovered = this.hovered;
    if (view.pinned !== this.pinned) view.setPinned(this.pinned);
    view.draw();
    this._drawMarks(view);
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

  _drawMarks({ orbit, heights, bodies: { high } }) {
    const { context } = fitted(this.marks), { cursor } = this;
    if (!cursor) return;
    const [px, py] = orbit.project(cursor.x, cursor.y,
      heights && this.hovered >= 0 ? heights[this.hovered + 1] * high[2] : high[2], [0, 0]);
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

  _setHeight(factor) {
    $("solid-factor").textContent = "× " + Number(factor.toPrecision(2));
    const { view, shown: { mode } } = this;
    if (!view || !mode) return;
    this.factors[mode] = factor;
    view.setHeight(factor);
    this.gestures.moved();
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
    const found = this.gestures.under();
    if (!found) return;
    if (found.site < 0) this.studio.leave();
    else this.studio.hover(found.at[0], found.at[1], this, found.site);
    this.hovered = found.site;
  }
}
