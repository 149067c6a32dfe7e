// A map of photosites: colours, outlines, marks, legend; two of them show two variants with the same view.

import { Scale, bytesOfHex } from "/web/colours.js";
import { listenToPointers } from "/web/gestures.js";
import { context2d, fitCanvas, pixelRatio } from "/web/gl.js";
import { drawRamp, kindsOf, swatchItem, tickLabels, titleOf } from "/web/legend.js";
import { SensorMap } from "/web/map.js";
import { drawCross, drawOutlines, drawSelected, drawTrace, ringSites } from "/web/marks.js";
import { Overview } from "/web/overview.js";
import { around, change, inkOf, make } from "/web/page_parts.js";
import { sitesIn } from "/web/measure.js";
import { sizeOf } from "./frames.js";
import { RasterMap } from "./raster_map.js";

export const groundColour = () => bytesOfHex(inkOf("--map"));

let isSlow = false;

// With software rendering, canvases in main memory are faster.
export function useSoftware(isSoftware) { isSlow = isSoftware; }

// A 2D context of a canvas, whose unit is the CSS pixel.
export function fitted(canvas) {
  const ratio = pixelRatio(), { width, height } = sizeOf(canvas);
  fitCanvas(canvas, width, height);
  const context = context2d(canvas, { willReadFrequently: isSlow });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

export class SitePane {
  /** @type {Sites | null} */ sites = null;
  /** @type {SensorMap | RasterMap | null} */ map = null;
  /** @type {Column[]} */ columns = [];
  /** @type {Column} */ column;
  /** @type {Numbers | null} */ filterOf = null;
  /** @type {Palette} */ palette;
  /** @type {Scale | null} */ scale = null;
  /** @type {Overview | null} */ overview = null;
  // Values that are shown next: their scale, and what the map has prepared.
  /**
   * @type {{ scale: Scale, column: Column, wantsLog: boolean | undefined, range: Interval | null, ground: number[],
   *   ready: NonNullable<ReturnType<RasterMap["prepareColours"]>> } | null}
   */
  next = null;
  // Whether the sites are edited; violations of a view: their version, their markers, and the chosen one.
  isEdited = false; violations = () => null; drawViolations = (_context, _map) => {}; trace = () => null;

  // Callbacks of listenToPointers, without conversions: moved(), hover(x, y), leave(), click(), select(rectangle).
  constructor(root, on, { renderer, label }) {
    this.root = root;
    this.renderer = renderer;
    const layer = (className) => make("canvas", undefined, { className, ariaHidden: "true" });
    this.cells = layer("cells");
    this.overviewCanvas = layer("overview");
    this.lines = layer("lines");
    this.marks = make("canvas", undefined, { className: "marks", tabIndex: 0, role: "application", ariaLabel: label });
    this.title = make("p", "", "legend-title");
    this.ramp = make("canvas");
    this.ticks = make("div", undefined, "ticks");
    this.kinds = make("ul");
    this.legend = around("div", "legend", this.title, this.ramp, this.ticks, this.kinds);
    root.append(this.cells, this.overviewCanvas, this.lines, this.marks, this.legend);
    /** @type {Point} */
    let held = [0, 0];
    listenToPointers(this.marks, {
      press: (px, py) => { if (this.map) held = [this.map.fromX(px), this.map.fromY(py)]; },
      drag: (dx, dy, { px, py, isSecond }) => {
        if (!this.map) return;
        if (on.isSelecting() !== isSecond) { on.select([held, [this.map.fromX(px), this.map.fromY(py)]]); return; }
        this.map.set(this.map.x - dx / this.map.scale, this.map.y + dy / this.map.scale, this.map.scale);
        on.moved(this);
      },
      pinch: (factor, px, py) => { this.map?.zoom(factor, px, py); on.moved(this); },
      wheel: (factor, px, py) => {
        if (!this.map) return;
        this.map.zoom(factor, px, py);
        on.hover(this.map.fromX(px), this.map.fromY(py), this);
        on.moved(this);
      },
      click: () => on.click(this),
      move: (px, py) => { if (this.map) on.hover(this.map.fromX(px), this.map.fromY(py), this); },
      leave: () => on.leave(),
    });
  }

  // Shows sites; the view stays, or shows all sites again if it did, unless they are edited.
  useSites(sites, palette) {
    const isNew = !this.map, isWhole = isNew || (this.isWhole && !this.isEdited);
    this.sites = sites;
    this.palette = palette;
    this.generation = (this.generation || 0) + 1;
    this.map?.use(sites);
    const map = this.map ||= this._createMap(sites);
    // The raster map averages small sites itself.
    clearTimeout(this.overview?.resting);
    this.overview = map instanceof SensorMap ? new Overview(this.overviewCanvas, sites) : null;
    if (isNew) this.resize();
    if (isWhole) this.fit();
    else map.set(map.x, map.y, map.scale);
    this.scale = null;
  }

  _createMap(sites) {
    // By the processor, a table of the sites of all pixels is faster than WebGL.
    if (this.renderer && !this.renderer.isSlow) {
      const map = new SensorMap(this.cells, sites, this.renderer);
      if (map.gl) {
        this.cells.addEventListener("webglcontextlost", (event) => event.preventDefault());
        this.cells.addEventListener("webglcontextrestored", () => { map.restore(); this.draw(); });
        return map;
      }
      const fresh = make("canvas", undefined, "cells");
      this.cells.replaceWith(fresh);
      this.cells = fresh;
    }
    return new RasterMap(this.cells, sites);
  }

  useColumns(columns, filterOf) {
    this.columns = columns;
    this.filterOf = filterOf;
  }

  get isWhole() {
    const { map } = this;
    return map !== null && Math.abs(map.scale / map.fitScale() - 1) < 1e-6 && map.x === map.middle[0] && map.y === map.middle[1];
  }

  fit() {
    const { map } = this;
    map?.set(map.middle[0], map.middle[1], map.fitScale());
  }

  // Sites of another pane with the same view are in view where all are; null for none.
  /** @param {SitePane | null} pane */
  compareWith(pane) {
    const { map, isWhole } = this;
    if (!map) return;
    map.compared = pane?.map ?? null;
    if (isWhole) this.fit();
  }

  // Takes the view of another pane, also beyond the limits of these sites.
  follow(other) {
    if (!this.map) return;
    Object.assign(this.map, { x: other.map.x, y: other.map.y, scale: other.map.scale });
  }

  columnOf(key) { return this.columns.find((column) => column.key === key) || this.columns[0]; }

  // Colours the sites by a column; with values of another pane, so that colours are comparable.
  colourBy(key, options) {
    if (!this.columns.length || !this.map) return;
    this.column = this.columnOf(key);
    const { next, column } = this, isReady = next?.column === column && next.wantsLog === options.wantsLog && !options.alsoValues;
    const filterOf = column.kind === "lit" ? this.filterOf : null;
    this.scale = isReady ? next.scale : new Scale(column, column.values, filterOf, this.palette, options);
  }

  paint(range) {
    const { map, scale } = this;
    if (!map || !scale) return;
    this.range = range;
    const { next } = this, ground = groundColour();
    this.next = null;
    const isReady = next !== null && next.scale === scale && next.range === range && next.ground.join() === ground.join();
    if (!isReady || !(map instanceof RasterMap) || !map.adopt(next.ready)) {
      scale.paint(map.colours, range, ground);
      map.sendColours();
    }
    this._drawLegend(scale);
  }

  // Works ahead for sites that are shown next.
  prepareSites(sites) {
    if (this.map instanceof RasterMap && this.isShown) this.map.prepare(sites, this.isWhole && !this.isEdited);
  }

  // Works ahead for values of sites that are shown next.
  prepareColours(sites, column, filterOf, { wantsLog, range }) {
    const { map } = this;
    if (!(map instanceof RasterMap) || !this.isShown) return;
    const scale = new Scale(column, column.values, column.kind === "lit" ? filterOf : null, this.palette, { wantsLog });
    const ground = groundColour(), ready = map.prepareColours(sites, ground, (colours) => scale.paint(colours, range, ground));
    this.next = ready && { scale, column, wantsLog, range, ground, ready };
  }

  _drawLegend(scale) {
    const { column } = scale, isKinds = column.kind === "kinds";
    change(this.title, { textContent: titleOf(column) + (scale.isLog ? ", log" : "") });
    for (const element of [this.ramp, this.ticks]) change(element, { hidden: isKinds });
    change(this.kinds, { hidden: !isKinds });
    if (isKinds) {
      const { items, rest } = kindsOf(scale);
      this.kinds.replaceChildren(...items.slice(0, 8).map(swatchItem), ...(rest || items.length > 8 ? [make("li", "…")] : []));
      return;
    }
    const { context, width, height } = fitted(this.ramp);
    drawRamp(context, scale, width, height);
    this.ticks.replaceChildren(...tickLabels(scale));
  }

  resize() {
    if (!this.map) return;
    const { clientWidth: width, clientHeight: height } = this.root, isWhole = this.isWhole;
    if (width === this.map.width && height === this.map.height && this.cells.width > 1) return;
    this.map.resize(width, height);
    if (isWhole) this.fit();
  }

  get isShown() { return Boolean(this.map && this.scale) && sizeOf(this.root).width > 0; }

  draw() {
    const { map } = this;
    if (!map || !this.isShown) return;
    map.draw(groundColour());
    this.overview?.update(map, this.scale, this.range);
    // Layers are drawn again only when they change: each costs time to compose the page.
    if (!this._isNew("lines", [this._viewState(map), this.violations()])) return;
    const { context, width, height } = fitted(this.lines);
    drawOutlines(context, map, width, height);
    this.drawViolations(context, map);
  }

  _viewState({ x, y, scale, width, height }) {
    return [x, y, scale, width, height, pixelRatio(), this.generation].join();
  }

  _isNew(layer, state) {
    const text = JSON.stringify(state);
    this.shown = this.shown || {};
    if (this.shown[layer] === text) return false;
    this.shown[layer] = text;
    return true;
  }

  // Draws marks: { cursor, hovered, pinned, kept, rectangle, selected, trace }.
  drawMarks({ cursor, hovered, pinned, kept = /** @type {number[]} */ ([]), rectangle, selected, trace }) {
    const { map } = this;
    if (!map || !this.isShown) return;
    const isAt = cursor && cursor.from !== this, state = [hovered, pinned, kept, rectangle, selected.length, selected[0],
      trace && [...trace.box], isAt && [cursor.x, cursor.y]];
    const isEmpty = hovered < 0 && pinned < 0 && !kept.length && !rectangle && !selected.length && !trace && !isAt;
    if (!this._isNew("marks", isEmpty ? [map.width, map.height] : [this._viewState(map), state])) return;
    const { context } = fitted(this.marks);
    if (trace) drawTrace(context, map, trace);
    drawSelected(context, map, rectangle, selected);
    for (const site of kept) ringSites(context, map, site, -1);
    ringSites(context, map, pinned, hovered);
    if (isAt) drawCross(context, map.toX(cursor.x), map.toY(cursor.y));
  }

  pick(x, y) { return this.sites?.pick(x, y) ?? -1; }

  sitesIn(rectangle) { return this.sites ? sitesIn(this.sites, rectangle) : []; }
}
