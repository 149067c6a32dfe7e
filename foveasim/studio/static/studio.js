// The studio: controls, views and the server, which computes all data.

import { clamp, formatLength, roundStep, shown, textOf } from "/web/colours.js";
import { findRenderer, watchSize } from "/web/gl.js";
import { titleOf } from "/web/legend.js";
import { pathBetween, positionText } from "/web/marks.js";
import { downloadTable, statisticsRows } from "/web/measure.js";
import { $, change, inkOf, make, notice, speak, startTheme } from "/web/page_parts.js";
import { Sites } from "/web/sites.js";
import { offsetsOf } from "/web/unpack.js";
import { Editor } from "./authoring.js";
import { boundaryOf } from "./boundary.js";
import { CurveChart, Histogram, barRows } from "./charts.js";
import { showComparison } from "./comparison.js";
import { Connection, memory } from "./connection.js";
import { Controls, valueAt } from "./controls.js";
import { Files } from "./files.js";
import { inNextFrame } from "./frames.js";
import { ImagePane } from "./image_pane.js";
import { listenToDialogs } from "./menus.js";
import { RulesList } from "./rules_list.js";
import { SitePane, useSoftware } from "./site_pane.js";
import { SolidPane } from "./solid_pane.js";
import { Sources } from "./sources.js";
import { Steps } from "./steps.js";
import { statisticsOf, summaryRows } from "./summary.js";

// Views in tiles, with the parts that they need; those that are shown at first on narrow and on wide screens.
const TILES = [
  ["solid", "3D", null],
  ["histogram", "Histogram", null], ["site", "Photosite", null], ["noise", "Noise", "noise"], ["spectrum", "Spectrum", "spectrum"],
  ["photon_transfer", "Photon transfer", "photon_transfer"], ["snr", "SNR", "snr"], ["mtf", "MTF", "mtf"], ["rules", "Design rules", "rules"],
  ["steps", "Steps", null], ["summary", "Summary", null], ["selection", "Selection", null], ["comparison", "A and B", "comparison"],
];
const FIRST_TILES = ["histogram", "noise", "mtf", "summary"];
const CURVES = ["spectrum", "mtf", "photon_transfer", "snr"];
const WIDE = 1800;
const BUSY_DELAY_MS = 150;
const SIZE_DELAY_MS = 250;
const HOLD_MS = 100;
const PICTURE_SIZES = [256, 320, 384, 512, 768, 1024], SMALLER = 0.85;
const ALWAYS = ["sites", "columns", "picture", "scene"];
const reducesMotion = matchMedia("(prefers-reduced-motion: reduce)");

const page = {
  state: null, parts: {}, frozen: null, cursor: null, hovered: -1, pinned: -1, rectangle: null, selected: [], range: null, key: null, wantsLog: undefined, sizeTimer: 0,
  isSelecting: false, tiles: new Set(), asked: null, held: { states: [], parts: [] }, holdTimer: 0, gazeAt: null, lastMs: NaN, nDone: 0, boundary: null, isBusy: false,
};
let connection, controls, panes, charts, rules, editor, steps, sources, solid, files;

// -- drawing ------------------------------------------------------------------------------------------------------------

const MAPS = ["b", "a"], IMAGES = ["picture", "pictureA", "scene"];
// Panes to draw after a part arrived; all marks are drawn in every frame.
const DRAWN = { sites: [...MAPS, ...IMAGES], columns: MAPS, picture: ["picture"], scene: ["scene"], rules: ["b"] };

// Draws panes in the next frame: "map" for all, "marks" for none, or the names of some.
function ask(what) {
  const isAsked = page.asked !== null;
  page.asked = page.asked || new Set();
  for (const name of what === "map" ? [...MAPS, ...IMAGES] : what === "marks" ? [] : what) page.asked.add(name);
  if (!isAsked) inNextFrame(drawAsked);
}

function drawAsked() {
  const { asked } = page;
  if (!asked) return;
  page.asked = null;
  if (page.frozen) panes.a.follow(panes.b);
  for (const name of asked) panes[name].draw();
  if (asked.has("b")) {
    solid.follow(panes.b);
    drawScaleBar();
    page.drawnAt = performance.now();
  }
  drawMarks();
  editor.draw();
  followSize();
}

function drawMarks() {
  const { cursor, rectangle, selected, pinned } = page, { a, b } = panes;
  if (b.isShown) b.drawMarks({ cursor, hovered: page.hovered, pinned, rectangle, selected, trace: rules.traceOn(b.sites) });
  if (page.frozen && a.isShown) a.drawMarks({ cursor, hovered: cursor ? a.pick(cursor.x, cursor.y) : -1, pinned: page.frozen.sites === b.sites ? pinned : -1, rectangle, selected: [], trace: null });
  for (const pane of [panes.picture, panes.pictureA, panes.scene]) pane.drawMarks({ cursor, map: b.map, boundary: page.boundary });
  solid.mark({ cursor, hovered: page.hovered, pinned });
}

function drawScaleBar() {
  const { map } = panes.b;
  if (!map) return;
  const length = roundStep(45 / map.scale), bar = $("scale-bar");
  bar.querySelector("span").textContent = formatLength(length);
  bar.querySelector("i").style.width = length * map.scale + "px";
}

function resize() {
  for (const pane of [panes.b, panes.a]) pane.resize();
  drawCharts();
  for (const pane of [panes.b, panes.a]) if (pane.scale && pane.map) pane.paint(page.range);
  ask("map");
}

// -- parts of the server ------------------------------------------------------------------------------------------------

function useSites({ about, sites, boundary }) {
  const isNew = !panes.b.map;
  panes.b.useSites(sites, about.palette);
  page.boundary = boundary;
  page.hovered = -1;
  if (page.pinned >= sites.n) page.pinned = -1;
  page.selected = page.rectangle && !editor.isOn ? panes.b.sitesIn(page.rectangle) : editor.useSites(sites);
  if (isNew) $("views").classList.add("loaded");
}

function useColumns({ about, arrays }) {
  const { sites } = panes.b;
  if (!sites) return;
  const columns = about.columns.map((column) => ({ ...column, values: column.of === "area" ? sites.area : column.of === "size" ? sites.sizes : arrays[column.array] }));
  // Values of another layout: its outlines follow.
  if (columns.some((column) => column.values.length !== sites.n)) return;
  panes.b.useColumns(columns, about.filter ? arrays[about.filter] : null);
  fillColumns(columns);
  editor.useColumns();
  recolour();
  if (page.selected.length) showSelection();
}

function fillColumns(columns) {
  const select = $("colouring"), text = columns.map((column) => column.key + titleOf(column)).join();
  if (select.dataset.columns !== text) {
    select.dataset.columns = text;
    select.replaceChildren(...columns.map((column) => { const option = make("option", titleOf(column)); option.value = column.key; return option; }));
  }
  if (!columns.some((column) => column.key === page.key)) page.key = columns[0].key;
  select.value = page.key;
}

// Colours both maps by the chosen column, with a common scale.
function recolour() {
  const { a, b } = panes, wantsLog = page.wantsLog;
  if (!b.columns.length || !b.map) return;
  const other = page.frozen && a.columns.find((column) => column.key === page.key);
  b.colourBy(page.key, { wantsLog, alsoValues: other?.values });
  if (page.frozen) {
    a.colourBy(page.key, { wantsLog, alsoValues: b.column.values });
    a.paint(page.range);
  }
  b.paint(page.range);
  $("log").closest("label").hidden = !b.scale.canLog;
  $("log").checked = b.scale.isLog;
  const unit = b.column.unit;
  $("statistics").replaceChildren(...Object.entries(statisticsOf(b)).map(([name, value]) => {
    const item = make("div");
    item.append(make("dt", name), make("dd", value + (unit && name !== "n" ? " " + unit : "")));
    return item;
  }));
  charts.histogram.use(b.scale, page.frozen && other ? a.scale : null);
  tellSite();
}

const curvesOf = ({ about, arrays }, isDashed = false) => about.curves.map((curve, k) => ({ ...curve, x: arrays["x-" + k], y: arrays["y-" + k], isDashed }));

function showCurves(name) {
  const part = page.parts[name], before = page.frozen?.parts[name];
  if (!part) return;
  const curves = curvesOf(part), isSame = (one, other) => one.label === other.label && one.y.length === other.y.length && one.y.every((v, i) => v === other.y[i]);
  // Curves of A that are equal in B would be hidden.
  const others = before && before !== part ? curvesOf(before, true).filter((one) => !curves.some((other) => isSame(one, other))) : [];
  charts[name].use([...curves, ...others], part.about);
}

function showNoise() {
  const part = page.parts.noise;
  if (!part) return;
  const { sources, unit } = part.about, before = page.frozen?.parts.noise;
  $("noise").replaceChildren(...barRows(sources, before && before !== part ? before.about.sources : null, unit));
  const total = Math.hypot(...sources.map((source) => source.values));
  $("noise-note").textContent = sources.length ? "Median over the photosites, " + unit + "; root sum of squares " + shown(Number(total.toPrecision(4))) + " " + unit + "." : "No noise.";
}

const USE = {
  sites: useSites,
  columns: useColumns,
  picture: ({ about, arrays }) => panes.picture.use(about, arrays.rgba),
  scene: ({ about, arrays }) => { panes.scene.use({ ...about, frame_um: panes.b.sites?.bounds }, arrays.rgba); },
  noise: showNoise,
  ...Object.fromEntries(CURVES.map((name) => [name, () => showCurves(name)])),
  comparison: ({ about }) => { if (page.frozen) showTable(about); },
  stack: (part) => solid.useStack(part),
  rules: ({ about, arrays }) => { if (panes.b.sites) rules.use(about.rules, arrays, panes.b.sites); },
};

// A state is shown with the values that follow it, and parts of a group together: each frame takes the browser tens of milliseconds.
function receivePart(part) {
  // While the server computes the values.
  if (part.part === "sites") {
    part.sites = new Sites(part.arrays, part.about);
    part.boundary = boundaryOf(part.sites);
  }
  hold("parts", part);
  if (!part.hasMore) showHeld();
}

function hold(kind, message) {
  page.held[kind].push(message);
  page.holdTimer ||= setTimeout(showHeld, HOLD_MS);
}

function showHeld() {
  clearTimeout(page.holdTimer);
  page.holdTimer = 0;
  const { states, parts } = page.held;
  page.held = { states: [], parts: [] };
  for (const state of states) showState(state);
  for (const part of parts) usePart(part);
}

function usePart(part) {
  const { [part.part]: before } = page.parts;
  if (!USE[part.part] || (before && before.version > part.version)) return;
  page.parts[part.part] = part;
  USE[part.part](part);
  // Frames of the layout move with it.
  if (part.part === "sites" && panes.scene.bounds) panes.scene.frame = part.about.bounds_um;
  ask(DRAWN[part.part] || "marks");
  // Photosites are drawn at once: they are in the next frame together with the controls.
  if (part.part === "columns") drawAsked();
}

// -- state --------------------------------------------------------------------------------------------------------------

function receive(message) {
  if (message.kind !== "state" && message.kind !== "busy") showHeld();
  switch (message.kind) {
    case "state": hold("states", message); return;
    case "controls": controls.describe(message.controls); break;
    case "busy": setBusy(true); break;
    case "done": finish(message); break;
    case "error":
      setBusy(false);
      notice(message.text);
      break;
    case "text": files.receiveText(message); break;
    case "saved": notice("Saved as " + message.path); break;
    default:
  }
  sources.receive(message);
}

function setBusy(isBusy) {
  page.isBusy = isBusy;
  clearTimeout(page.busyTimer);
  // Short work is not announced: each change of the page costs a frame.
  if (isBusy) page.busyTimer = setTimeout(() => { document.body.classList.add("busy"); showStatus("computing…"); }, BUSY_DELAY_MS);
  else document.body.classList.remove("busy");
}

function showStatus(text) { change($("status").lastElementChild, { textContent: text }); }

function finish({ id, is_preview: isPreview }) {
  setBusy(false);
  editor.finish();
  page.nDone++;
  if (page.frozen && !page.frozen.isKept && id >= page.frozen.id) {
    page.frozen.isKept = true;
    keepVariant();
    recolour();
  }
  page.isPreview = Boolean(isPreview);
  // The time to the frame that shows the result.
  const showTime = () => {
    const time = connection.since(id);
    page.doneId = id;
    if (Number.isFinite(time)) page.lastMs = time;
    showStatus((isPreview ? "preview, " : "") + (Number.isFinite(page.lastMs) ? Math.round(page.lastMs) + " ms" : "ready"));
  };
  if (document.hidden) showTime();
  else inNextFrame(showTime);
}

function showState(message) {
  const errors = { ...message.errors }, state = { ...message, errors };
  // The buttons show where the history ends.
  delete errors.undo;
  delete errors.redo;
  page.state = state;
  memory.set("settings", JSON.stringify(state.settings));
  const rest = controls.update(state);
  $("problem").hidden = !rest.length;
  $("problem").textContent = rest.join(" ");
  $("undo").disabled = !state.can_undo;
  $("redo").disabled = !state.can_redo;
  if (Object.keys(state.errors || {}).length) setBusy(false);
  const canMove = Boolean(gazeKey());
  $("scene").classList.toggle("can-move", canMove);
  $("gaze-note").hidden = !canMove;
  if (state.frozen && page.frozen) page.frozen.summary = state.frozen.summary;
  showSummary();
  editor.update(state);
  steps.update();
  // Frozen by an earlier connection: its arrays are lost.
  if (!state.frozen && page.frozen && page.frozen.isAnswered) unfreeze();
  if (state.frozen && page.frozen) page.frozen.isAnswered = true;
  sources.receive(message);
}

function showSummary() {
  const { summary, warnings } = page.state;
  $("summary").replaceChildren(...summaryRows(summary, page.frozen?.summary));
  $("warnings").replaceChildren(...(warnings || []).map((warning) => make("li", warning)));
}

function hello(message, { isSame }) {
  // A server that was started again counts from the beginning.
  for (const name of Object.keys(page.parts)) page.parts[name].version = -1;
  document.title = (message.name ? message.name + " – " : "") + "foveasim studio";
  controls.describe(message.controls);
  fillPresets(message.presets || []);
  $("save").hidden = !message.can_save;
  for (const { name, label } of (message.views || []).filter((view) => view.label)) {
    const button = document.querySelector(`#tabs button[data-tile="${name}"]`);
    if (button) button.textContent = label;
  }
  const stored = message.is_new ? memory.get("settings") : null;
  sendViews();
  if (stored && isSame) connection.send({ do: "restore", settings: JSON.parse(stored) });
  else if (stored && message.settings && JSON.stringify(message.settings) !== stored) {
    page.offered = JSON.parse(stored);
    $("offer").hidden = false;
  }
  files.openLink(location.hash);
}

function fillPresets(presets) {
  const groups = new Map();
  for (const preset of presets) {
    const { name, label, kind } = preset;
    const option = make("option", (label || name).replaceAll("_", " "));
    option.value = name;
    if (!groups.has(kind || "")) groups.set(kind || "", []);
    groups.get(kind || "").push(option);
  }
  const nodes = [...groups].flatMap(([kind, options]) => {
    if (!kind) return options;
    const group = make("optgroup");
    group.label = { shot: "Shots", layout: "Layouts" }[kind] || kind;
    group.append(...options);
    return [group];
  });
  const first = make("option", "Preset…");
  first.value = "";
  $("preset").replaceChildren(first, ...nodes);
}

function showConnection(status) {
  if (status !== "open") sources.lost();
  document.body.classList.toggle("offline", status !== "open");
  if (status === "open") {
    if (!page.isBusy) showStatus("ready");
    return;
  }
  document.body.classList.remove("busy");
  page.isBusy = false;
  showStatus(status === "lost" ? "reconnecting…" : "no access");
  if (status === "denied") {
    $("problem").hidden = false;
    $("problem").textContent = "The address has no valid token. Open the address that foveasim studio printed.";
  }
}

// Longer side of pictures in pixels of the screen, in a few steps, a little smaller at most; more when they are enlarged.
function pictureSize() {
  const needed = Math.max(...IMAGES.map((name) => panes[name].neededPixels()));
  return PICTURE_SIZES.find((size) => size >= SMALLER * needed) || PICTURE_SIZES[PICTURE_SIZES.length - 1];
}

// Asks for pictures of another size, not for each step of a zoom.
function followSize() {
  if (!connection.isOpen || page.sizeTimer || pictureSize() === page.pixels) return;
  page.sizeTimer = setTimeout(() => { page.sizeTimer = 0; if (pictureSize() !== page.pixels) sendViews(); }, SIZE_DELAY_MS);
}

function sendViews() {
  page.pixels = pictureSize();
  const isWanted = ([name, , part]) => part && (page.tiles.has(name) || (part === "rules" && editor.isOn));
  connection.send({ do: "views", names: [...ALWAYS, ...TILES.filter(isWanted).map(([, , part]) => part), ...solid.parts], pixels: page.pixels });
}

// -- tiles --------------------------------------------------------------------------------------------------------------

function createTiles() {
  let chosen = null;
  try { chosen = JSON.parse(localStorage.getItem("foveasim-studio-tiles")); } catch { /* the first ones */ }
  const known = TILES.map(([name]) => name), first = innerWidth >= WIDE ? known.filter((name) => name !== "solid") : FIRST_TILES;
  page.tiles = new Set(Array.isArray(chosen) ? chosen.filter((name) => known.includes(name)) : first);
  $("tabs").append(...TILES.map(([name, label]) => {
    const button = make("button", label);
    button.type = "button";
    button.dataset.tile = name;
    button.addEventListener("click", () => showTile(name, !page.tiles.has(name)));
    return button;
  }));
  markTiles();
}

function showTile(name, isShown) {
  if (isShown === page.tiles.has(name)) return;
  if (isShown) page.tiles.add(name);
  else page.tiles.delete(name);
  try { localStorage.setItem("foveasim-studio-tiles", JSON.stringify([...page.tiles])); } catch { /* not kept */ }
  markTiles();
  solid.follow(panes.b);
  sendViews();
  resize();
  if (isShown) $("tile-" + name).scrollIntoView({ block: "nearest", inline: "nearest" });
}

function markTiles() {
  for (const [name] of TILES) {
    $("tile-" + name).hidden = !page.tiles.has(name);
    document.querySelector(`#tabs button[data-tile="${name}"]`).setAttribute("aria-pressed", page.tiles.has(name));
  }
}

function drawHistogram() {
  const { b } = panes, site = page.pinned >= 0 ? page.pinned : page.hovered;
  if (b.scale && page.tiles.has("histogram")) charts.histogram.draw(page.range, site >= 0 ? b.column.values[site] : NaN);
}

function drawCharts() {
  drawHistogram();
  for (const name of CURVES) if (page.tiles.has(name)) charts[name].draw();
}

// -- the photosite ------------------------------------------------------------------------------------------------------

function hover(x, y, from, site = panes.b.pick(x, y)) {
  page.cursor = { x, y, from };
  page.hovered = site;
  const { map } = panes.b;
  $("cursor").textContent = map ? "x " + positionText(x, map.scale) + "  y " + positionText(y, map.scale) + " µm" : "";
  tellSite();
  ask("marks");
}

function leave() {
  page.cursor = null;
  page.hovered = -1;
  $("cursor").textContent = "";
  tellSite();
  ask("marks");
}

function tellSite() {
  const { sites, columns } = panes.b, site = page.hovered >= 0 ? page.hovered : page.pinned;
  change($("site-heading"), { textContent: site < 0 || !sites ? "Photosite" : "Photosite " + site.toLocaleString("en-US") + (site === page.pinned ? " (pinned)" : "") });
  if (page.tiles.has("site") && sites) {
    const cells = columns.filter((column) => !column.is_repeat).flatMap((column) => [make("dt", column.label), make("dd", site < 0 ? "–" : textOf(column, site, sites.area))]);
    cells.push(make("dt", "centre / µm"), make("dd", site < 0 ? "–" : sites.centre(site).map((v) => shown(Math.round(1e4 * v) / 1e4 + 0)).join(", ")));
    $("site").replaceChildren(...cells);
  }
  drawHistogram();
  speak(site < 0 || !sites ? null : () => "Photosite " + site + ": " + columns.filter((column) => !column.is_repeat).map((column) => column.label + " " + textOf(column, site, sites.area)).join(", "));
}

function pin(site) {
  page.pinned = site === page.pinned ? -1 : site;
  if (page.pinned >= 0) showTile("site", true);
  tellSite();
  ask("marks");
}

function setRange(range) {
  page.range = range;
  for (const pane of [panes.b, page.frozen && panes.a]) if (pane) pane.paint(range);
  drawHistogram();
  ask("map");
}

// -- navigation -----------------------------------------------------------------------------------------------------------

let flight = 0;

function fly(x, y, scale) {
  const { map } = panes.b;
  if (!map) return;
  const from = { x: map.x, y: map.y, scale: map.scale };
  map.set(x, y, scale);
  const to = { x: map.x, y: map.y, scale: map.scale };
  cancelAnimationFrame(flight);
  ask("map");
  if (reducesMotion.matches) return;
  const start = performance.now(), path = pathBetween(from, to);
  const step = () => {
    const t = clamp((performance.now() - start) / 350, 0, 1), at = t < 1 ? path(t) : to;
    map.set(at.x, at.y, at.scale);
    ask("map");
    if (t < 1) flight = requestAnimationFrame(step);
  };
  step();
}

function fit() { fly(...panes.b.map.middle, panes.b.map.fitScale()); }

function flyToViolation(i) {
  const { map, sites } = panes.b, { violations } = rules, [a, b, c, d] = violations.boxes.subarray(4 * i, 4 * i + 4);
  if (!Number.isFinite(a)) { notice("This violation has no position"); return; }
  fly(0.5 * (a + c), 0.5 * (b + d), (0.3 * Math.min(map.width, map.height)) / (violations.widthOf(i, sites) || 1));
}

// -- selection --------------------------------------------------------------------------------------------------------------

function useSelection(isOn) {
  page.isSelecting = isOn;
  $("select").setAttribute("aria-pressed", isOn);
  if (isOn) notice("Drag on the photosites to select some of them");
}

function select(rectangle) {
  page.rectangle = rectangle;
  page.selected = rectangle ? panes.b.sitesIn(rectangle) : [];
  if (rectangle) showTile("selection", true);
  editor.follow(page.selected);
  showSelection();
  ask("marks");
}

function selectSites(sites) {
  page.rectangle = null;
  page.selected = sites;
  editor.follow(sites);
  showSelection();
  ask("marks");
}

function showSelection() {
  const { selected } = page, rectangle = page.rectangle || selected.length > 0;
  $("selection-heading").textContent = rectangle ? "Selection: " + shown(selected.length) + " photosites" : "Selection";
  $("selection-note").hidden = Boolean(rectangle);
  $("export").disabled = !selected.length;
  $("clear-selection").disabled = !rectangle;
  $("selection").replaceChildren(...(selected.length ? statisticsRows(panes.b.columns, selected) : []));
}

// -- gaze -------------------------------------------------------------------------------------------------------------------

function gazeKey() {
  if (!page.state) return null;
  for (const row of controls.rows.values()) if (/(^|\.)move_um$/.test(row.control.key)) return row.control.key;
  return null;
}

// Moves the layout by a distance from its position at the start of the drag.
function gaze(dx, dy, isFinal) {
  const key = gazeKey(), { map } = panes.b;
  if (!key) return;
  page.gazeAt = page.gazeAt || valueAt(page.state.settings, key) || [0, 0];
  const digits = clamp(Math.ceil(Math.log10(map ? map.scale : 1)) + 1, 1, 4), [x, y] = page.gazeAt;
  connection.set(key, [x + dx, y + dy].map((v) => Number(v.toFixed(digits))), isFinal);
  if (isFinal) page.gazeAt = null;
  ask("marks");
}

// -- A and B ----------------------------------------------------------------------------------------------------------------

function freeze() {
  if (!panes.b.sites || !page.state) return;
  page.frozen = { isAnswered: false, isKept: false };
  $("map-a").hidden = $("picture-a").hidden = false;
  document.body.classList.add("compares");
  $("freeze").setAttribute("aria-pressed", "true");
  keepVariant();
  page.frozen.id = connection.send({ do: "freeze" });
  showTile("comparison", true);
  showVariants();
}

// Keeps what is shown as A: at the click, and again when the server has frozen its result, which may be newer.
function keepVariant() {
  const { b, a } = panes, { picture } = page.parts;
  Object.assign(page.frozen, { sites: b.sites, columns: b.columns, filterOf: b.filterOf, parts: { ...page.parts }, summary: page.state.summary });
  if (a.sites !== b.sites) a.useSites(b.sites, b.palette);
  a.useColumns(b.columns, b.filterOf);
  if (picture) panes.pictureA.use(picture.about, picture.arrays.rgba);
}

function unfreeze() {
  page.frozen = null;
  showTable(null);
  $("map-a").hidden = $("picture-a").hidden = true;
  document.body.classList.remove("compares");
  $("freeze").setAttribute("aria-pressed", "false");
  showVariants();
}

function showVariants() {
  for (const pane of [panes.b, panes.a]) pane.resize();
  recolour();
  showSummary();
  showNoise();
  for (const name of CURVES) showCurves(name);
  ask("map");
}

const showTable = (about) => showComparison({ table: $("comparison"), note: $("comparison-note"), button: $("match") }, about);

// -- keys and buttons -------------------------------------------------------------------------------------------------------

function listenToButtons() {
  for (const name of ["undo", "redo"]) $(name).addEventListener("click", () => connection.send({ do: name }));
  $("preset").addEventListener("change", () => {
    if ($("preset").value) connection.send({ do: "preset", name: $("preset").value });
    $("preset").value = "";
  });
  $("freeze").addEventListener("click", () => {
    if (!page.frozen) freeze();
    else { connection.send({ do: "unfreeze" }); unfreeze(); }
  });
  $("panel").addEventListener("click", () => {
    const isHidden = document.body.classList.toggle("no-panel");
    $("panel").setAttribute("aria-pressed", !isHidden);
  });
  $("restore").addEventListener("click", () => { connection.send({ do: "restore", settings: page.offered }); $("offer").hidden = true; });
  $("dismiss").addEventListener("click", () => { $("offer").hidden = true; });
  $("colouring").addEventListener("change", () => { page.key = $("colouring").value; page.range = null; page.wantsLog = undefined; recolour(); ask("map"); });
  $("log").addEventListener("change", () => { page.wantsLog = $("log").checked; recolour(); ask("map"); });
  $("nearer").addEventListener("click", () => fly(panes.b.map.x, panes.b.map.y, 2 * panes.b.map.scale));
  $("farther").addEventListener("click", () => fly(panes.b.map.x, panes.b.map.y, 0.5 * panes.b.map.scale));
  $("fit").addEventListener("click", fit);
  $("select").addEventListener("click", () => useSelection(!page.isSelecting));
  $("export").addEventListener("click", () => downloadTable(panes.b.sites, panes.b.columns, page.selected, "studio"));
  $("clear-selection").addEventListener("click", () => select(null));
  for (const [name, chosen] of [["picture", [panes.picture, panes.pictureA]], ["scene", [panes.scene]]]) {
    $("follow-" + name).addEventListener("click", () => {
      const isOn = $("follow-" + name).getAttribute("aria-pressed") !== "true";
      $("follow-" + name).setAttribute("aria-pressed", isOn);
      for (const pane of chosen) pane.follows = isOn;
      ask("map");
    });
  }
  $("help").addEventListener("click", () => $("keys").showModal());
  $("match").addEventListener("click", () => connection.send({ do: "match" }));
}

function listenToKeys() {
  document.addEventListener("keydown", (event) => {
    const isOpen = document.querySelector("dialog[open]"), { key } = event;
    if (!isOpen && !event.target.closest?.("input[type='text'], select, .menu") && editor.key(event)) { event.preventDefault(); return; }
    if ((event.ctrlKey || event.metaKey) && !event.altKey && !isOpen) {
      const isRedo = (key.toLowerCase() === "z" && event.shiftKey) || key.toLowerCase() === "y";
      // A text that is being typed has its own undo.
      const isTyped = event.target.matches?.("input[type='text']") && (event.target.id === "search" || [...controls.rows.values()].some((row) => row.field === event.target && row.isDirty));
      if ((key.toLowerCase() !== "z" && !isRedo) || isTyped) return;
      event.preventDefault();
      if (!$(isRedo ? "redo" : "undo").disabled) connection.send({ do: isRedo ? "redo" : "undo" });
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (key === "?" && !event.target.matches?.("input[type='text']")) { isOpen ? $("keys").close() : $("keys").showModal(); event.preventDefault(); return; }
    if (isOpen || event.target.closest?.("input[type='text'], select, .menu") || !panes.b.map) return;
    const { map } = panes.b, onMap = event.target === panes.b.marks || event.target === panes.a.marks;
    if (key === "/") { document.body.classList.remove("no-panel"); $("panel").setAttribute("aria-pressed", "true"); $("search").focus(); event.preventDefault(); }
    else if (key === "+" || key === "=") { map.zoom(1.4, 0.5 * map.width, 0.5 * map.height); ask("map"); }
    else if (key === "-" || key === "_") { map.zoom(1 / 1.4, 0.5 * map.width, 0.5 * map.height); ask("map"); }
    else if (key === "0") fit();
    else if (key === "s" || key === "S") useSelection(!page.isSelecting);
    else if (key === "Escape") { useSelection(false); select(null); page.pinned = -1; rules.choose(null); if (page.range) setRange(null); tellSite(); ask("map"); }
    if (!onMap) return;
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
    if (move) { map.set(map.x + (60 / map.scale) * move[0], map.y + (60 / map.scale) * move[1], map.scale); ask("map"); }
    else if (key === "Enter" || key === " ") { hover(map.x, map.y, null); pin(page.hovered); } else return;
    hover(map.x, map.y, null);
    event.preventDefault();
  });
}

// -- editor -------------------------------------------------------------------------------------------------------------------

function createEditor() {
  editor = new Editor(panes.b, $("pane-sites"), $("edit"), {
    settings: () => page.state?.settings, summary: () => page.state?.summary, selected: () => page.selected, select: selectSites,
    send: (key, value, isFinal) => connection.set(key, value, isFinal),
    remove: (key) => connection.remove(key),
    undo: () => connection.send({ do: "undo" }),
    redraw: (what = "marks") => ask(what),
    hover: (x, y) => hover(x, y, panes.b),
    generators: () => (controls.rows.get("layout")?.choices || []).filter(({ value }) => value?.generator),
    violations: () => rules.violations,
    nViolations: () => rules.rules.reduce((sum, { count }) => sum + count, 0),
    opened: (isOn) => { if (isOn) showTile("steps", true); sendViews(); resize(); },
    showRules: () => showTile("rules", true),
    showSteps: (index) => { showTile("steps", true); steps.open(index); },
  });
  steps = new Steps($("steps"), editor, flyToStep);
}

function flyToStep(index) {
  const { map } = panes.b, box = index === null ? null : editor.boxOf(editor.edits[index]);
  editor.toggle(true);
  editor.highlight(index);
  if (index === null || !map) return;
  if (!box) { fit(); return; }
  const [a, b, c, d] = box, size = Math.max(c - a, d - b);
  fly(0.5 * (a + c), 0.5 * (b + d), size > 0 ? (0.4 * Math.min(map.width, map.height)) / size : map.scale);
}

// -- start --------------------------------------------------------------------------------------------------------------------

// Redraws everything in the colours of the theme.
function showTheme() {
  if (!panes) return;
  for (const pane of [panes.b, panes.a]) if (pane.scale) pane.paint(page.range);
  drawCharts();
  ask("map");
}

function chosenRenderer() {
  // "raster" in the storage of this address draws maps without WebGL, "webgl" also with software rendering.
  let wanted = null;
  try { wanted = localStorage.getItem("foveasim-studio-map"); } catch { /* the default */ }
  const renderer = wanted === "raster" ? null : findRenderer();
  return renderer && wanted === "webgl" ? { isSlow: false } : renderer;
}

function start() {
  const renderer = chosenRenderer();
  useSoftware(!renderer || renderer.isSlow);
  const onMap = {
    isSelecting: () => page.isSelecting,
    select,
    moved: (pane) => { cancelAnimationFrame(flight); if (pane === panes.a) panes.b.follow(panes.a); ask("map"); },
    hover, leave,
    click: (pane) => { if (pane === panes.b && !page.isSelecting && !editor.isOn) pin(page.hovered); },
  };
  const onImage = { hover, leave, click: (x, y) => { if (panes.b.map) fly(x, y, Math.max(panes.b.map.scale, 4 * panes.b.map.fitScale())); }, gaze };
  panes = {
    b: new SitePane($("map"), onMap, { renderer, label: "Map of the photosites. Arrow keys pan, plus and minus zoom, Enter pins the photosite in the centre, 0 shows all." }),
    a: new SitePane($("map-a"), onMap, { renderer, label: "Map of the photosites of variant A" }),
    picture: new ImagePane($("picture"), onImage, { label: "Reconstructed picture" }),
    pictureA: new ImagePane($("picture-a"), onImage, { label: "Reconstructed picture of variant A" }),
    scene: new ImagePane($("scene"), onImage, { label: "Optical image with the outline of the layout. Arrow keys move the gaze.", canMove: () => Boolean(gazeKey()) }),
  };
  panes.picture.follows = panes.pictureA.follows = true;
  for (const pane of [panes.picture, panes.pictureA, panes.scene]) Object.defineProperty(pane, "map", { get: () => panes.b.map });
  charts = {
    histogram: new Histogram($("histogram"), setRange),
    spectrum: new CurveChart($("spectrum"), { nameX: "wavelength", nameY: "response", label: "Spectral response" }),
    mtf: new CurveChart($("mtf"), { nameX: "spatial frequency", nameY: "MTF", label: "Modulation transfer" }),
    photon_transfer: new CurveChart($("photon_transfer"), { nameX: "mean signal", nameY: "noise", label: "Photon transfer", log: "xy" }),
    snr: new CurveChart($("snr"), { nameX: "exposure", nameY: "SNR", label: "Signal-to-noise ratio", log: "x" }),
  };
  solid = new SolidPane({ hover, leave, click: (site) => { if (site >= 0) pin(site); }, changed: () => sendViews() });
  rules = new RulesList($("rules"), flyToViolation);
  panes.b.drawViolations = (context, map) => rules.draw(context, map, panes.b.sites);
  panes.b.violations = () => [page.parts.rules?.version, rules.rule, rules.chosen];
  rules.select.addEventListener("change", () => ask("map"));
  controls = new Controls($("sections"), $("search"), $("only-changed"), {
    send: (key, value, isFinal) => connection.set(key, value, isFinal),
    reset: (key) => connection.send({ do: "reset", key }),
    remove: (key) => connection.send({ do: "delete", key }),
  });
  createEditor();
  sources = new Sources($("pane-scene"), {
    connection: () => connection, state: () => page.state, choose: () => $("chosen-file").click(),
    charts: () => [...controls.rows.values()].find((row) => row.control.key === "scene" && row.control.kind === "choice")?.control.choices || [],
  });
  connection = new Connection({ hello, message: receive, part: receivePart, status: showConnection });
  files = new Files(connection, {
    busy: (text) => { setBusy(text !== null); showStatus(text ?? "ready"); },
    dropped: (transfer) => sources.dropped(transfer),
  });
  createTiles();
  startTheme(showTheme);
  listenToButtons();
  listenToKeys();
  listenToDialogs();
  for (const element of [$("map"), $("map-a"), $("picture"), $("scene"), $("tiles")]) watchSize(element, resize);
  connection.open();
}

start();

// For tests and scripts.
window.studio = {
  page, panes, controls, connection, charts, rules, editor, steps, sources, solid,
  get state() { return page.state; },
  get isReady() { return Boolean(page.state && panes.b.scale && !page.isBusy && connection.isOpen && connection.waiting === null && page.asked === null); },
  toWindow: (x, y, pane = "b") => {
    const canvas = panes[pane].marks, box = canvas.getBoundingClientRect(), view = panes[pane].view ? panes[pane].view() : panes[pane].map;
    return [box.left + view.toX(x), box.top + view.toY(y)];
  },
  ink: inkOf, offsetsOf,
};
