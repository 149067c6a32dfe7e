// Tools of the editor of photosites. Each reacts to positions { x, y, kind } in µm, and describes the outlines that it makes.

import { ringsOf } from "./edits.js";
import { REACH, featuresNear, nearestOn, onGrid } from "./snapping.js";

// Within this distance in µm a position is a vertex, or on an edge.
const VERTEX_UM = 1e-3;
// A line that ends on an outline ends this far beyond, in µm, so that the site is cut.
const BEYOND_UM = 1e-3;
// A second click within this distance in CSS pixels is at the same position.
const SAME_PIXELS = 4;
// More outlines than this are not drawn while they are moved.
const MOST_MOVED = 2000;

const isSame = (a, b, distance) => Math.hypot(a.x - b.x, a.y - b.y) <= distance;

class Tool {
  isHeld = false;

  constructor(editor) { this.editor = editor; }

  // Whether positions snap; the position from which directions are measured; own vertices; what else to snap to; distance from the cursor.
  get snaps() { return true; }
  /** @returns {Placed | null} */
  get origin() { return null; }
  get snapping() { return {}; }
  /** @returns {Point | null} */
  get offset() { return null; }
  // Whether enter() has something to end or to apply.
  get isReady() { return false; }
  // Outlines to draw, in µm: { points, isClosed }.
  /** @returns {Outline[]} */
  get paths() { return []; }

  // press() returns whether the tool uses the pointer; otherwise the map moves, and click() follows if the pointer does not move.
  press() { return false; }
  drag() {}
  release() {}
  // Begins or ends a drag; returns whether the pointer is used.
  hold(isHeld = true) {
    this.isHeld = isHeld;
    return true;
  }

  // tap() ends a press without a drag.
  tap() { this.cancel(); }
  click() {}
  // enter() ends or applies; back() undoes a part and cancel() all: these return whether there was something to undo.
  enter() {}
  back() { return false; }
  remove() { return false; }

  cancel() {
    const wasHeld = this.isHeld;
    this.isHeld = false;
    this.editor.revert();
    return wasHeld;
  }

  // The server rejected the last edit.
  failed() {}
}

// Selects sites, and applies an action to them.
export class PickTool extends Tool {
  constructor(editor, action) {
    super(editor);
    this.action = action;
  }

  get snaps() { return false; }
  get isReady() { return Boolean(this.action) && this.editor.selected.length > (this.action === "merge" ? 1 : 0); }

  click({ x, y }, { isSecond = false } = {}) {
    const { editor } = this, site = editor.pick(x, y), isAdded = isSecond || this.action;
    if (site < 0) { if (!isAdded) editor.select([]); return; }
    if (!isAdded) editor.select([site]);
    else editor.select(editor.selected.includes(site) ? editor.selected.filter((one) => one !== site) : [...editor.selected, site]);
  }

  enter() { if (this.action) this.editor.act(this.action); }
}

// Vertices by clicks: polygons, and lines that cut.
class PathTool extends Tool {
  least; isClosed; path = []; last = [];

  constructor(editor, { least, isClosed }) {
    super(editor);
    Object.assign(this, { least, isClosed });
  }

  get origin() { return this.path.at(-1) || null; }
  get isReady() { return this.path.length >= this.least; }
  get snapping() { return { points: this.isClosed && this.isReady ? [[this.path[0].x, this.path[0].y]] : [] }; }

  get paths() {
    const { path } = this, { at } = this.editor, points = path.map(({ x, y }) => [x, y]);
    if (!points.length) return [];
    return [{ points: at ? [...points, [at.x, at.y]] : points, isClosed: this.isClosed && points.length > 1, marks: points }];
  }

  press(at) {
    const { path } = this, same = at.isExact ? 0 : SAME_PIXELS / this.editor.map.scale, last = path.at(-1);
    const isEnd = last && (isSame(last, at, same) || (this.isClosed && isSame(path[0], at, same)));
    if (isEnd && this.isReady) this.enter();
    else if (!last || !isSame(last, at, same)) {
      path.push({ ...at });
      this.preview();
    }
    return true;
  }

  preview() {}

  // The edit of a path; of subclasses.
  /** @returns {Settings | null} */
  edit(_path) { return null; }

  enter() {
    const { path, editor } = this;
    if (!this.isReady) return;
    this.last = path;
    const edit = this.edit(path), paths = [{ points: path.map(({ x, y }) => [x, y]), isClosed: this.isClosed }];
    this.path = [];
    editor.commit(edit, paths);
  }

  back() {
    if (!this.path.length) return false;
    this.path.pop();
    this.preview();
    return true;
  }

  cancel() {
    const { length } = this.path;
    this.path = [];
    this.editor.revert();
    return length > 0;
  }

  failed() { if (!this.path.length) this.path = this.last; }
}

export class PolygonTool extends PathTool {
  constructor(editor) { super(editor, { least: 3, isClosed: true }); }
  edit(path) { return this.editor.drawing(path); }

  preview() {
    if (this.isReady) this.editor.preview(this.edit(this.path));
    else this.editor.revert();
  }
}

export class CutTool extends PathTool {
  constructor(editor) { super(editor, { least: 2, isClosed: false }); }

  edit(path) {
    const { editor } = this, points = path.map((point) => ({ ...point }));
    const extend = (end, next) => {
      const length = Math.hypot(end.x - next.x, end.y - next.y);
      if (!["vertex", "midpoint", "edge"].includes(end.kind) || !length) return;
      end.x += (BEYOND_UM * (end.x - next.x)) / length;
      end.y += (BEYOND_UM * (end.y - next.y)) / length;
    };
    extend(points[0], points[1]);
    extend(points.at(-1), points.at(-2));
    return { kind: "cut_along", line_um: points.map(editor.toLayout), ...(editor.selected.length ? { points_um: editor.points } : {}) };
  }
}

// Two corners, by a drag or by two clicks.
export class RectangleTool extends Tool {
  /** @type {Placed} */ corner = { x: 0, y: 0 };

  get origin() { return this.isHeld ? this.corner : null; }

  _corners(at) {
    const { corner } = this;
    return [{ ...corner }, { ...corner, x: at.x }, { ...at }, { ...corner, y: at.y }];
  }

  get paths() {
    if (!this.isHeld || !this.editor.at) return [];
    return [{ points: this._corners(this.editor.at).map(({ x, y }) => [x, y]), isClosed: true, isBox: true }];
  }

  press(at) {
    if (this.isHeld) { this.release(at); return true; }
    this.corner = at;
    return this.hold();
  }

  _isEmpty(at) { return at.x === this.corner.x || at.y === this.corner.y; }
  drag(at) { if (!this._isEmpty(at)) this.editor.preview(this.editor.drawing(this._corners(at))); }

  release(at) {
    if (!this.isHeld || this._isEmpty(at)) return;
    const { paths } = this, corners = this._corners(at);
    this.hold(false);
    this.editor.commit(this.editor.drawing(corners), paths);
  }

  // The next press is the opposite corner.
  tap() {}
  back() { return this.cancel(); }
}

// Moves a site, or all selected ones with it.
export class MoveTool extends Tool {
  // The sites that move and their outlines; positions in them before; the position that snaps, and its distance from the pointer.
  /** @type {Set<number>} */ moved = new Set();
  /** @type {number[][][]} */ rings = [];
  /** @type {Point[]} */ from = [];
  /** @type {Placed} */ handle = { x: 0, y: 0 };
  /** @type {Point} */ distance = [0, 0];

  get origin() { return this.isHeld ? this.handle : null; }
  get offset() { return this.isHeld ? this.distance : null; }
  get snapping() { return { isExcluded: (site) => this.isHeld && this.moved.has(site) }; }

  by(at) { return [at.x - this.handle.x, at.y - this.handle.y]; }

  get paths() {
    const { editor } = this;
    if (!this.isHeld || !editor.at) return [];
    const [dx, dy] = this.by(editor.at);
    return this.rings.map((points) => ({ points: points.map(([x, y]) => [x + dx, y + dy]), isClosed: true }));
  }

  press(at) {
    const { editor } = this, { raw, sites } = editor, site = editor.pick(raw.x, raw.y);
    if (this.isHeld) { this.release(at); return true; }
    if (site < 0) return false;
    if (!editor.selected.includes(site)) editor.select([site]);
    this.moved = new Set(editor.selected);
    this.from = editor.points;
    // A vertex near the cursor is what snaps, else the position on the grid.
    const reach = (3 * REACH) / editor.map.scale;
    const { vertex } = featuresNear(raw.x, raw.y, reach, { sites, kinds: ["vertex"], isExcluded: (one) => !this.moved.has(one) });
    this.handle = vertex || { x: onGrid(raw.x, editor.step), y: onGrid(raw.y, editor.step) };
    this.distance = [this.handle.x - raw.x, this.handle.y - raw.y];
    this.rings = editor.selected.slice(0, MOST_MOVED).flatMap((one) => ringsOf(sites, one));
    editor.at = { ...this.handle };
    return this.hold();
  }

  _edit(at) { return { kind: "move_sites", points_um: this.from, by_um: this.editor.rounded(this.by(at)) }; }

  drag(at) {
    const by = this.by(at);
    this.editor.preview(this._edit(at), by);
  }

  release(at) {
    if (!this.isHeld) return;
    const { paths } = this, by = this.by(at), edit = this._edit(at);
    this.hold(false);
    if (by[0] || by[1]) this.editor.commit(edit, paths, by);
    else this.editor.revert();
  }
}

// Moves vertices that sites have in common, makes new ones on edges, and removes them.
export class VertexTool extends Tool {
  /** @type {Placed} */ from = { x: 0, y: 0 };
  /** @type {{ points: number[][], indices: Set<number> }[]} */ rings = [];

  get origin() { return this.isHeld ? this.from : null; }
  // A vertex that is moved neither snaps to itself nor to its edges.
  get snapping() { return this.isHeld ? { kinds: ["vertex"], isSkipped: (x, y) => isSame({ x, y }, this.from, VERTEX_UM) } : {}; }

  get isAtVertex() { return ["vertex", "midpoint", "edge"].includes(this.editor.at?.kind); }

  get paths() {
    const { editor } = this, { at } = editor;
    if (this.isHeld && at) return this.rings.map(({ points, indices }) =>
      ({ points: points.map((point, i) => (indices.has(i) ? [at.x, at.y] : point)), isClosed: true }));
    const site = editor.raw && editor.sites ? editor.pick(editor.raw.x, editor.raw.y) : -1;
    return site < 0 ? [] : ringsOf(editor.sites, site).map((points) => ({ points, isClosed: true, marks: points, isFaint: true }));
  }

  press(at, event) {
    const { editor } = this;
    if (this.isHeld) { this.release(at); return true; }
    if (!this.isAtVertex || editor.problem) return false;
    if (event?.altKey && at.kind === "vertex") { this.remove(); return true; }
    this.from = at;
    this.rings = this._ringsAt(at);
    return this.hold();
  }

  // Rings through a position, with the indices of their vertices there; on an edge, with a new vertex.
  _ringsAt({ x, y }) {
    const { sites } = this.editor, found = [];
    for (const site of sites.within(x - VERTEX_UM, y - VERTEX_UM, x + VERTEX_UM, y + VERTEX_UM, 1000) || []) {
      for (const ring of ringsOf(sites, site)) {
        const points = [], indices = new Set();
        ring.forEach((point, i) => {
          const [bx, by] = ring[(i + 1) % ring.length], [ax, ay] = point;
          if (isSame({ x: ax, y: ay }, { x, y }, VERTEX_UM)) indices.add(points.length);
          points.push(point);
          const on = nearestOn(x, y, ax, ay, bx, by), isEnd = isSame({ x: ax, y: ay }, { x, y }, VERTEX_UM)
            || isSame({ x: bx, y: by }, { x, y }, VERTEX_UM);
          if (!isEnd && isSame(on, { x, y }, VERTEX_UM)) { indices.add(points.length); points.push([x, y]); }
        });
        if (indices.size) found.push({ points, indices });
      }
    }
    return found;
  }

  _edit(at) { return { kind: "move_vertices", from_um: [this.editor.toLayout(this.from)], to_um: [this.editor.toLayout(at)] }; }
  drag(at) { this.editor.preview(this._edit(at)); }

  release(at) {
    if (!this.isHeld) return;
    const { paths } = this;
    this.hold(false);
    if (isSame(at, this.from, 0)) this.editor.revert();
    else this.editor.commit(this._edit(at), paths);
  }

  remove() {
    const { at } = this.editor;
    if (this.isHeld || at?.kind !== "vertex" || this.editor.problem) return false;
    this.editor.commit({ kind: "remove_vertices", points_um: [this.editor.toLayout(at)] });
    return true;
  }
}

// Places a layer of sites of a generator with its centre at a click, or in a rectangle.
export class LayerTool extends RectangleTool {
  get isReady() { return !this.isHeld; }

  press(at, event) {
    if (event) return super.press(at);
    this.editor.addLayer(at);  // at a position of the keys
    return true;
  }

  drag() {}
  tap(at) { this.hold(false); this.editor.addLayer(at); }
  enter() { this.editor.addLayer(); }

  release(at) {
    if (!this.isHeld || this._isEmpty(at)) return;
    this.hold(false);
    this.editor.addLayer(null, this._corners(at));
  }
}
