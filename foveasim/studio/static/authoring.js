// Editor of photosites on their map: tools, snapping, previews by the server, and the list of edits in the settings.

import { clamp, roundStep, shown } from "/web/colours.js";
import { outline, positionText } from "/web/marks.js";
import { inkOf, make, notice, speak } from "/web/page_parts.js";
import { ARROWS } from "/web/shell.js";
import { KEY, boxOf, pathsOf, pointIn } from "./edits.js";
import { fitted } from "./site_pane.js";
import { nextVertex, onGrid, snap } from "./snapping.js";
import { TOOLS, ToolBar } from "./tool_bar.js";
import { CutTool, LayerTool, MoveTool, PickTool, PolygonTool, RectangleTool, VertexTool } from "./tools.js";

// Smallest distance of the points of the grid in CSS pixels, if the user chooses none.
const GRID_PIXELS = 7;
// A pointer that moves less than this between down and up is a click.
const CLICK_PIXELS = 4;
// Number of selections that undo and redo restore.
const MOST_REMEMBERED = 300;
// More selected sites than this are not followed through edits.
const MOST_FOLLOWED = 50000;
const INK = "#d6006c", HALO = "#ffffff", WRONG = "#d3261b";
// Fraction of the smallest site that the first design rules require of widths.
const WIDTH_FRACTION = 0.5;

export class Editor {
  pane; button; studio; isOn = false; error = ""; rejected = ""; known = ""; nudged = ""; name = "select";
  isByKeys = false; isPlaced = true; isSpace = false; isDragged = false;
  modifiers = { isStraight: false, isFree: false };
  // The position of the pointer, snapped and not.
  /** @type {Snapped | null} */ at = null;
  /** @type {Placed | null} */ raw = null;
  // Outlines that stay until the sites arrive.
  /** @type {Outline[] | null} */ ghost = null;
  // Edits on their way to the server with the number of their message; those before a preview, and the sites before it.
  /** @type {{ edits: Settings[], before: string, id: number | null } | null} */ pending = null;
  /** @type {{ edits: Settings[], isAbsent: boolean } | null} */ kept = null;
  /** @type {Sites | null} */ base = null;
  /** @type {number[]} */ shift = [0, 0];
  /** @type {{ index: number, text: string } | null} */ highlighted = null;
  // Selections by the edits, and positions in the selected sites.
  /** @type {Map<string, Point[]>} */ trail = new Map();
  /** @type {Point[] | null} */ _points = [];
  /** @type {() => Point[]} */ followed = () => [];

  // studio: the page through functions; see studio.js.
  constructor(pane, section, button, studio) {
    Object.assign(this, { pane, button, studio });
    this.canvas = make("canvas", undefined, { className: "ghost", ariaHidden: "true" });
    pane.root.append(this.canvas);
    this.bar = new ToolBar(section, {
      use: (name) => this.use(name), act: (name) => this.act(name), apply: () => this.tool.enter(),
      typed: (text) => this.placeTyped(text), grid: () => this.draw(),
      rules: () => this.useRules(),
    });
    this.tools = {
      select: new PickTool(this, null), polygon: new PolygonTool(this), rectangle: new RectangleTool(this), move: new MoveTool(this),
      vertex: new VertexTool(this), cut: new CutTool(this),
      merge: new PickTool(this, "merge"), split: new PickTool(this, "split"), channel: new PickTool(this, "channel"),
      layer: new LayerTool(this),
    };
    this.use("select");
    button.addEventListener("click", () => this.toggle());
    this._listen();
  }

  // -- state --------------------------------------------------------------------------------------------------------------

  get map() { return this.pane.map; }
  // Sites before the preview.
  get sites() { return this.base || this.pane.sites; }
  get selected() { return this.studio.selected(); }
  get layout() { return this.studio.settings()?.layout || {}; }
  get move() { const { move_um: move } = this.layout; return Array.isArray(move) ? move : [0, 0]; }
  // Edits before the preview, those on their way to the server, or those of the settings.
  get edits() { return this.kept?.edits || this.pending?.edits || this.layout.edits || []; }

  // Step of the grid in µm: that of the user, of the settings, or a round one that is visible.
  get step() {
    const chosen = this.bar.number("grid"), { snap_um: snapped, rules } = this.layout;
    if (chosen && chosen > 0) return chosen;
    return snapped || rules?.grid_um || roundStep(GRID_PIXELS / (this.map?.scale || 1));
  }

  toggle(isOn = !this.isOn) {
    if (isOn === this.isOn) return;
    if (!isOn) this.cancel();
    this.isOn = this.pane.isEdited = isOn;
    this.button.setAttribute("aria-pressed", String(isOn));
    this.pane.root.classList.toggle("edited", isOn);
    this.bar.show(isOn);
    this.studio.opened(isOn);
    this.draw();
  }

  use(name) {
    if (this.tool) this.cancel();
    this.name = name;
    this.tool = this.tools[name];
    this.bar.use(name);
    this.pane.root.dataset.tool = name;
    this._resnap();
    this.studio.redraw();
  }

  // Reason for which the tool is not available.
  get problem() {
    const { inset_um: inset } = this.layout;
    return this.name === "vertex" && inset > 0 ? "Vertices are those before the inset of " + shown(inset)
      + " µm: set inset in Layout to 0 to move them." : "";
  }

  // The settings changed.
  update({ id, errors, settings }) {
    const error = errors?.[KEY] || "", { pending } = this;
    this.error = error;
    if (error) this.rejected = "";
    if (pending && (pending.id === null || id >= pending.id)) {
      this.pending = null;
      if (error) {
        this.ghost = null;
        this.rejected = error;
        // The server made the last valid preview a step.
        if (JSON.stringify(settings.layout?.edits || []) !== pending.before) this.studio.undo();
        this.tool.failed();
        notice(error);
      }
    }
    const text = JSON.stringify(this.edits);
    if (text !== this.known && this.trail.has(text)) this._points = this.trail.get(text) || [];
    this.known = text;
    const choices = this.studio.generators();
    this.bar.fill("generator", choices.map(({ label }) => [label, label]));
    this.studio.redraw();
  }

  // New sites arrived: the same places are selected.
  useSites(sites) {
    if (!this.pending) this.ghost = null;
    const [mx, my] = this.move, [sx, sy] = this.shift, found = new Set();
    for (const [x, y] of this.points) {
      const site = sites.pick(x + mx + sx, y + my + sy);
      if (site >= 0) found.add(site);
    }
    return [...found];
  }

  // All parts of the last change are drawn.
  finish() {
    if (!this.pending) this.ghost = null;
    this.draw();
  }

  useColumns() {
    const names = this.pane.columns.find((column) => column.key === "channel")?.names || [];
    this.bar.fill("channel", [["", "nearest filter"], ...names.map((name, k) => [String(k), "filter " + name])]);
  }

  // -- selection ------------------------------------------------------------------------------------------------------------

  pick(x, y) { return this.sites?.pick(x, y) ?? -1; }

  select(sites) { this.studio.select(sites); }

  // Positions in the selected sites, by which these are found again in other layouts.
  get points() { return (this._points ??= this.followed()); }
  set points(points) { this._points = points; }

  follow(selected) {
    const [mx, my] = this.move, { sites } = this;
    this.shift = [0, 0];
    this.followed = () => selected.map((site) => { const [x, y] = pointIn(sites, site); return this.rounded([x - mx, y - my], 6); });
    this._points = selected.length && selected.length <= MOST_FOLLOWED ? null : [];
  }

  // -- edits ----------------------------------------------------------------------------------------------------------------

  rounded(values, digits = 9) { return values.map((value) => Number(value.toFixed(digits))); }

  // Positions of the settings are those before the layout is moved; vertices of sites stay exact.
  toLayout = ({ x, y, kind }) => {
    const [mx, my] = this.move, found = [x - mx, y - my];
    return ["vertex", "midpoint", "edge"].includes(kind) ? found : this.rounded(found);
  };

  // The edit that draws an outline through positions.
  drawing(path) {
    const channel = this.bar.number("channel");
    return { kind: "draw", outlines_um: [path.map(this.toLayout)], overlap: this.bar.value("overlap"),
      ...(channel === null ? {} : { channel }) };
  }

  // Shows an edit that is not a step; by is the distance in µm by which selected sites move.
  preview(edit, by = [0, 0]) {
    this.kept = this.kept || { edits: this.edits, isAbsent: !this.pending && !this.layout.edits };
    this.base = this.base || this.pane.sites;
    this.shift = by;
    this.studio.send(KEY, [...this.edits, this._tolerant(edit)], false);
  }

  // Shows the layout before the preview again.
  revert() {
    const { kept } = this;
    this._settle();
    if (!kept) return;
    const id = kept.isAbsent ? this.studio.remove(KEY) : this.studio.send(KEY, kept.edits, true);
    this.pending = { edits: kept.edits, before: JSON.stringify(kept.edits), id };
  }

  _settle() {
    this.kept = this.base = null;
    this.shift = [0, 0];
    this.error = this.rejected = "";
  }

  // Makes an edit a step; its outlines stay until the sites arrive. by is the distance by which selected sites move.
  commit(edit, paths = null, by = [0, 0]) {
    this.commitAll([...this.edits, this._tolerant(edit)], by);
    this.ghost = paths;
  }

  /** @param {any[]} edits @param {number[]} by */
  commitAll(edits, by = [0, 0]) {
    const [dx, dy] = by;
    const before = JSON.stringify(this.edits);
    this._remember(before);
    this._settle();
    this.pending = { edits, before, id: this.studio.send(KEY, edits, true) };
    if (dx || dy) this.points = this.points.map(([x, y]) => this.rounded([x + dx, y + dy], 6));
    this._remember(JSON.stringify(edits));
    this.draw();
  }

  // Selections by the edits, for undo and redo.
  _remember(text) {
    this.known = text;
    this.trail.delete(text);
    this.trail.set(text, this.points);
    const [oldest] = this.trail.keys();
    if (this.trail.size > MOST_REMEMBERED) this.trail.delete(oldest);
  }

  // Vertices on a manufacturing grid differ from those before.
  _tolerant(edit) {
    const { snap_um: snapped } = this.layout;
    return snapped && /_vertices$/.test(edit.kind) ? { ...edit, tolerance_um: 0.75 * snapped } : edit;
  }

  // Applies an action to the selected sites.
  act(name) {
    const { points, selected } = this;
    if (name === "repair") { this.studio.repair(); return; }
    if (!selected.length || !points.length) { notice("Select photosites first"); return; }
    if (name === "merge" && selected.length < 2) { notice("Select two or more photosites that touch"); return; }
    if (name === "channel" && this.bar.number("channel") === null) { notice("Choose a filter first"); return; }
    const edit = {
      merge: () => ({ kind: "merge_at", points_um: points }),
      split: () => ({ kind: "split_at", points_um: points, n_x: this.bar.number("n_x") ?? 2, n_y: this.bar.number("n_y") ?? 1 }),
      channel: () => ({ kind: "set_channel", points_um: points, channel: this.bar.number("channel") }),
      remove: () => ({ kind: "remove_at", points_um: points }),
    }[name]();
    this.commit(edit);
    if (name === "remove") this.select([]);
  }

  // Moves the selection by a step of the grid; consecutive steps are one edit.
  nudge([ux, uy], factor) {
    const { step, edits } = this, by = [ux * step * factor, uy * step * factor], last = edits.at(-1);
    const isNext = this.nudged && last && JSON.stringify(last) === this.nudged;
    const edit = isNext ? { ...last, by_um: this.rounded([last.by_um[0] + by[0], last.by_um[1] + by[1]]) }
      : { kind: "move_sites", points_um: this.points, by_um: this.rounded(by) };
    this.commitAll([...(isNext ? edits.slice(0, -1) : edits), edit], by);
    this.nudged = JSON.stringify(edit);
  }

  // Adds a layer of the chosen generator at a position, by default in the centre of the view, or in a rectangle.
  addLayer(at, corners) {
    const found = this.studio.generators().find(({ label }) => label === this.bar.value("generator"));
    if (!found || !this.map) return;
    const { generator, parameters, mosaic } = found.value, middle = corners
      ? { x: 0.5 * (corners[0].x + corners[2].x), y: 0.5 * (corners[0].y + corners[2].y) } : this.map;
    const centre = at || { x: onGrid(middle.x, this.step), y: onGrid(middle.y, this.step) };
    const layer = { generator, parameters, ...(mosaic ? { mosaic } : {}), move_um: this.toLayout(centre) };
    const margin = this.bar.number("margin_um");
    const region = corners ? { region: corners.map(this.toLayout) } : {};
    this.commit({ kind: "overlay", layer, operation: this.bar.value("operation"), ...(margin ? { margin_um: margin } : {}), ...region });
    this.studio.showSteps(this.edits.length - 1);
  }

  // Adds design rules that the current layout satisfies in size, or shows the violations.
  useRules() {
    const { rules } = this.layout, smallest = this.studio.summary()?.min_size_um;
    if (rules) { this.studio.showRules(); return; }
    const floor = (value) => {
      const unit = 10 ** (Math.floor(Math.log10(value)) - 1);
      return Number((Math.floor(value / unit + 1e-9) * unit).toPrecision(2));
    };
    this.studio.send("layout.rules", { min_size_um: floor(smallest), min_width_um: floor(WIDTH_FRACTION * smallest),
      angle_limit_deg: 25, max_overlap_um2: 0 }, true);
    this.studio.showRules();
  }

  // -- pointer ----------------------------------------------------------------------------------------------------------------

  // Listens before the map does, which pans where the tool does not use the pointer.
  _listen() {
    const { root } = this.pane, isOurs = (event) => this.isOn && this.map && event.target === this.pane.marks;
    /** @type {Point | null} */
    let start = null;
    let isUsed = false;
    const consume = (event) => event.stopPropagation();
    root.addEventListener("pointerdown", (event) => {
      if (!isOurs(event) || event.button !== 0 || this.isSpace) return;
      start = [event.clientX, event.clientY];
      this._track(event);
      isUsed = Boolean(this.tool.press(this.at, event));
      if (isUsed) {
        event.target.setPointerCapture(event.pointerId);
        consume(event);
      }
      this.studio.redraw();
    }, true);
    root.addEventListener("pointermove", (event) => {
      if (!isOurs(event)) return;
      const { x, y } = this._track(event);
      if (start && isUsed) {
        if (Math.hypot(event.clientX - start[0], event.clientY - start[1]) >= CLICK_PIXELS || this.isDragged) {
          this.isDragged = true;
          if (this.tool.isHeld) this.tool.drag(this.at);
        }
        this.studio.hover(x, y);
        consume(event);
      } else if (this.tool.isHeld) this.tool.drag(this.at);
      this.studio.redraw();
    }, true);
    const end = (event) => {
      if (!start || !isOurs(event)) return;
      const isClick = Math.hypot(event.clientX - start[0], event.clientY - start[1]) < CLICK_PIXELS;
      this._track(event);
      if (isUsed) {
        consume(event);
        if (event.type === "pointercancel") this.tool.cancel();
        else if (this.tool.isHeld && this.isDragged) this.tool.release(this.at);
        else if (this.tool.isHeld) this.tool.tap(this.at);
      } else if (isClick && event.type === "pointerup") this.tool.click(this.raw,
        { isSecond: event.shiftKey || event.ctrlKey || event.metaKey });
      start = null;
      this.isDragged = isUsed = false;
      this.studio.redraw();
    };
    root.addEventListener("pointerup", end, true);
    root.addEventListener("pointercancel", end, true);
    this.pane.marks.addEventListener("pointerleave", () => {
      if (!start && !this.isByKeys && !this.tool.isHeld) { this.at = this.raw = null; this.draw(); }
    });
    addEventListener("keyup", ({ key }) => { if (key === " ") this.isSpace = false; });
    addEventListener("blur", () => { this.isSpace = false; });
  }

  _track(event) {
    const box = this.pane.marks.getBoundingClientRect(), { map } = this;
    const raw = { x: map.fromX(event.clientX - box.left), y: map.fromY(event.clientY - box.top) };
    this.raw = raw;
    this.modifiers = { isStraight: event.shiftKey, isFree: event.ctrlKey || event.metaKey };
    this.isByKeys = false;
    this._resnap();
    return raw;
  }

  // Snaps the position of the pointer.
  _resnap() {
    const { raw, tool, map } = this;
    if (!raw || !map || this.isByKeys) return;
    if (!tool.snaps) { this.at = raw; return; }
    const { offset } = tool, x = raw.x + (offset ? offset[0] : 0), y = raw.y + (offset ? offset[1] : 0);
    const at = snap(x, y, { sites: this.sites, scale: map.scale, step: this.step, from: tool.origin, ...this.modifiers, ...tool.snapping });
    if (at.kind === "free") {
      const digits = clamp(Math.ceil(Math.log10(map.scale)) + 2, 0, 9);
      [at.x, at.y] = this.rounded([at.x, at.y], digits);
    }
    this.at = at;
  }

  // -- keys -------------------------------------------------------------------------------------------------------------------

  // Returns whether a key of the page was for the editor.
  key(event) {
    const { key } = event, isPlain = !event.ctrlKey && !event.metaKey && !event.altKey, letter = key.toLowerCase();
    if (isPlain && letter === "e") { this.toggle(); return true; }
    if (!this.isOn || !this.map) return false;
    if (!isPlain) return (event.ctrlKey || event.metaKey) && letter === "z" && !event.shiftKey && this._undone(this.tool.back());
    const onMap = event.target === this.pane.marks || event.target === document.body;
    if (key === "Escape") return this._escape();
    if (key === "Delete" || key === "Backspace") return this._undone((key === "Backspace" && this.tool.back()) || this.tool.remove())
      || this._removeSelected();
    if (onMap && key === " ") { this.isSpace = true; return true; }
    if (onMap && key === "Enter") { this._enter(event.shiftKey); return true; }
    if (onMap && ARROWS[key]) return this._arrow(ARROWS[key], event.shiftKey ? 10 : 1);
    const tool = TOOLS.find(([, one]) => one === letter);
    if (tool) this.use(tool[0]);
    return Boolean(tool);
  }

  _undone(isDone) { if (isDone) this.studio.redraw(); return isDone; }

  _removeSelected() {
    if (this.selected.length) this.act("remove");
    return true;
  }

  _escape() {
    if (this.tool.cancel()) { this.studio.redraw(); return true; }
    if (this.highlighted) { this.highlight(null); return true; }
    if (this.selected.length) { this.select([]); return true; }
    if (this.name === "select") return false;
    this.use("select");
    return true;
  }

  cancel() { this.tool.cancel(); }

  _enter(isSecond) {
    if (this.tool.isReady && (!this.isByKeys || this.isPlaced)) this.tool.enter();
    else this._placeKeys(isSecond);
  }

  // Uses the position of the keys as a click, and for a drag first as its start, then as its end.
  _placeKeys(isSecond) {
    this._startKeys();
    this.isPlaced = true;
    if (this.name === "select") this.at = { x: this.map.x, y: this.map.y };
    if (this.tool.isHeld) this.tool.release(this.at);
    else if (!this.tool.press(this.at)) this.tool.click(this.at, { isSecond });
    this.studio.redraw();
  }

  _startKeys() {
    const { map, step } = this, at = { ...this.at || { x: onGrid(map.x, step), y: onGrid(map.y, step), kind: "grid" } };
    if (this.isByKeys && this.at) return this.at;
    this.at = at;
    this.raw = { x: at.x, y: at.y };
    this.isByKeys = true;
    return at;
  }

  _arrow(direction, factor) {
    const { map, tool, step, name } = this;
    if (name === "select") return false;
    if (name === "move" && !tool.isHeld && this.selected.length) { this.nudge(direction, factor); return true; }
    const at = this._startKeys();
    this.isPlaced = false;
    const next = name === "vertex" && !tool.isHeld && this.sites
      ? nextVertex(at, direction, this.sites, 0.5 * (map.width / map.scale)) : null;
    this._moveTo(next || { x: onGrid(at.x + direction[0] * step * factor, step),
      y: onGrid(at.y + direction[1] * step * factor, step), kind: "grid", isExact: true });
    return true;
  }

  // Moves the position of the keys, and the view with it.
  _moveTo(at) {
    const { map, tool } = this;
    this.at = at;
    this.raw = { x: at.x, y: at.y };
    const margin = 30 / map.scale, wide = 0.5 * (map.width / map.scale) - margin, tall = 0.5 * (map.height / map.scale) - margin;
    map.set(clamp(map.x, at.x - wide, at.x + wide), clamp(map.y, at.y - tall, at.y + tall), map.scale);
    if (tool.isHeld) tool.drag(at);
    this.studio.hover(at.x, at.y);
    speak(() => this._positionOf(at));
    this.studio.redraw("map");
  }

  // Places a position that was typed, "x, y", or "@dx, dy" from the last one.
  placeTyped(text) {
    const found = text.trim().match(/^(@?)\s*(\S+?)[\s,;]+(\S+)$/), [x, y] = found ? [Number(found[2]), Number(found[3])] : [];
    if (!Number.isFinite(x) || !Number.isFinite(y) || !this.map) return false;
    const from = found[1] ? this.tool.origin || this.at || { x: 0, y: 0 } : { x: 0, y: 0 };
    this.isByKeys = true;
    this._moveTo({ x: from.x + x, y: from.y + y, kind: "typed", isExact: true });
    this._placeKeys(false);
    return true;
  }

  _positionOf({ x, y }) { const { scale } = this.map; return positionText(x, scale) + ", " + positionText(y, scale); }

  // -- drawing ----------------------------------------------------------------------------------------------------------------

  // Shows the outlines of an edit by its index, or null for none.
  highlight(index) {
    this.highlighted = index === null ? null : { index, text: JSON.stringify(this.edits[index]) };
    this.studio.redraw();
  }

  // Outlines of an edit on the map; edits at sites have those of the sites that are there.
  outlinesOf(edit) {
    const [mx, my] = this.move, { sites } = this, layer = edit.region ? null : edit.layer?.move_um;
    const paths = layer ? [{ points: [layer], isClosed: false }] : pathsOf(edit);
    return paths.map((path) => ({ ...path, points: path.points.map(([x, y]) => [x + mx, y + my]) })).flatMap((path) => {
      if (path.points.length > 1 || !sites) return [path];
      const site = sites.pick(...path.points[0]);
      return site >= 0 && !layer ? [{ site, points: path.points }] : [path];
    });
  }

  // Box of an edit on the map, or null.
  boxOf(edit) {
    const { sites } = this;
    const points = this.outlinesOf(edit).flatMap(({ points, site }) =>
      (site === undefined ? points : [[sites.box[4 * site], sites.box[4 * site + 1]], [sites.box[4 * site + 2], sites.box[4 * site + 3]]]));
    return boxOf(points);
  }

  // Names of rules that are violated where the tool draws.
  violationsIn(box) {
    const violations = this.studio.violations();
    if (!violations || !box) return [];
    const names = [];
    for (let i = 0; i < violations.n; i++) {
      const [a, b, c, d] = violations.boxes.subarray(4 * i, 4 * i + 4);
      if (a <= box[2] && c >= box[0] && b <= box[3] && d >= box[1]) names.push(violations.rules[violations.rule[i]].name);
    }
    return names;
  }

  draw() {
    const { pane, canvas } = this;
    if (!this.isOn || !pane.isShown) { if (canvas.width > 1 && !this.isOn) fitted(canvas); return; }
    const { context } = fitted(canvas), paths = this.problem ? [] : [...(this.ghost || []), ...this.tool.paths];
    if (this.highlighted && this.edits[this.highlighted.index]) this._drawHighlight(context, this.edits[this.highlighted.index]);
    for (const path of paths) this._drawPath(context, path);
    if (this.at && this.tool.snaps) this._drawMarker(context, this.at);
    else if (this.isByKeys && this.at) this._drawMarker(context, { ...this.at, kind: "grid" });
    const active = this.tool.paths.filter((path) => !path.isFaint);
    const box = active.length ? boxOf(active.flatMap((path) => path.points)) : null;
    if (this.at && this.tool.snaps) this._drawTag(context, this.at, this.kept ? this.violationsIn(box) : [], active);
    this._describe();
  }

  _trace(context, { points, isClosed }) {
    const { map } = this;
    points.forEach(([x, y], i) => (i ? context.lineTo(map.toX(x), map.toY(y)) : context.moveTo(map.toX(x), map.toY(y))));
    if (isClosed) context.closePath();
  }

  _drawPath(context, path) {
    const { map } = this, ink = this.error && !path.isFaint ? WRONG : INK;
    if (path.isClosed && !path.isFaint) {
      context.beginPath();
      this._trace(context, path);
      context.fillStyle = "rgb(214 0 108 / 13%)";
      context.fill("evenodd");
    }
    outline(context, () => this._trace(context, path), path.isFaint ? [2.5, 1] : [4, 1.75], [HALO, ink]);
    for (const [x, y] of path.marks || []) {
      context.fillStyle = HALO;
      context.strokeStyle = ink;
      context.lineWidth = 1.5;
      context.fillRect(map.toX(x) - 3, map.toY(y) - 3, 6, 6);
      context.strokeRect(map.toX(x) - 3, map.toY(y) - 3, 6, 6);
    }
  }

  _drawHighlight(context, edit) {
    const { map } = this;
    for (const path of this.outlinesOf(edit)) {
      const trace = () => {
        if (path.site !== undefined) this.sites.trace(context, path.site, map);
        else if (path.points.length > 1) this._trace(context, path);
        else context.arc(map.toX(path.points[0][0]), map.toY(path.points[0][1]), 12, 0, 7);
      };
      context.setLineDash([6, 4]);
      outline(context, trace, [4, 2], [HALO, INK]);
      context.setLineDash([]);
    }
  }

  // Square: vertex; triangle: midpoint; circle: edge; cross: grid.
  /** @param {CanvasRenderingContext2D} context @param {Snapped} at */
  _drawMarker(context, { x, y, kind }) {
    const { map } = this, px = map.toX(x), py = map.toY(y);
    outline(context, () => {
      if (kind === "vertex") context.rect(px - 5, py - 5, 10, 10);
      else if (kind === "midpoint") {
        context.moveTo(px, py - 6);
        context.lineTo(px + 6, py + 5);
        context.lineTo(px - 6, py + 5);
        context.closePath();
      }
      else if (kind === "edge") { context.moveTo(px + 5, py); context.arc(px, py, 5, 0, 7); }
      else { context.moveTo(px - 6, py); context.lineTo(px + 6, py); context.moveTo(px, py - 6); context.lineTo(px, py + 6); }
    }, [4.5, 2], [HALO, this.error ? WRONG : INK]);
  }

  // Coordinates, distances and violations next to the cursor.
  _drawTag(context, at, violations, active) {
    const { map, tool } = this, { origin } = tool, figure = (value) => positionText(value, map.scale);
    const lines = [this._positionOf(at) + " µm"];
    if (origin) {
      const dx = at.x - origin.x, dy = at.y - origin.y, angle = (Math.atan2(dy, dx) * 180) / Math.PI;
      if (active[0]?.isBox) lines.push(figure(Math.abs(dx)) + " × " + figure(Math.abs(dy)) + " µm");
      else lines.push("Δ " + figure(dx) + ", " + figure(dy), figure(Math.hypot(dx, dy)) + " µm  " + Math.round(angle * 10) / 10 + "°");
    }
    if (violations.length) lines.push([...new Set(violations)].slice(0, 2).join(", ")
      + (violations.length > 1 ? " (" + shown(violations.length) + ")" : ""));
    context.font = "11.5px system-ui, sans-serif";
    const width = Math.max(...lines.map((line) => context.measureText(line).width)) + 12, height = 15 * lines.length + 6;
    let x = map.toX(at.x) + 14, y = map.toY(at.y) + 14;
    if (x + width > map.width - 4) x -= width + 28;
    if (y + height > map.height - 4) y -= height + 28;
    context.fillStyle = inkOf("--raised");
    context.globalAlpha = 0.92;
    context.beginPath();
    context.roundRect(x, y, width, height, 5);
    context.fill();
    context.globalAlpha = 1;
    lines.forEach((line, i) => {
      context.fillStyle = violations.length && i === lines.length - 1 ? inkOf("--wrong") : inkOf("--text");
      context.fillText(line, x + 6, y + 14 + 15 * i);
    });
  }

  _describe() {
    const { layout, bar, selected, at } = this, violations = this.studio.violations(), n = this.studio.nViolations();
    const inset = layout.inset_um > 0 && ["polygon", "rectangle", "cut"].includes(this.name)
      ? "Outlines are drawn before the inset of " + shown(layout.inset_um) + " µm." : "";
    const picked = ["merge", "split", "channel", "move"].includes(this.name) && selected.length
      ? shown(selected.length) + (selected.length === 1 ? " site selected. " : " sites selected. ") : "";
    bar.describe({
      note: this.problem || inset || (picked && picked + bar.usual), error: this.error || this.rejected, isReady: this.tool.isReady,
      isSelected: selected.length > 0, position: at ? this._positionOf(at) : "", step: this.step,
      rules: layout.rules
        ? { exist: true, text: n ? shown(n) + (n === 1 ? " violation" : " violations") : "rules satisfied",
          title: "Show the design rules", isWrong: n > 0 && Boolean(violations) }
        : { exist: false, text: "Add design rules", title: "Check the minimum site size, the width and overlaps while drawing",
          isWrong: false },
    });
  }
}
