// The studio: controls, views and the server, which computes all data.

import { clamp } from "/web/colours.js";
import { findRenderer, watchSize } from "/web/gl.js";
import { positionText } from "/web/marks.js";
import { $, around, change, endProblem, inkOf, notice, speak, startTheme } from "/web/page_parts.js";
import { drawScaleBar, flyTo, panByKey, spokenSite, stopFlight, zoomByKey } from "/web/shell.js";
import { offsetsOf } from "/web/unpack.js";
import { Editor } from "./authoring.js";
import { Connection } from "./connection.js";
import { Controls, valueAt } from "./controls.js";
import { Files } from "./files.js";
import { Transport } from "./film_row.js";
import { inNextFrame } from "./frames.js";
import { GazePanel } from "./gaze_panel.js";
import { ImagePane } from "./image_pane.js";
import { stateOf } from "./links.js";
import { lasting, memory } from "./memory.js";
import { listenToDialogs } from "./menus.js";
import { load } from "./modules.js";
import { awaited, isPending } from "./pending.js";
import { Problems } from "./problems.js";
import { SitePane, useSoftware } from "./site_pane.js";
import { Sources } from "./sources.js";
import { showRows, startSplitters } from "./splitters.js";
import { Views } from "./views.js";

const BUSY_DELAY_MS = 150, LONG_MS = 1000;
const SIZE_DELAY_MS = 250;
const HOLD_MS = 100;
// Time after which values that are no longer shown are not requested.
const SIGNALS_MS = 2000;
const MOST_KEPT = 6;
const PICTURE_SIZES = [256, 320, 384, 512, 768, 1024], SMALLER = 0.85;

// Variant A: whether the server has answered, whether its result is kept, the number of its message, and what it showed.
/** @typedef {{ isAnswered: boolean, isKept: boolean, id?: number | null, summary?: Summary } & Partial<Kept>} Frozen */
/** @typedef {{ sites: Sites, columns: Column[], filterOf: Numbers | null, parts: { [name: string]: Part } }} Kept */

class StudioPage {
  /** @type {State | null} */ state = null;
  // Settings of an earlier session that the page offers to restore.
  /** @type {Settings | undefined} */ offered;
  /** @type {Frozen | null} */ frozen = null;
  /** @type {Cursor | null} */ cursor = null;
  /** @type {Rectangle | null} */ rectangle = null;
  /** @type {number[]} */ selected = [];
  // Photosites that charts compare.
  /** @type {number[]} */ kept = [];
  hasShift = false;
  /** @type {Interval | null} */ range = null;
  /** @type {boolean | undefined} */ wantsLog = undefined;
  // Names of the panes that the next frame draws.
  /** @type {Set<PaneName> | null} */ asked = null;
  // Messages that are shown together.
  /** @type {{ states: State[], parts: Part[] }} */ held = { states: [], parts: [] };
  // The sweep of the session with its results so far.
  /** @type {SweepMessage | null} */ sweep = null;
  // Position of the layout at the start of a drag.
  /** @type {Point | null} */ gazeAt = null;
  /** @type {Boundary | null} */ boundary = null;
  key = ""; stage = ""; longTimer = 0; hovered = -1; pinned = -1; isSelecting = false;
  sizeTimer = 0; signalsTimer = 0; holdTimer = 0; busyTimer = 0; drawnAt = 0;
}

const page = new StudioPage();
/** @type {Connection} */
let connection;
/** @type {Controls} */
let controls;
/** @type {{ a: SitePane, b: SitePane, picture: ImagePane, pictureA: ImagePane, scene: ImagePane }} */
let panes;
/** @type {Editor} */
let editor;
/** @type {Sources} */
let sources;
/** @type {GazePanel} */
let gazePanel;
/** @type {Files} */
let files;
/** @type {Views} */
let views;
/** @type {Problems} */
let problems;

// -- drawing ------------------------------------------------------------------------------------------------------------

/** @type {("a" | "b")[]} */
const MAPS = ["b", "a"];
/** @type {("picture" | "pictureA" | "scene")[]} */
const IMAGES = ["picture", "pictureA", "scene"];
/** @typedef {"a" | "b" | "picture" | "pictureA" | "scene"} PaneName */
/** @type {{ [name: string]: PaneName[] }} */
const GROUPS = { map: [...MAPS, ...IMAGES], maps: MAPS, marks: [] };

// Draws panes in the next frame: "map" for all, "maps", "marks" for none, or one by its name. All marks are drawn in every frame.
/** @param {"map" | "maps" | "marks" | PaneName} what */
function ask(what) {
  const isAsked = page.asked !== null;
  const asked = page.asked ||= new Set();
  if (what === "map" || what === "maps" || what === "marks") for (const name of GROUPS[what]) asked.add(name);
  else asked.add(what);
  if (!isAsked) inNextFrame(drawAsked);
}

function drawAsked() {
  const { asked } = page, { b } = panes;
  if (!asked) return;
  page.asked = null;
  if (page.frozen) panes.a.follow(b);
  for (const name of asked) panes[name].draw();
  if (asked.has("b")) {
    views.tell("onMap");
    if (b.map) drawScaleBar($("scale-bar"), b.map);
    page.drawnAt = performance.now();
  }
  drawMarks();
  editor.draw();
  followSize();
}

function drawMarks() {
  const { cursor, rectangle, selected, pinned, hovered, kept } = page, { a, b } = panes;
  if (b.isShown) b.drawMarks({ cursor, hovered, pinned, kept, rectangle, selected, trace: b.trace() });
  if (page.frozen && a.isShown) {
    const hoveredA = cursor ? a.pick(cursor.x, cursor.y) : -1, pinnedA = page.frozen.sites === b.sites ? pinned : -1;
    a.drawMarks({ cursor, hovered: hoveredA, pinned: pinnedA, rectangle, selected: [], trace: null });
  }
  for (const name of IMAGES) panes[name].drawMarks({ cursor, map: b.map, boundary: page.boundary });
  views.tell("onMarks", { cursor, hovered, pinned });
}

function paint() { for (const pane of [panes.b, panes.a]) if (pane.scale && pane.map) pane.paint(page.range); }

function resize() {
  showRows();
  for (const name of MAPS) panes[name].resize();
  views.tell("draw");
  paint();
  ask("map");
}

// Colours both maps by the chosen column, with a common scale.
function recolour() {
  const { a, b } = panes, { wantsLog } = page;
  if (!b.columns.length || !b.map) return;
  // Values that follow.
  if (!b.columnOf(page.key).values) return;
  const other = page.frozen && a.columns.find((column) => column.key === page.key && column.values);
  b.colourBy(page.key, { wantsLog, alsoValues: other?.values });
  if (page.frozen) a.colourBy(other ? page.key : "", { wantsLog, alsoValues: other ? b.column.values : null });
  paint();
  $("log-label").hidden = !b.scale?.canLog;
  $("log").checked = Boolean(b.scale?.isLog);
  views.tell("onValues");
  tellSite();
}

// -- messages of the server -----------------------------------------------------------------------------------------------

// A state is shown with the values that follow it, and parts of a group together: each frame takes the browser tens of milliseconds.
/** @param {Part} part */
function receivePart(part) {
  // While the server computes the values.
  views.prepare(part);
  hold(page.held.parts, part);
  if (!part.hasMore) showHeld();
}

/** @type {<T>(messages: T[], message: T) => void} */
function hold(messages, message) {
  messages.push(message);
  page.holdTimer ||= setTimeout(showHeld, HOLD_MS);
}

function showHeld() {
  clearTimeout(page.holdTimer);
  page.holdTimer = 0;
  const { states, parts } = page.held;
  page.held = { states: [], parts: [] };
  for (const state of states) showState(state);
  for (const part of parts) {
    views.use(part);
    if (part.isAwaited) connection.drawn(part.version);
  }
  if (page.state) problems.update(page.state, views.parts);
}

/** @param {ServerMessage} message @param {{ isFailed: boolean }} about */
function receive(message, { isFailed }) {
  const { kind } = message, { requests } = connection;
  if (kind !== "state" && kind !== "busy") showHeld();
  if (kind === "state") {
    hold(page.held.states, message);
    if (isFailed && requests.waiting.some((one) => one.id === message.id)) notice(Object.values(message.errors)[0], true);
    else if (!isFailed) endProblem();
  } else if (kind === "controls") controls.describe(message.controls);
  else if (kind === "done") finish(message);
  else if (kind === "error") { notice(message.text, true); views.made.sweep?.fail(message); }
  else if (kind === "text") awaited(files.receiveText(message));
  else if (kind === "gaze_path") gazePanel.usePath(message);
  else if (kind === "film_times") { sources.timesS = message.times_s; gazePanel.useTimes(message.times_s); }
  else if (kind === "saved") notice("Saved as " + message.path);
  else if (kind === "sought") views.show("goal", true).then(() => views.made.goal?.show(message));
  else if (kind === "sweep") showSweep(message);
  else if (kind === "repair") views.made.rules?.dialog.show(message);
  else if (kind === "exists") files.askToReplace(message);
  else if (kind === "note") notice(message.text);
  else if (kind === "progress") { showStage(message.text); return; }
  // After the state only views follow, which cannot be cancelled.
  if (kind === "busy" || kind === "state") showStage("", kind === "busy");
  showBusy(requests.isBusy);
}

// Work of more than a second shows its stage, and can be cancelled.
/** @param {string} text */
function showStage(text, canCancel = true) {
  page.stage = text;
  if (!canCancel) { clearTimeout(page.longTimer); page.longTimer = 0; $("cancel").hidden = true; }
  else if (!$("cancel").hidden) showStatus(text + "…");
  else page.longTimer ||= setTimeout(() => {
    page.longTimer = 0;
    if (!connection.requests.isBusy) return;
    $("cancel").hidden = false;
    showStatus((page.stage || "computing") + "…");
  }, LONG_MS);
}

/** @param {boolean} isBusy */
function showBusy(isBusy) {
  if (!isBusy) showStage("", false);
  clearTimeout(page.busyTimer);
  // Short work is not announced: each change of the page costs a frame.
  const show = () => { document.body.classList.add("busy"); showStatus("computing…"); };
  if (isBusy) page.busyTimer = setTimeout(show, BUSY_DELAY_MS);
  else document.body.classList.remove("busy");
}

/** @param {string} text */
function showStatus(text) { change($("status").lastElementChild, { textContent: text }); }

/** @param {Done} message */
function finish(message) {
  const { frozen } = page, { requests } = connection, id = message.id ?? 0;
  editor.finish();
  if (frozen && !frozen.isKept && id >= (frozen.id ?? 0)) {
    frozen.isKept = true;
    keepVariant(frozen);
    recolour();
  }
  // The time to the frame that shows the result.
  const showTime = () => {
    requests.show(id);
    const time = Number.isFinite(requests.lastMs) ? Math.round(requests.lastMs) + " ms" : "ready";
    showStatus((requests.isPreview ? "preview, " : "") + time);
  };
  if (document.hidden) showTime();
  else inNextFrame(showTime);
}

/** @param {State} message */
function showState(message) {
  const errors = { ...message.errors }, state = { ...message, errors }, { frozen } = page;
  // The buttons show where the history ends.
  delete errors.undo;
  delete errors.redo;
  for (const note of state.notes) if (!page.state?.notes.includes(note)) notice(note);
  page.state = state;
  memory.set("settings", JSON.stringify(state.settings));
  const rest = controls.update(state);
  $("problem").hidden = !rest.length;
  $("problem").textContent = rest.join(" ");
  $("undo").disabled = !state.can_undo;
  $("redo").disabled = !state.can_redo;
  $("scene").classList.add("can-move");
  $("gaze-note").hidden = false;
  if (state.frozen && frozen) frozen.summary = state.frozen.summary;
  editor.update(state);
  views.tell("onState");
  // Frozen by an earlier connection: its arrays are lost.
  if (!state.frozen && frozen?.isAnswered) unfreeze();
  if (state.frozen && frozen) frozen.isAnswered = true;
  sources.use(message);
  gazePanel.use(message);
}

/** @param {SweepMessage} message */
function showSweep(message) {
  page.sweep = message;
  views.made.sweep?.show(message);
}

/** @param {Hello} message @param {{ isSame: boolean, isContinued: boolean }} about */
function hello(message, { isSame, isContinued }) {
  document.title = (message.name ? message.name + " – " : "") + "foveasim studio";
  controls.describe(message.controls);
  controls.forgetSent();
  fillPresets(message.presets);
  $("save").hidden = !message.can_save;
  views.describe(message.views);
  followSignals();
  const stored = message.is_new ? memory.get("settings") : null;
  // Another session does not have the sweep of the one before.
  if (page.sweep && !isContinued) {
    const { state } = page.sweep;
    showSweep({ ...page.sweep, state: state === "running" ? "lost" : state, isLost: true });
  }
  sendViews();
  if (page.kept.length) connection.send({ do: "pin", sites: page.kept });
  const compared = JSON.parse(memory.get("compared") || "[]");
  if (compared.length) connection.send({ do: "compare", variants: compared });
  if (stored && isSame) connection.send({ do: "restore", settings: JSON.parse(stored) });
  else if (stored && message.settings && JSON.stringify(message.settings) !== stored) {
    page.offered = JSON.parse(stored);
    $("offer").hidden = false;
  }
  if (message.shows_start_page && message.is_new && !stored && stateOf(location.hash) === null) openStart({ isAtStart: true });
  awaited(files.openLink(location.hash));
}

/** @type {Promise<import("./start_page.js").StartPage> | null} */
let startPage = null;

// Shows the start page, whose module is loaded when it is first shown.
async function openStart(options = {}) {
  startPage ||= load("./start_page.js").then(({ StartPage }) => new StartPage(connection, () => page.held.states.at(-1) || page.state));
  const shown = await startPage.catch(() => null);
  if (shown) await shown.open(options);
  else {
    startPage = null;
    notice("The start page cannot be shown: the server does not answer");
  }
}

/** @param {Preset[]} presets */
function fillPresets(presets) {
  const kinds = [...new Set(presets.map(({ kind }) => kind || ""))], nodes = kinds.flatMap((wanted) => {
    const members = presets.filter(({ kind }) => (kind || "") === wanted);
    const options = members.map(({ name, label }) => new Option((label || name).replaceAll("_", " "), name));
    if (!wanted) return options;
    return [around("optgroup", { label: wanted === "shot" ? "Shots" : wanted === "layout" ? "Layouts" : wanted }, ...options)];
  });
  $("preset").replaceChildren(new Option("Preset…", ""), ...nodes);
}

/** @param {"open" | "lost" | "denied"} status */
function showConnection(status) {
  const isOpen = status === "open";
  if (!isOpen) { sources.lost(); gazePanel.lost(); }
  document.body.classList.toggle("offline", !isOpen);
  if (isOpen) {
    if (!connection.requests.isBusy) showStatus("ready");
    return;
  }
  showBusy(false);
  showStatus(status === "lost" ? "reconnecting…" : "no access");
  if (status === "denied") {
    $("problem").hidden = false;
    $("problem").textContent = "The address has no valid token. Open the address that foveasim studio printed.";
  }
}

// A change that the server does not answer is not shown as done.
/** @param {boolean} isSilent */
function showSilence(isSilent) {
  document.body.classList.toggle("silent", isSilent);
  if (isSilent) showStatus("waiting for the server…");
  else if (connection.isOpen && !connection.requests.isBusy) showStatus("ready");
}

// Longer side of pictures in pixels of the screen, in a few steps, a little smaller at most; more when they are enlarged.
function pictureSize() {
  const needed = Math.max(...IMAGES.map((name) => panes[name].neededPixels()));
  return PICTURE_SIZES.find((size) => size >= SMALLER * needed) || PICTURE_SIZES[PICTURE_SIZES.length - 1];
}

// Asks for pictures of another size, not for each step of a zoom.
function followSize() {
  if (!connection.isOpen || page.sizeTimer || pictureSize() === connection.requests.pixels) return;
  page.sizeTimer = setTimeout(() => { page.sizeTimer = 0; sendViews(); }, SIZE_DELAY_MS);
}

function sendViews() { connection.askFor(views.wanted, pictureSize()); }

// Asks for the signals of the photosites while they are shown, and for some time after that.
function followSignals() {
  const { needed } = views, isShown = page.hovered >= 0 || page.pinned >= 0 || page.selected.length > 0 || page.frozen !== null
    || views.shown.has("site") || Boolean(panes.b.columns.find(({ key }) => key === page.key)?.is_signal);
  if (isShown) {
    clearTimeout(page.signalsTimer);
    page.signalsTimer = 0;
    if (!needed.has("signals")) views.need("signals", true);
  } else if (needed.has("signals") && !page.signalsTimer) {
    page.signalsTimer = setTimeout(() => { page.signalsTimer = 0; views.need("signals", false); }, SIGNALS_MS);
  }
}

// -- the photosite ------------------------------------------------------------------------------------------------------

function hover(x, y, from, site = panes.b.pick(x, y)) {
  const { map } = panes.b;
  page.cursor = { x, y, from };
  page.hovered = site;
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
  followSignals();
  views.tell("onSite");
  speak(site < 0 || !sites ? null : () => spokenSite(columns, site, sites.area));
}

/** @param {number} site */
function pin(site) {
  page.pinned = site === page.pinned ? -1 : site;
  if (page.pinned >= 0) views.show("site", true);
  tellSite();
  ask("marks");
}

// Adds a photosite to those that charts compare, or removes it.
/** @param {number} site */
function keep(site) {
  if (site < 0) return;
  const kept = page.kept.includes(site) ? page.kept.filter((one) => one !== site) : [...page.kept, site];
  if (kept.length > MOST_KEPT) notice("Charts compare at most " + MOST_KEPT + " photosites");
  else keepOnly(kept);
}

/** @param {number[]} kept */
function keepOnly(kept) {
  page.kept = kept;
  connection.send({ do: "pin", sites: kept });
  tellSite();
  ask("marks");
}

/** @param {Interval | null} range */
function setRange(range) {
  page.range = range;
  paint();
  views.tell("onSite");
  ask("map");
}

// -- navigation -----------------------------------------------------------------------------------------------------------

/** @param {number} x @param {number} y @param {number} scale */
function fly(x, y, scale) { if (panes.b.map) flyTo(panes.b.map, [x, y, scale], () => ask("map")); }

/** @param {number} factor */
function zoomBy(factor) {
  const { map } = panes.b;
  if (map) fly(map.x, map.y, factor * map.scale);
}

function fit() {
  const { map } = panes.b;
  if (map) fly(...map.middle, map.fitScale());
}

// -- selection --------------------------------------------------------------------------------------------------------------

/** @param {boolean} isOn */
function useSelection(isOn) {
  page.isSelecting = isOn;
  $("select").setAttribute("aria-pressed", String(isOn));
  if (isOn) notice("Drag on the photosites to select some of them");
}

// Selects the sites in a rectangle, or given ones.
function select(rectangle, sites = rectangle ? panes.b.sitesIn(rectangle) : []) {
  page.rectangle = rectangle;
  page.selected = sites;
  if (rectangle) views.show("selection", true);
  editor.follow(page.selected);
  followSignals();
  showSelection();
  ask("marks");
}

function showSelection() { views.tell("onSelection"); }

// -- gaze -------------------------------------------------------------------------------------------------------------------

// Moves the gaze by a distance from that at the start of the drag, or from the newest one, which may not be answered yet.
/** @param {number} dx @param {number} dy @param {boolean} isFinal */
function gaze(dx, dy, isFinal) {
  const key = "gaze_um", { map } = panes.b;
  /** @type {Point} */
  const from = page.gazeAt || gazePanel.recordedAt || connection.pending(key) || valueAt(page.state?.settings, key) || [0, 0];
  page.gazeAt = from;
  const digits = clamp(Math.ceil(Math.log10(map ? map.scale : 1)) + 1, 1, 4), [x, y] = from;
  const rounded = (/** @type {number} */ v) => Number(v.toFixed(digits));
  /** @type {Point} */
  const to = [rounded(x + dx), rounded(y + dy)];
  connection.set(key, to, !gazePanel.moved(to) && isFinal);
  if (isFinal) page.gazeAt = null;
  ask("marks");
}

// -- A and B ----------------------------------------------------------------------------------------------------------------

// Keeps the present state, or a named variant, as A.
/** @param {string} [variant] */
function freeze(variant) {
  if (!panes.b.sites || !page.state) return;
  page.frozen = { isAnswered: false, isKept: false };
  keepVariant(page.frozen);
  followSignals();
  page.frozen.id = connection.send({ do: "freeze", variant });
  views.show("comparison", true);
  showVariants();
}

// Keeps what is shown as A: at the click, and again when the server has frozen its result, which may be newer.
/** @param {Frozen} frozen */
function keepVariant(frozen) {
  const { b, a } = panes, { sites, columns, filterOf } = b, { picture } = views.parts;
  Object.assign(frozen, { sites, columns, filterOf, parts: { ...views.parts }, summary: page.state?.summary });
  if (a.sites !== sites) a.useSites(sites, b.palette);
  a.useColumns(columns, filterOf);
  if (picture) panes.pictureA.use(picture.about, picture.arrays.rgba);
}

// Compares named variants with the present state.
/** @param {string[]} variants */
function compare(variants) {
  memory.set("compared", JSON.stringify(variants));
  connection.send({ do: "compare", variants });
}

function unfreeze() {
  page.frozen = null;
  followSignals();
  showVariants();
}

function showVariants() {
  const isFrozen = Boolean(page.frozen);
  $("map-a").hidden = $("picture-a").hidden = !isFrozen;
  document.body.classList.toggle("compares", isFrozen);
  $("freeze").setAttribute("aria-pressed", String(isFrozen));
  for (const name of MAPS) panes[name].resize();
  panes.b.compareWith(isFrozen ? panes.a : null);
  panes.a.compareWith(isFrozen ? panes.b : null);
  recolour();
  views.refresh();
  ask("map");
}

// -- keys and buttons -------------------------------------------------------------------------------------------------------

function listenToButtons() {
  const press = (id, act) => $(id).addEventListener("click", act);
  const toggle = (id) => {
    const isOn = $(id).getAttribute("aria-pressed") !== "true";
    $(id).setAttribute("aria-pressed", String(isOn));
    return isOn;
  };
  press("undo", () => connection.send({ do: "undo" }));
  press("redo", () => connection.send({ do: "redo" }));
  $("preset").addEventListener("change", () => {
    if ($("preset").value) connection.send({ do: "preset", name: $("preset").value });
    $("preset").value = "";
  });
  press("cancel", () => { connection.cancel(); $("cancel").hidden = true; showStatus("stopping after: " + page.stage); });
  press("freeze", () => {
    if (!page.frozen) freeze();
    else { connection.send({ do: "unfreeze" }); unfreeze(); }
  });
  press("panel", () => document.body.classList.toggle("no-panel", !toggle("panel")));
  press("restore", () => { connection.send({ do: "restore", settings: page.offered }); $("offer").hidden = true; });
  press("dismiss", () => { $("offer").hidden = true; });
  $("colouring").addEventListener("change", () => {
    Object.assign(page, { key: $("colouring").value, range: null, wantsLog: undefined });
    followSignals();
    recolour();
    ask("map");
  });
  $("log").addEventListener("change", () => { page.wantsLog = $("log").checked; recolour(); ask("map"); });
  press("nearer", () => zoomBy(2));
  press("farther", () => zoomBy(0.5));
  press("fit", fit);
  press("select", () => useSelection(!page.isSelecting));
  for (const [id, ...chosen] of /** @type {const} */ ([["follow-picture", panes.picture, panes.pictureA], ["follow-scene", panes.scene]])) {
    press(id, () => {
      const follows = toggle(id);
      for (const pane of chosen) pane.follows = follows;
      ask("map");
    });
  }
  press("help", () => $("keys").showModal());
  press("start-open", () => openStart());
}

/** @param {KeyboardEvent} event */
function undoByKey(event) {
  const key = event.key.toLowerCase(), isRedo = (key === "z" && event.shiftKey) || key === "y";
  const target = event.target instanceof Element ? event.target : document.body;
  // A text that is being typed has its own undo.
  const isDirty = () => target.id === "search" || [...controls.rows.values()].some((row) => row.field === target && row.isDirty);
  if ((key !== "z" && !isRedo) || (target.matches("input[type='text']") && isDirty())) return;
  event.preventDefault();
  if (!$(isRedo ? "redo" : "undo").disabled) connection.send({ do: isRedo ? "redo" : "undo" });
}

function listenToKeys() {
  /** @param {KeyboardEvent} event */
  const follow = (event) => { page.hasShift = event.shiftKey; };
  addEventListener("keydown", follow, true);
  addEventListener("keyup", follow, true);
  addEventListener("blur", () => { page.hasShift = false; });
  document.addEventListener("keydown", (event) => {
    const isOpen = document.querySelector("dialog[open]"), { key } = event;
    const target = event.target instanceof Element ? event.target : document.body;
    const isTyped = Boolean(target.closest("input[type='text'], select, .menu"));
    if (!isOpen && !isTyped && editor.key(event)) { event.preventDefault(); return; }
    if ((event.ctrlKey || event.metaKey) && !event.altKey && !isOpen) { undoByKey(event); return; }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (key === "?" && !target.matches("input[type='text']")) {
      if (isOpen) $("keys").close();
      else $("keys").showModal();
      event.preventDefault();
      return;
    }
    if (isOpen || isTyped || !panes.b.map) return;
    const { map, marks } = panes.b, onMap = target === marks || target === panes.a.marks;
    if (key === "/") {
      document.body.classList.remove("no-panel");
      $("panel").setAttribute("aria-pressed", "true");
      $("search").focus();
      event.preventDefault();
    } else if (zoomByKey(map, key)) ask("map");
    else if (key === "0") fit();
    else if (key === "s" || key === "S") useSelection(!page.isSelecting);
    else if (key === "h" || key === "H") openStart();
    else if (key === "Escape") clearAll();
    if (!onMap) return;
    if (panByKey(map, key)) ask("map");
    else if (key === "Enter" || key === " ") { hover(map.x, map.y, null); pin(page.hovered); } else return;
    hover(map.x, map.y, null);
    event.preventDefault();
  });
}

function clearAll() {
  useSelection(false);
  select(null);
  page.pinned = -1;
  if (page.kept.length) keepOnly([]);
  studio.rules?.choose(null);
  if (page.range) setRange(null);
  tellSite();
  ask("map");
}

// -- editor -------------------------------------------------------------------------------------------------------------------

function createEditor() {
  editor = new Editor(panes.b, $("pane-sites"), $("edit"), {
    settings: () => page.state?.settings, summary: () => page.state?.summary, selected: () => page.selected,
    select: (sites) => select(null, sites),
    send: (key, value, isFinal) => connection.set(key, value, isFinal),
    remove: (key) => connection.remove(key),
    undo: () => connection.send({ do: "undo" }),
    redraw: (/** @type {"map" | "marks"} */ what = "marks") => ask(what),
    hover: (x, y) => hover(x, y, panes.b),
    generators: () => (controls.rows.get("layout")?.choices || []).filter(({ value }) => value?.generator),
    violations: () => studio.rules?.violations,
    nViolations: () => (studio.rules?.rules || []).reduce((sum, { count }) => sum + count, 0),
    opened: (isOn) => {
      if (isOn) views.show("steps", true);
      views.need("rules", isOn);
    },
    showRules: () => views.show("rules", true),
    repair: () => views.show("rules", true).then(() => views.made.rules?.openDialog()),
    showSteps: (index) => views.show("steps", true).then(() => views.made.steps?.open(index)),
  });
}

/** @param {number | null} index */
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
  paint();
  views.tell("draw");
  ask("map");
}

function chosenRenderer() {
  // "raster" in the storage of this address draws maps without WebGL, "webgl" also with software rendering.
  const wanted = lasting.get("map");
  const renderer = wanted === "raster" ? null : findRenderer();
  return renderer && wanted === "webgl" ? { isSlow: false } : renderer;
}

function createPanes() {
  const renderer = chosenRenderer();
  useSoftware(!renderer || renderer.isSlow);
  const onMap = {
    isSelecting: () => page.isSelecting,
    select,
    moved: (pane) => { stopFlight(); if (pane === panes.a) panes.b.follow(panes.a); ask("map"); },
    hover, leave,
    click: (pane) => { if (pane === panes.b && !page.isSelecting && !editor.isOn) (page.hasShift ? keep : pin)(page.hovered); },
  };
  const onImage = {
    hover, leave, gaze,
    click: (x, y) => { if (panes.b.map) fly(x, y, Math.max(panes.b.map.scale, 4 * panes.b.map.fitScale())); },
  };
  const mapOf = () => panes.b.map;
  const keys = "Arrow keys pan, plus and minus zoom, Enter pins the photosite in the centre, 0 shows all.";
  panes = {
    b: new SitePane($("map"), onMap, { renderer, label: "Map of the photosites. " + keys }),
    a: new SitePane($("map-a"), onMap, { renderer, label: "Map of the photosites of variant A" }),
    picture: new ImagePane($("picture"), onImage, { mapOf, label: "Reconstructed picture" }),
    pictureA: new ImagePane($("picture-a"), onImage, { mapOf, label: "Reconstructed picture of variant A" }),
    scene: new ImagePane($("scene"), onImage, {
      mapOf, label: "Optical image with the outline of the layout. Arrow keys move the gaze.", canMove: () => Boolean(page.state),
    }),
  };
  panes.picture.follows = panes.pictureA.follows = true;
}

// What the modules of views, tests and scripts use.
const studio = {
  page, ask, drawAsked, recolour, showSelection, tellSite,
  setRange, select, hover, leave, pin, keep, fly, flyToStep, sendViews, freeze, compare,
  get panes() { return panes; },
  get controls() { return controls; },
  get connection() { return connection; },
  get editor() { return editor; },
  get sources() { return sources; },
  get gazePanel() { return gazePanel; },
  get views() { return views; },
  get state() { return page.state; },
  // Of the views that are loaded.
  get rules() { return views.made.rules?.list; },
  get solid() { return views.made.solid; },
  get isReady() { return Boolean(page.state && panes.b.scale && connection.isSettled && views.nLoading === 0 && page.asked === null); },
  // Whether nothing more changes without the user: all messages are answered, their results are drawn, no timer of a result runs,
  // and nothing is read or played. Later, the page may ask for fewer signals, and a sweep may have further points.
  get isIdle() {
    const films = [sources.film, gazePanel.film], isPlaying = films.some((film) => film && (film.isBusy || film.isPlaying));
    return Boolean(this.isReady && connection.isAnswered && !isPending() && !page.holdTimer && !page.sizeTimer && !editor.pending
      && !panes.b.overview?.resting && !isPlaying && !sources.camera.isOn);
  },
  toWindow: (x, y, pane = "b") => {
    const canvas = panes[pane].marks, box = canvas.getBoundingClientRect(), view = panes[pane].view ? panes[pane].view() : panes[pane].map;
    const [px, py] = panes[pane].place || [0, 0];
    return [box.left + view.toX(x + px), box.top + view.toY(y + py)];
  },
  ink: inkOf, offsetsOf,
};
Object.assign(window, { studio });

function start() {
  startSplitters();
  createPanes();
  controls = new Controls($("sections"), $("search"), $("only-changed"), $("hint"), {
    send: (key, value, isFinal) => connection.set(key, value, isFinal),
    reset: (key) => connection.send({ do: "reset", key }),
    remove: (key) => connection.send({ do: "delete", key }),
    act: (what, name) => connection.send({ do: what, name }),
    chooseFile: () => files.choose(), chooseSection: (choice) => files.chooseSection(choice),
  });
  createEditor();
  const scene = () => [...controls.rows.values()].find(({ control: { key, kind } }) => key === "scene" && kind === "choice");
  const transport = new Transport();
  sources = new Sources($("pane-scene"), transport, {
    connection: () => connection, state: () => page.state, choose: () => $("chosen-file").click(),
    charts: () => scene()?.control.choices || [], playing: () => gazePanel.film?.pause(),
  });
  gazePanel = new GazePanel($("pane-scene"), panes.scene, transport, {
    connection: () => connection, state: () => page.state, playing: () => sources.film?.pause(), redraw: () => ask("marks"),
  });
  views = new Views(studio, () => { followSignals(); sendViews(); resize(); });
  // Its violations are reported with the other problems.
  views.needed.add("rules").add("requirements");
  problems = new Problems({ show: (view) => views.show(view, true), fit: () => connection.send({ do: "fit" }) });
  connection = new Connection({ hello, message: receive, part: receivePart, status: showConnection, silent: showSilence });
  files = new Files(connection, {
    busy: (text) => {
      connection.requests.isBusy = text !== null;
      showBusy(text !== null);
      showStatus(text ?? "ready");
    },
    dropped: (transfer) => sources.dropped(transfer),
  });
  startTheme(showTheme);
  listenToButtons();
  listenToKeys();
  listenToDialogs();
  for (const element of [$("map"), $("map-a"), $("picture"), $("scene"), $("tiles")]) watchSize(element, resize);
  connection.open();
}

start();
