// The page: controls, the photosite under the mouse, colours, design rules, picture, links.

import { connect, hasAddress, report } from "./bridge.js";
import { Scale, bytesOfHex, clamp, formatLength, shown } from "./colours.js";
import { COLOUR_MAPS } from "./colour_maps.js";
import { listenToPointers } from "./gestures.js";
import { context2d, findRenderer, fitCanvas, pixelRatio, watchSize } from "./gl.js";
import { drawRamp, kindsOf, pictureOf, summaryOf, swatchItem, tickLabels, titleOf } from "./legend.js";
import { SensorMap } from "./map.js";
import { drawCross, drawOutlines, drawSelected, drawTrace, drawView, outline, positionText, ringSites } from "./marks.js";
import { downloadTable, lengthText, sitesIn, statisticsRows, tableOf } from "./measure.js";
import { Overview } from "./overview.js";
import { $, downloadPicture, find, inkOf, isForPage, listenToHelp, make, notice, speak, startTheme, stayingNotice,
  useTheme } from "./page_parts.js";
import { RulesList, VIOLATION_ARRAYS } from "./rules_list.js";
import { drawScaleBar, flyTo, listenToRange, panByKey, siteHeading, siteRows, spokenSite, stopFlight, zoomByKey } from "./shell.js";
import { Sites } from "./sites.js";
import { unpack } from "./unpack.js";

const about = JSON.parse($("about").textContent);
const STEPS = 72;

/** @typedef {{ map: SensorMap, overview: Overview }} SecondMap */

class PageState {
  // Given by open().
  /** @type {Sites} */ sites;
  /** @type {SensorMap} */ map;
  /** @type {Overview} */ overview;
  /** @type {Renderer} */ renderer;
  /** @type {Column} */ column;
  /** @type {Scale} */ scale;
  /** @type {Fitted} */ lines;
  /** @type {Fitted} */ marks;
  /** @type {{ length: number, width: number }} */ scaleBar;
  /** @type {RulesList | null} */ rules = null;
  /** @type {boolean | undefined} */ wantsLog = undefined;
  /** @type {string | null} */ wantedMap = null;
  /** @type {Interval | null} */ range = null;
  /** @type {string[]} */ rangeTexts = [];
  /** @type {Uint32Array | null} */ histogram = null;
  /** @type {SecondMap & { column: Column, scale: Scale } | null} */ second = null;
  /** @type {SecondMap | null} */ secondMap = null;
  /** @type {Cursor | null} */ cursor = null;
  /** @type {"ruler" | "select" | null} */ tool = null;
  /** @type {Point | null} */ start = null;
  /** @type {Rectangle | null} */ ruler = null;
  /** @type {Rectangle | null} */ selection = null;
  /** @type {number[]} */ selected = [];
  /** @type {number[]} */ others = [];
  hovered = -1; pinned = -1; drawn = 0; drawMs = 0; loaded = false; isSlow = false;
}

const state = new PageState();
const asks = { map: false, marks: false };

const array = (name) => unpack(name, about.arrays[name]);

// -- columns ------------------------------------------------------------------------------------------------------------

async function valuesOf(column) {
  if (!column.values) {
    if (column.of === "area") column.values = state.sites.area;
    else if (column.of === "size") column.values = state.sites.sizes;
    else column.values = await array(column.array);
  }
  return column.values;
}

/** @param {string} key @param {Interval | null} range */
async function colourBy(key, range = null) {
  const column = about.columns.find((c) => c.key === key) || about.columns[0];
  await valuesOf(column);
  if (state.column !== column) state.wantsLog = undefined;
  state.column = column;
  state.range = range;
  state.scale = await scaleOf(column, state.second);
  $("colouring").value = column.key;
  repaint();
  drawLegend();
  fillRange();
  if (state.second) await showSecond(state.second.column.key);
  rememberView();
  report("by", column.key);
}

// The scale of a column; with the values of the other map if that shows the same quantity, so that colours are comparable.
async function scaleOf(column, other) {
  const filterOf = about.filter && column.kind === "lit" ? await array(about.filter) : null;
  const quantity = (one) => one.key.replace(/^second-/, "");
  const alsoValues = other && quantity(other.column) === quantity(column) ? await valuesOf(other.column) : null;
  return new Scale(column, await valuesOf(column), filterOf, about.palette,
    { wantsLog: state.wantsLog, wantedMap: state.wantedMap, alsoValues });
}

function repaint() {
  for (const { map, scale } of [state, ...(state.second ? [state.second] : [])]) {
    scale.paint(map.colours, map === state.map ? state.range : null, groundColour());
    map.sendColours();
  }
  ask("map");
}

// -- the second map ---------------------------------------------------------------------------------------------------------

// Shows another column in a map next to the first one, with the same view; an empty key hides it.
async function showSecond(key) {
  const column = about.columns.find((one) => one.key === key), main = find(document, "main"), wasShown = Boolean(state.second);
  $("second-column").value = column ? key : "";
  $("second").hidden = !column;
  main.classList.toggle("two-maps", Boolean(column));
  if (!column) {
    state.second = null;
    if (wasShown && state.column) state.scale = await scaleOf(state.column, null);
  } else {
    state.secondMap = state.secondMap || createSecond();
    const { map, overview } = state.secondMap;
    state.second = { column, map, overview, scale: await scaleOf(column, state.column && state) };
    $("second-title").textContent = titleOf(column);
    if (state.column) state.scale = await scaleOf(state.column, state.second);
  }
  if (Boolean(column) !== wasShown) resize();
  repaint();
  drawLegend();
  rememberView();
}

function createSecond() {
  const map = new SensorMap($("second-cells"), state.sites, state.renderer);
  const overview = new Overview($("second-overview"), state.sites), first = state.map;
  listenToPointers($("second-marks"), {
    drag: (dx, dy) => { first.set(first.x - dx / first.scale, first.y + dy / first.scale, first.scale); moved(); },
    pinch: (factor, px, py) => { first.zoom(factor, px, py); moved(); },
    wheel: (factor, px, py) => { first.zoom(factor, px, py); moved(); },
    click: () => pin(state.hovered),
    move: (px, py) => hover(map.fromX(px), map.fromY(py), "second"),
    leave,
  });
  return { map, overview };
}

function drawSecond({ map, overview, scale }) {
  const first = state.map;
  map.set(first.x, first.y, first.scale);
  map.draw(groundColour());
  overview.update(map, scale, null);
}

const groundColour = () => bytesOfHex(inkOf("--map"));

// -- legend and histogram ---------------------------------------------------------------------------------------------------

function fitted(canvas) {
  const ratio = pixelRatio(), width = canvas.clientWidth, height = canvas.clientHeight;
  fitCanvas(canvas, width, height);
  // With software rendering, drawing without WebGL is twenty times faster.
  const context = context2d(canvas, { willReadFrequently: state.isSlow });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { context, width, height };
}

function drawLegend() {
  const { scale, column } = state, isKinds = column.kind === "kinds";
  $("bar").hidden = $("range").hidden = isKinds;
  $("kinds").hidden = !isKinds;
  $("log-label").hidden = !scale.canLog;
  $("log").checked = scale.isLog;
  $("map-label").hidden = !scale.canMap;
  $("colour-map").value = scale.map;
  if (isKinds) {
    const { items, rest } = kindsOf(scale);
    $("kinds").replaceChildren(...items.map(swatchItem));
    $("summary").textContent = rest;
    return;
  }
  state.histogram = scale.histogram(STEPS);
  drawHistogram();
  const ramp = fitted($("ramp"));
  drawRamp(ramp.context, scale, ramp.width, ramp.height);
  $("ticks").replaceChildren(...tickLabels(scale));
  $("summary").textContent = summaryOf(scale);
}

// Heights are square roots of counts, so that a few sites among many are visible.
function drawHistogram() {
  const { scale, histogram, column } = state;
  if (!histogram || column.kind === "kinds") return;
  const { context, width, height } = fitted($("histogram"));
  const most = Math.max(...histogram), step = width / histogram.length;
  const [from, to] = state.range ? state.range.map((v) => scale.fraction(v) * width) : [-1, width + 1];
  const inside = inkOf("--accent"), outside = inkOf("--line");
  context.clearRect(0, 0, width, height);
  histogram.forEach((count, i) => {
    const x = i * step, tall = count ? Math.max(1.5, Math.sqrt(count / most) * (height - 4)) : 0;
    const isIn = x + step > from && x < to;
    context.fillStyle = isIn ? inside : outside;
    context.fillRect(x, height - tall, Math.max(step - (step > 3 ? 0.75 : 0), 0.5), tall);
  });
  const site = state.pinned >= 0 ? state.pinned : state.hovered;
  if (site >= 0 && Number.isFinite(column.values[site])) {
    const x = clamp(scale.fraction(column.values[site]), 0, 1) * width;
    context.fillStyle = inkOf("--text");
    context.fillRect(clamp(x - 1, 0, width - 2), 0, 2, height);
  }
}

/** @param {Interval | null} range */
function setRange(range) {
  state.range = range && [Math.min(...range), Math.max(...range)];
  fillRange();
  repaint();
  drawHistogram();
  rememberView();
}

function fillRange() {
  const { range, scale } = state;
  state.rangeTexts = (range || [scale.lowest, scale.highest]).map((bound) => String(Number(bound.toPrecision(5))));
  $("range-from").value = state.rangeTexts[0];
  $("range-to").value = state.rangeTexts[1];
  $("range-all").disabled = !range;
}

function listenToHistogram() {
  const canvas = $("histogram");
  listenToRange(canvas, () => state.scale, (event) => {
    const box = canvas.getBoundingClientRect();
    return (event.clientX - box.left) / box.width;
  }, setRange);
  for (const id of ["range-from", "range-to"]) {
    $(id).addEventListener("change", () => {
      // An unchanged bound keeps its full precision, which its field does not show.
      const [low, high] = state.range || [state.scale.lowest, state.scale.highest], [lowText, highText] = state.rangeTexts;
      const from = $("range-from").value === lowText ? low : Number($("range-from").value);
      const to = $("range-to").value === highText ? high : Number($("range-to").value);
      if (Number.isFinite(from) && Number.isFinite(to)) setRange([from, to]);
      else fillRange();
    });
  }
  $("range-all").addEventListener("click", () => setRange(null));
  $("colour-map").append(...COLOUR_MAPS.map((name) => make("option", name)));
  $("colour-map").addEventListener("change", () => {
    state.wantedMap = $("colour-map").value;
    colourBy(state.column.key, state.range);
  });
  $("log").addEventListener("change", () => {
    state.wantsLog = $("log").checked;
    colourBy(state.column.key, state.range);
  });
}

// -- drawing ------------------------------------------------------------------------------------------------------------------

function ask(what) {
  const isAsked = asks.map || asks.marks;
  asks[what] = true;
  if (!isAsked) requestAnimationFrame(drawAsked);
}

function drawAsked() {
  const isMap = asks.map;
  asks.map = asks.marks = false;
  if (isMap) drawMap();
  drawMarks();
}

function drawMap() {
  const start = performance.now();
  state.map.draw(groundColour());
  state.overview.update(state.map, state.scale, state.range);
  if (state.second) drawSecond(state.second);
  drawLines();
  state.scaleBar = drawScaleBar($("scale-bar"), state.map);
  state.drawn++;
  state.drawMs = performance.now() - start;
}

// Draws outlines of sufficiently large sites, and markers of violations.
function drawLines() {
  const { map } = state, { context, width, height } = state.lines;
  context.clearRect(0, 0, width, height);
  drawOutlines(context, map, width, height);
  state.rules?.draw(context, map, state.sites);
}

function drawMarks() {
  const { map, cursor, second, sites, pinned, hovered, selection, selected } = state, { context, width, height } = state.marks;
  context.clearRect(0, 0, width, height);
  const trace = state.rules?.traceOn(sites);
  if (trace) drawTrace(context, map, trace);
  ringSites(context, map, pinned, hovered);
  if (cursor && cursor.from !== "mouse") drawCross(context, map.toX(cursor.x), map.toY(cursor.y));
  if (second) {
    const { context: other, ...size } = fitted($("second-marks"));
    other.clearRect(0, 0, size.width, size.height);
    ringSites(other, second.map, pinned, hovered);
    if (cursor && cursor.from !== "second") drawCross(other, second.map.toX(cursor.x), second.map.toY(cursor.y));
  }
  drawSelected(context, map, selection, selection ? [] : selected);
  if (state.ruler) drawRuler(context, state.ruler);
  drawPictureMarks();
}

// -- the picture -----------------------------------------------------------------------------------------------------------------

// Position of the picture in its frame, in CSS pixels, including letterboxing.
function pictureBox() {
  const frame = $("picture-frame"), { width, height, bounds_um: bounds } = about.picture;
  const scale = Math.min(frame.clientWidth / width, frame.clientHeight / height);
  const left = 0.5 * (frame.clientWidth - scale * width), top = 0.5 * (frame.clientHeight - scale * height);
  const perUm = (scale * width) / (bounds[2] - bounds[0]);
  return {
    toX: (x) => left + (x - bounds[0]) * perUm, toY: (y) => top + scale * height - (y - bounds[1]) * perUm,
    fromX: (px) => bounds[0] + (px - left) / perUm, fromY: (py) => bounds[1] + (top + scale * height - py) / perUm,
  };
}

function drawPictureMarks() {
  const { context, width, height } = fitted($("picture-marks")), box = pictureBox(), { map, cursor } = state;
  context.clearRect(0, 0, width, height);
  drawView(context, box, map, width, height);
  if (cursor) drawCross(context, box.toX(cursor.x), box.toY(cursor.y), true);
}

function listenToPicture() {
  const frame = $("picture-frame");
  /** @type {(event: MouseEvent) => [number, number]} */
  const position = (event) => {
    const area = frame.getBoundingClientRect(), box = pictureBox();
    return [box.fromX(event.clientX - area.left), box.fromY(event.clientY - area.top)];
  };
  const isIn = ([x, y]) => { const [a, b, c, d] = about.picture.bounds_um; return x >= a && x <= c && y >= b && y <= d; };
  frame.addEventListener("pointermove", (event) => { const at = position(event); isIn(at) ? hover(...at, "picture") : leave(); });
  frame.addEventListener("pointerleave", leave);
  frame.addEventListener("click", (event) => {
    const at = position(event);
    if (!isIn(at)) return;
    fly(...at, Math.max(state.map.scale, 4 * state.map.fitScale()));
  });
  $("enlarge").addEventListener("click", () => {
    const main = find(document, "main"), isSideBySide = main.classList.toggle("side-by-side");
    if (isSideBySide) main.insertBefore(frame, document.querySelector("aside"));
    else $("picture-heading").closest("section")?.append(frame);
    $("enlarge").setAttribute("aria-pressed", String(isSideBySide));
    resize();
  });
}

// -- the photosite ------------------------------------------------------------------------------------------------------------------

function hover(x, y, from) {
  const all = state.sites.pickAll(x, y);
  state.cursor = { x, y, from };
  state.hovered = all.at(-1) ?? -1;
  state.others = all.slice(0, -1);
  $("cursor").textContent = rulerText() || "x " + positionText(x, state.map.scale) + "  y " + positionText(y, state.map.scale) + " µm";
  tellSite();
  ask("marks");
}

function leave() {
  state.cursor = null;
  state.hovered = -1;
  state.others = [];
  $("cursor").textContent = "";
  tellSite();
  ask("marks");
}

let announcedSite = "";

function tellSite() {
  const site = state.hovered >= 0 ? state.hovered : state.pinned;
  const key = site + "/" + state.pinned + "/" + state.others + "/" + state.loaded;
  if (key === announcedSite) return;
  announcedSite = key;
  report("hovered", state.hovered);
  report("pinned", state.pinned);
  $("site").classList.toggle("empty", site < 0);
  $("unpin").hidden = state.pinned < 0;
  $("site-heading").textContent = siteHeading(site, state.pinned);
  const rows = siteRows(state.sites, about.columns, site, 6);
  const isColoured = (column) => column === state.column || (column.array && column.array === state.column.array);
  if (site >= 0 && site === state.hovered && state.others.length) rows.push(["overlaps", state.others.join(", ")]);
  const cells = [];
  for (const [label, text, column] of rows) {
    const value = make("dd", text);
    if (column && isColoured(column) && site >= 0) {
      const swatch = make("span", undefined, "swatch");
      swatch.style.background = "rgb(" + state.scale.colour(site) + ")";
      value.prepend(swatch);
    }
    cells.push(make("dt", label), value);
  }
  $("values").replaceChildren(...cells);
  drawHistogram();
  speak(site < 0 ? null : () => spokenSite(about.columns, site, state.sites.area));
}

function pin(site) {
  state.pinned = site === state.pinned ? -1 : site;
  tellSite();
  drawHistogram();
  rememberView();
  ask("marks");
}

function goTo(site) {
  const { sites, map } = state, [a, b, c, d] = sites.box.subarray(4 * site, 4 * site + 4);
  state.pinned = site;
  const wanted = 0.12 * Math.min(map.width, map.height) / Math.max(c - a, d - b);
  fly(0.5 * (a + c), 0.5 * (b + d), wanted);
  tellSite();
}

// -- navigation -------------------------------------------------------------------------------------------------------------------------

function fly(x, y, scale) { flyTo(state.map, [x, y, scale], moved); }

function moved() {
  ask("map");
  rememberView();
}

function fit() {
  const { map } = state;
  fly(map.middle[0], map.middle[1], map.fitScale());
}

function resize() {
  const frame = $("map"), { map } = state, isWhole = Math.abs(map.scale / map.fitScale() - 1) < 1e-6;
  map.resize(frame.clientWidth, frame.clientHeight);
  state.lines = fitted($("lines"));
  state.marks = fitted($("marks"));
  if (isWhole) map.set(map.middle[0], map.middle[1], map.fitScale());
  else map.set(map.x, map.y, map.scale);
  if (state.second) state.second.map.resize($("second").clientWidth, $("second").clientHeight);
  if (state.scale) drawLegend();
  ask("map");
}

function listenToMap() {
  const canvas = $("marks"), { map } = state;
  /** @type {Point} */
  let held = [0, 0];
  listenToPointers(canvas, {
    press: (px, py) => { stopFlight(); held = [map.fromX(px), map.fromY(py)]; },
    drag: (dx, dy, { px, py, isSecond }) => {
      if (state.tool && !isSecond) { extend(held, [map.fromX(px), map.fromY(py)]); return; }
      map.set(map.x - dx / map.scale, map.y + dy / map.scale, map.scale);
      moved();
    },
    pinch: (factor, px, py) => { map.zoom(factor, px, py); moved(); },
    wheel: (factor, px, py) => {
      stopFlight();
      map.zoom(factor, px, py);
      hover(map.fromX(px), map.fromY(py), "mouse");
      moved();
    },
    click: () => { if (!state.tool) pin(state.hovered); },
    move: (px, py) => hover(map.fromX(px), map.fromY(py), "mouse"),
    leave,
  });
  canvas.addEventListener("blur", () => { if (state.cursor && state.cursor.from === "keys") leave(); });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const isMoved = panByKey(map, event.key);
    if (!isMoved && event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    stopFlight();
    hover(map.x, map.y, "keys");
    if (!isMoved && state.tool) setPoint();
    else if (!isMoved) pin(state.hovered);
    if (isMoved && state.tool && state.start) extend(state.start, [map.x, map.y]);
    moved();
  });
  document.addEventListener("keydown", (event) => {
    if (!isForPage(event)) return;
    if (zoomByKey(map, event.key)) moved();
    else if (event.key === "0") fit();
    else if (event.key === "/") { $("find-site").focus(); event.preventDefault(); }
    else if (event.key === "r" || event.key === "R") useTool("ruler");
    else if (event.key === "s" || event.key === "S") useTool("select");
    else if (event.key === "Escape") { clearTools(); state.pinned = -1; state.rules?.choose(null); setRange(null); tellSite(); moved(); }
    if (document.activeElement === canvas) hover(map.x, map.y, "keys");
  });
  $("nearer").addEventListener("click", () => fly(map.x, map.y, 2 * map.scale));
  $("farther").addEventListener("click", () => fly(map.x, map.y, 0.5 * map.scale));
  $("fit").addEventListener("click", fit);
  $("unpin").addEventListener("click", () => { state.pinned = -1; tellSite(); moved(); });
  watchSize($("map"), resize);
}

// -- ruler and selection ------------------------------------------------------------------------------------------------------------------

// Chooses the ruler or the selection of a rectangle; the same again, or null, for panning.
function useTool(name) {
  state.tool = state.tool === name ? null : name;
  state.start = null;
  for (const id of ["ruler", "select"]) $(id).setAttribute("aria-pressed", String(state.tool === id));
  $("marks").classList.toggle("measuring", Boolean(state.tool));
  if (state.tool) notice(state.tool === "ruler" ? "Drag to measure a length" : "Drag to select photosites");
}

function clearTools() {
  if (state.tool) useTool(state.tool);
  state.ruler = null;
  select(null);
}

// Sets the ends of the ruler, or opposite corners of the rectangle.
function extend(from, to) {
  if (state.tool === "ruler") {
    state.ruler = [from, to];
    $("cursor").textContent = rulerText();
    speak(() => "Length " + rulerText());
  } else select([from, to]);
  ask("marks");
}

// With the keyboard: the first point at the centre of the view; the arrows move the second one, Enter ends.
function setPoint() {
  /** @type {Point} */
  const at = [state.map.x, state.map.y];
  if (state.start) extend(state.start, at);
  else notice("First point set; the arrows move the second one, Enter ends");
  state.start = state.start ? null : at;
}

function rulerText() {
  if (state.tool !== "ruler" || !state.ruler) return "";
  const { text, detail } = lengthText(...state.ruler);
  return text + "  " + detail;
}

// Selects the sites in a rectangle, or given ones; null and no sites for none.
function select(rectangle, sites = rectangle ? sitesIn(state.sites, rectangle) : []) {
  state.selection = rectangle;
  state.selected = sites;
  $("selection").hidden = !rectangle && !sites.length;
  if (!$("selection").hidden) showSelection();
  report("selected", sites);
  ask("marks");
}

function showSelection() {
  const { selection, selected } = state, size = (v) => String(Number(Math.abs(v).toPrecision(4)));
  $("selection-heading").textContent = "Selection: " + shown(selected.length) + (selected.length === 1 ? " photosite" : " photosites");
  const where = selection ? "Centres in " + size(selection[1][0] - selection[0][0]) + " × " + size(selection[1][1] - selection[0][1])
    + " µm; " : "";
  $("selection-note").textContent = where + "std is the sample standard deviation.";
  $("statistics").replaceChildren(...statisticsRows(about.columns, selected));
  $("export").disabled = !selected.length || !state.loaded;
  rememberView();
}

function drawRuler(context, ruler) {
  const { map } = state;
  const [[x0, y0], [x1, y1]] = ruler.map(([x, y]) => [map.toX(x), map.toY(y)]), length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [u, v] = [(-6 * (y1 - y0)) / length, (6 * (x1 - x0)) / length];
  const line = () => {
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    for (const [x, y] of [[x0, y0], [x1, y1]]) { context.moveTo(x - u, y - v); context.lineTo(x + u, y + v); }
  };
  outline(context, line, [5, 2], ["#ffffff", "#10151f"]);
  const { text } = lengthText(...ruler);
  context.font = "600 13px system-ui, sans-serif";
  const width = context.measureText(text).width + 12, x = clamp(0.5 * (x0 + x1) - 0.5 * width, 4, Math.max(4, map.width - width - 4));
  const y = clamp(0.5 * (y0 + y1) - 30, 4, map.height - 26);
  context.fillStyle = inkOf("--raised");
  context.fillRect(x, y, width, 21);
  context.fillStyle = inkOf("--text");
  context.fillText(text, x + 6, y + 15);
}

function listenToMeasurements() {
  for (const id of ["ruler", "select"]) $(id).addEventListener("click", () => useTool(id));
  $("clear-selection").addEventListener("click", () => { select(null); rememberView(); });
  $("export").addEventListener("click", () => downloadTable(state.sites, about.columns, state.selected, about.name));
}

// -- design rules -----------------------------------------------------------------------------------------------------------------------

async function loadRules() {
  for (const element of document.querySelectorAll(".for-rules")) element.toggleAttribute("hidden", !about.rules.length);
  if (!about.rules.length) return;
  const arrays = Object.fromEntries(await Promise.all(VIOLATION_ARRAYS.map(async (name) => [name, await array(name)])));
  const elements = { select: $("rule"), note: $("rule-description"), list: $("violations"), more: $("more") };
  const rules = new RulesList(elements, (i) => {
    const at = rules.frameOf(i, state.map);
    if (at) fly(...at);
    else notice("The report has no position for this violation");
  });
  rules.use(about.rules, arrays, state.sites);
  state.rules = rules;
  $("rules").hidden = false;
  $("rule").addEventListener("change", () => ask("map"));
}

// -- links, pictures, themes
// -----------------------------------------------------------------------------------------------------------------

let remembering = 0;

function rememberView() {
  clearTimeout(remembering);
  if (hasAddress) remembering = setTimeout(() => history.replaceState(null, "", viewHash()), 150);
}

function viewHash() {
  const { map, column, range, pinned } = state, words = new URLSearchParams();
  const digits = clamp(Math.ceil(Math.log10(map.scale)) + 2, 0, 12);
  words.set("x", map.x.toFixed(digits));
  words.set("y", map.y.toFixed(digits));
  words.set("width", String(Number((map.width / map.scale).toPrecision(5))));
  words.set("by", column.key);
  if (range) words.set("range", range.map((v) => Number(v.toPrecision(7))).join(" "));
  if (state.wantedMap) words.set("map", state.wantedMap);
  if (state.second) words.set("second", state.second.column.key);
  if (state.selection) words.set("select", state.selection.flat().map((v) => Number(v.toPrecision(9))).join(" "));
  if (pinned >= 0) words.set("site", String(pinned));
  return "#" + words;
}

// Restores the view of a link, as far as it is valid.
/** @returns {{ key: string | null, range: Interval | null }} */
function readHash() {
  const words = new URLSearchParams(location.hash.slice(1)), { map, sites } = state;
  const [x, y, width] = ["x", "y", "width"].map((name) => (words.has(name) ? Number(words.get(name)) : NaN));
  if (Number.isFinite(x) && Number.isFinite(y) && width > 0) map.set(x, y, map.width / width);
  const site = words.has("site") ? Number(words.get("site")) : -1;
  if (Number.isInteger(site) && site >= 0 && site < sites.n) state.pinned = site;
  const range = (words.get("range") || "").split(" ").map(Number), box = (words.get("select") || "").split(" ").map(Number);
  state.wantedMap = COLOUR_MAPS.find((name) => name === words.get("map")) ?? null;
  if (box.length === 4 && box.every(Number.isFinite)) select([[box[0], box[1]], [box[2], box[3]]]);
  return { key: words.get("by"), range: range.length === 2 && range.every(Number.isFinite) ? [range[0], range[1]] : null };
}

async function copyLink() {
  history.replaceState(null, "", viewHash());
  try {
    await navigator.clipboard.writeText(location.href);
    notice("Link to this view copied");
  } catch {
    notice("Copy the link to this view from the address bar");
  }
}

// Returns the displayed maps with their scale bar and legends.
function viewAsPicture() {
  const { map, scale, second, scaleBar } = state, visible = (names) => names.map($).filter((layer) => !layer.hidden);
  map.draw(groundColour());
  if (state.overview.isNeeded(map)) state.overview.draw(map, scale, state.range);
  if (second) drawSecond(second);
  // The second map may be below the first, and of another height.
  const views = [visible(["cells", "overview", "lines", "marks"]),
    ...(second ? [visible(["second-cells", "second-overview", "second-marks"])] : [])];
  const bar = { text: formatLength(scaleBar.length), width: scaleBar.width };
  const hasOwnScale = second && second.column.key.replace(/^second-/, "") !== state.column.key;
  return pictureOf(views, { width: map.width + (second ? second.map.width : 0), height: map.height, bar,
    scales: [scale, ...(hasOwnScale ? [second.scale] : [])], items: [] });
}

function listenToTools() {
  $("link").hidden = !hasAddress;
  $("link").addEventListener("click", copyLink);
  $("save").addEventListener("click", () => downloadPicture(viewAsPicture(), about.name));
  $("find").addEventListener("submit", (event) => {
    event.preventDefault();
    const text = $("find-site").value.replace(/[\s,_]/g, ""), site = text === "" ? NaN : Number(text);
    const isThere = Number.isInteger(site) && site >= 0 && site < state.sites.n;
    $("find-site").setAttribute("aria-invalid", String(!isThere));
    if (isThere) goTo(site);
    else notice("Photosites are numbered from 0 to " + shown(state.sites.n - 1));
  });
  window.addEventListener("hashchange", async () => {
    const { key, range } = readHash();
    await colourBy(key || state.column.key, range);
    tellSite();
    moved();
  });
}

// -- loading
// --------------------------------------------------------------------------------------------------------------------------------

function showTheme() {
  if (!state.scale) return;
  repaint();
  drawLegend();
}

// After the graphics context was lost, all data are sent again when it is restored.
function listenToLosses() {
  $("cells").addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    stayingNotice("The graphics context was lost; the map returns when the context is restored.");
  });
  $("cells").addEventListener("webglcontextrestored", () => {
    state.map.restore();
    stayingNotice(null);
    ask("map");
  });
}

// Without WebGL2 the picture replaces the map.
function showPlain(why) {
  document.body.classList.add("plain");
  $("opening").hidden = true;
  $("map").append($("picture-frame"));
  stayingNotice(why);
}

async function open() {
  startTheme(showTheme);
  listenToHelp();
  $("notes").textContent = about.notes.join(" · ");
  if (about.picture_name) $("picture-heading").textContent = about.picture_name;
  const renderer = findRenderer();
  if (!renderer) {
    showPlain("This browser has no WebGL2, which the map needs; only the picture is shown.");
    return;
  }
  state.isSlow = renderer.isSlow;
  state.renderer = renderer;
  const names = ["xy_um", "position", "ring_sizes", "cut_sites", "cut_counts", "cuts", ...(about.arrays.site_rings ? ["site_rings"] : [])];
  const arrays = Object.fromEntries(await Promise.all(names.map(async (name) => [name, await array(name)])));
  state.sites = new Sites(arrays, about);
  state.map = new SensorMap($("cells"), state.sites, renderer);
  state.overview = new Overview($("overview"), state.sites);
  if (!state.map.gl) throw new Error("WebGL2 was lost");
  listenToLosses();
  for (const id of ["colouring", "second-column"]) {
    $(id).append(...about.columns.map((column) => new Option(titleOf(column), column.key)));
  }
  $("second-column").addEventListener("change", () => showSecond($("second-column").value));
  $("colouring").addEventListener("change", () => colourBy($("colouring").value));
  state.map.resize($("map").clientWidth, $("map").clientHeight);
  state.lines = fitted($("lines"));
  state.marks = fitted($("marks"));
  state.map.set(state.map.middle[0], state.map.middle[1], state.map.fitScale());
  const { key, range } = readHash();
  await loadRules();
  await colourBy(key || (about.kind === "layout" && !about.filter ? "size_um" : about.columns[0].key), range);
  listenToMap();
  listenToHistogram();
  listenToPicture();
  listenToTools();
  listenToMeasurements();
  const second = about.columns.find((column) => column.key.startsWith("second-"));
  const asked = new URLSearchParams(location.hash.slice(1)).get("second");
  if (asked !== null || second) await showSecond(asked !== null ? asked : second.key);
  tellSite();
  drawAsked();
  $("opening").hidden = true;
}

// Loads all other columns after the page is usable.
async function openRest() {
  for (const column of about.columns) await valuesOf(column);
  state.loaded = true;
  tellSite();
  if (state.selected.length) showSelection();
  connected();
}

// The view as a notebook reads and sets it.
const connected = connect(
  {
    by: (key) => colourBy(key),
    pinned: (site) => { state.pinned = site < state.sites.n ? site : -1; tellSite(); drawHistogram(); ask("marks"); },
    // The same sites again keep their rectangle.
    selected: (sites) => { if (sites.join() !== state.selected.join()) select(null, sites.filter((site) => site < state.sites.n)); },
    theme: useTheme,
  },
  () => ({ by: state.column.key, hovered: state.hovered, pinned: state.pinned, selected: state.selected }),
);

const handle = {
  nSites: about.n_sites,
  ready: Promise.resolve(),
  complete: Promise.resolve(),
  readyMs: NaN,
  pick: (x, y) => state.sites.pick(x, y),
  pickAll: (x, y) => state.sites.pickAll(x, y),
  values: (site) => Object.fromEntries(about.columns.map((c) => [c.key, c.names ? c.names[c.values[site]] : c.values[site]])),
  colour: (site) => state.scale.colour(site),
  centre: (site) => state.sites.centre(site),
  get view() { const { x, y, scale, width, height } = state.map; return { x, y, scale, width, height }; },
  // Whether all is drawn.
  get isIdle() { return !asks.map && !asks.marks && !state.overview?.resting; },
  get hovered() { return state.hovered; },
  get pinned() { return state.pinned; },
  get chosen() { return state.rules?.chosen ?? null; },
  get range() { return state.range; },
  get drawMs() { return state.drawMs; },
  get column() { return state.column.key; },
  // CSS pixels of the window, for mouse events.
  toWindow: (x, y) => { const box = $("marks").getBoundingClientRect(); return [box.left + state.map.toX(x), box.top + state.map.toY(y)]; },
  fromWindow: (px, py) => {
    const box = $("marks").getBoundingClientRect();
    return [state.map.fromX(px - box.left), state.map.fromY(py - box.top)];
  },
  get selected() { return [...state.selected]; },
  get ruler() { return state.ruler && lengthText(...state.ruler).length; },
  get tool() { return state.tool; },
  get table() { return tableOf(state.sites, about.columns, state.selected); },
  get colourMap() { return state.scale.map; },
  get second() { return state.second && state.second.column.key; },
  get secondView() { const { x, y, scale, width, height } = state.second?.map || state.map; return { x, y, scale, width, height }; },
  secondColour: (site) => state.second?.scale.colour(site),
  get hasOverview() { return !$("overview").hidden; },
  // Colours of the overview as drawn, (r, g, b, a) of all pixels, top row first.
  overview: () => {
    const canvas = $("overview");
    state.overview.draw(state.map, state.scale, state.range);
    return { width: canvas.width, height: canvas.height,
      data: [...context2d(canvas).getImageData(0, 0, canvas.width, canvas.height).data] };
  },
  // Colours of the drawn pixels of the map, (r, g, b, a) at a position on the sensor.
  pixel: (x, y) => {
    const { map } = state, { gl } = map, ratio = map.canvas.width / map.width, bytes = new Uint8Array(4);
    map.draw(groundColour());
    gl?.readPixels(Math.floor(map.toX(x) * ratio), map.canvas.height - 1 - Math.floor(map.toY(y) * ratio), 1, 1, gl.RGBA,
      gl.UNSIGNED_BYTE, bytes);
    return [...bytes];
  },
  picture: () => viewAsPicture().toDataURL("image/png"),
};
Object.assign(window, { foveasim: handle });
handle.ready = open().then(() => { handle.readyMs = performance.now(); }).catch((error) => {
  showPlain("The map cannot be shown (" + error.message + "); only the picture is shown.");
  throw error;
});
handle.complete = handle.ready.then(() => state.sites && openRest());
handle.complete.catch(() => {});
