// The page of solids: parts in three dimensions, and the photosite under the mouse.

import { Bodies } from "./bodies.js";
import { COLOUR_MAPS } from "./colour_maps.js";
import { Scale, bytesOfHex, clamp, formatLength, shown, textOf } from "./colours.js";
import { context2d, findRenderer, fitCanvas, pixelRatio, textureSize, watchSize } from "./gl.js";
import { drawRamp, kindsOf, pictureOf, summaryOf, swatchItem, swatchesOf, tickLabels, titleOf } from "./legend.js";
import { Orbit } from "./orbit.js";
import { ABOVE, ASIDE, OrbitGestures } from "./orbit_gestures.js";
import { $, around, downloadPicture, find, inkOf, isForPage, listenToHelp, make, notice, speak, startTheme,
  stayingNotice } from "./page_parts.js";
import { drawScaleBar, siteHeading, spokenSite } from "./shell.js";
import { SolidView } from "./solid_view.js";
import { unpack } from "./unpack.js";

const about = JSON.parse($("about").textContent);
const ARRAYS = ["position_x", "position_y", "positions", "z", "corners", "run_sites", "run_points", "run_triangles", "run_colours",
  "tile_runs"];
class SolidState {
  // Given by open().
  /** @type {SolidView} */ view;
  /** @type {Float64Array} */ area;
  /** @type {Scale | null} */ scale = null;
  scaleBar = { length: 1, width: 0 };
  pinned = -1; part = -1; pinnedPart = -1; isAsked = false;
}

const state = new SolidState();
const gestures = new OrbitGestures($("solid"), () => state.view, {
  ask,
  pin: ({ site, part }, isByKey) => {
    if (site < 0 && isByKey) notice("No photosite in the centre of the view");
    pin(site, part);
  },
});
// Steps of the position of the cut.
const CUT_STEPS = 200;
// Parts of more colours have no swatches.
const MOST_SWATCHES = 4;

// -- the photosite --------------------------------------------------------------------------------------------------------

function showSite() {
  const { view, pinned } = state, hovered = view.hovered, site = hovered >= 0 ? hovered : pinned;
  const part = hovered >= 0 ? state.part : pinned >= 0 ? state.pinnedPart : -1;
  const columns = about.columns.filter((column) => !column.is_repeat);
  $("site").classList.toggle("empty", site < 0);
  $("unpin").hidden = pinned < 0;
  $("site-heading").textContent = siteHeading(site, pinned, part >= 0 ? [view.parts[part].name] : []);
  $("values").replaceChildren(...columns.flatMap((column) =>
    [make("dt", column.label), make("dd", site < 0 ? "–" : textOf(column, site, state.area))]));
  speak(site < 0 ? null : () => spokenSite(columns, site, state.area));
}

function hover() {
  const { view } = state, { site, part } = gestures.under() || { site: -1, part: -1 };
  if (site === view.hovered && part === state.part) return;
  view.hovered = site;
  state.part = part;
  showSite();
}

function pin(site, part) {
  const isOff = site < 0 || site === state.pinned;
  state.pinned = isOff ? -1 : site;
  state.pinnedPart = isOff ? -1 : part;
  state.view.setPinned(state.pinned);
  showSite();
  ask();
}

// -- drawing --------------------------------------------------------------------------------------------------------------

function ask() {
  if (state.isAsked) return;
  state.isAsked = true;
  requestAnimationFrame(drawFrame);
}

// Ids are drawn one frame after the view has stopped; during motion only the image is drawn.
function drawFrame() {
  const { view } = state, wasMoving = view.isImageStale && view.areIdsStale;
  state.isAsked = false;
  if (view.gl.isContextLost()) return;
  if (!wasMoving) hover();
  view.draw();
  showScale();
  if (wasMoving) ask();
}

// Lengths at the centre of the view; nearer parts appear larger.
function showScale() { state.scaleBar = drawScaleBar($("scale-bar"), { scale: state.view.orbit.pixelsPerUm() }); }

// -- colours and cut ------------------------------------------------------------------------------------------------------

// Colours all parts by a column, or by their own colours for an empty key.
async function colourBy(key) {
  const { view } = state, column = about.columns.find((one) => one.key === key);
  $("colouring").value = column ? key : "";
  $("legend").hidden = !column;
  state.scale = null;
  if (column) {
    const filterOf = about.filter && column.kind === "lit" ? await unpack(about.filter, about.arrays[about.filter]) : null;
    state.scale = new Scale(column, await valuesOf(column), filterOf, about.palette, { wantedMap: $("colour-map").value });
    drawLegend(state.scale);
  }
  for (const part of view.parts) view.setColours(part, state.scale && siteBytes(state.scale));
  ask();
}

async function valuesOf(column) {
  if (column.of) return column.of === "area" ? state.area : Float64Array.from(state.area, Math.sqrt);
  column.values = column.values || (await unpack(column.array, about.arrays[column.array]));
  return column.values;
}

function siteBytes(scale) {
  const words = new Uint32Array(textureSize(about.n_sites + 1));
  scale.paint(words.subarray(1), null, [0, 0, 0]);
  return new Uint8Array(words.buffer);
}

/** @param {Scale} scale */
function drawLegend(scale) {
  const isKinds = scale.column.kind === "kinds";
  $("bar").hidden = isKinds;
  $("kinds").hidden = !isKinds;
  $("map-label").hidden = !scale.canMap;
  $("colour-map").value = scale.map || COLOUR_MAPS[0];
  if (isKinds) {
    const { items, rest } = kindsOf(scale);
    $("kinds").replaceChildren(...items.map(swatchItem));
    $("summary").textContent = rest;
    return;
  }
  const ramp = $("ramp"), ratio = pixelRatio();
  fitCanvas(ramp, ramp.clientWidth, ramp.clientHeight);
  const context = context2d(ramp);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  drawRamp(context, scale, ramp.clientWidth, ramp.clientHeight);
  $("ticks").replaceChildren(...tickLabels(scale));
  $("summary").textContent = titleOf(scale.column) + ": " + summaryOf(scale);
}

// The direction of the cut and its position, from 0 at the low end of the sensor to 1 at the high end.
function cutAt() {
  const words = { x: [0, 1], "-x": [0, -1], y: [1, 1], "-y": [1, -1], z: [2, 1] }[$("cut").value], { low, high } = state.view.bodies;
  $("cut-position").hidden = $("cut-text").hidden = !words;
  if (!words) { state.view.setCut(null); gestures.moved(); return; }
  const [axis, sign] = words, position = low[axis] + ((high[axis] - low[axis]) * Number($("cut-position").value)) / CUT_STEPS;
  $("cut-text").textContent = "xyz"[axis] + (sign > 0 ? " above " : " below ") + Number(position.toPrecision(4)) + " µm is removed";
  state.view.setCut({ axis, sign, position });
  gestures.moved();
}

function showTheme() {
  state.view.setGround(bytesOfHex(inkOf("--map")));
  ask();
}

function resize() {
  const { width, height } = $("map").getBoundingClientRect();
  state.view.resize(width, height);
  gestures.moved();
}

// -- mouse, touch and keys ------------------------------------------------------------------------------------------------

function listenToKeys() {
  document.addEventListener("keydown", (event) => {
    if (!isForPage(event) || gestures.key(event)) return;
    if (event.key === "c" || event.key === "C") nextCut();
    else if (event.key === "[" || event.key === "]") moveCut(event.key === "]" ? 5 : -5);
    else if (event.key === "Escape") pin(-1, -1);
  });
}

function nextCut() {
  const { options } = $("cut");
  $("cut").selectedIndex = ($("cut").selectedIndex + 1) % options.length;
  cutAt();
  notice($("cut").value ? "Cut along " + $("cut").selectedOptions[0].textContent : "No cut");
}

function moveCut(steps) {
  if (!$("cut").value) return;
  $("cut-position").value = String(clamp(Number($("cut-position").value) + steps, 0, CUT_STEPS));
  cutAt();
}

function listenToTools() {
  const own = about.ownColours ?? "of the parts";
  $("colouring").append(new Option(own, ""), ...about.columns.map((column) => new Option(titleOf(column), column.key)));
  $("colour-map").append(...COLOUR_MAPS.map((name) => make("option", name)));
  $("colouring").addEventListener("change", () => { $("colour-map").value = COLOUR_MAPS[0]; colourBy($("colouring").value); });
  $("colour-map").addEventListener("change", () => colourBy($("colouring").value));
  $("cut").addEventListener("change", cutAt);
  $("cut-position").addEventListener("input", cutAt);
  $("nearer").addEventListener("click", () => gestures.approach(1.5));
  $("farther").addEventListener("click", () => gestures.approach(1 / 1.5));
  $("fit").addEventListener("click", () => gestures.look(ASIDE));
  $("above").addEventListener("click", () => gestures.look(ABOVE));
  $("unpin").addEventListener("click", () => pin(-1, -1));
  $("height").addEventListener("input", () => {
    const factor = 2 ** Number($("height").value);
    $("height-scale").textContent = "× " + Number(factor.toPrecision(2));
    state.view.setHeight(factor);
    gestures.moved();
  });
  $("save").addEventListener("click", () => downloadPicture(viewAsPicture(), about.name));
}

// Returns the displayed view with its scale bar, and the legend of its colours or of the visible parts.
function viewAsPicture() {
  const { view, scale, scaleBar } = state, { width, tall } = view.orbit;
  const items = view.parts.filter((part) => part.isVisible).map((part) => ({ colours: coloursOf(part), text: part.name }));
  view.draw();
  return pictureOf([[$("solid")]], {
    width, height: tall, scales: scale ? [scale] : [], items: scale ? [] : items,
    bar: { text: formatLength(scaleBar.length), width: scaleBar.width },
  });
}

// Colours of a part of its own for a legend; none if there are many.
function coloursOf(part) {
  const colours = state.view.bodies.coloursOf(part.body, MOST_SWATCHES + 1);
  return colours.length > MOST_SWATCHES ? [] : colours;
}

function partItem(part) {
  const box = make("input", undefined, { type: "checkbox", checked: true });
  box.addEventListener("change", () => { state.view.setVisible(part, box.checked); gestures.moved(); });
  const text = part.name + " · " + shown(part.nTriangles) + " triangles";
  return around("li", {}, around("label", {}, box, ...swatchesOf(coloursOf(part)), make("span", text)));
}

// -- loading --------------------------------------------------------------------------------------------------------------

// After the graphics context was lost, all data are sent again when it is restored.
function listenToLosses() {
  const canvas = $("solid");
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    stayingNotice("The graphics context was lost; the view returns when the context is restored.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    state.view.load();
    stayingNotice(null);
    gestures.moved();
  });
}

async function open() {
  startTheme(() => { if (state.view) showTheme(); });
  listenToHelp();
  $("notes").textContent = about.notes.join(" · ");
  const renderer = findRenderer();
  if (!renderer) {
    $("opening").textContent = "This browser has no WebGL2, which three dimensions need. "
      + "Use another browser, or enable graphics acceleration in the settings.";
    return;
  }
  const arrays = Object.fromEntries(await Promise.all([...ARRAYS,
    "area_um2"].map(async (name) => [name, await unpack(name, about.arrays[name])])));
  const bodies = new Bodies(about.bodies, arrays), smallest = Math.sqrt(arrays.area_um2.reduce((a, b) => Math.min(a, b)));
  state.area = arrays.area_um2;
  const orbit = new Orbit(bodies.low, bodies.high, Math.max(4096 * bodies.lattice, 0.1 * smallest));
  state.view = new SolidView($("solid"), bodies, orbit, about.n_sites, renderer);
  $("parts").append(...state.view.parts.map(partItem));
  resize();
  orbit.look(ASIDE[0], ASIDE[1]);
  showTheme();
  listenToKeys();
  listenToTools();
  listenToLosses();
  watchSize($("map"), resize);
  showSite();
  if (about.colouring) await colourBy(about.colouring);
  state.view.draw();
  showScale();
  $("opening").hidden = true;
}

async function openRest() {
  for (const column of about.columns) {
    if (column.array && !column.is_repeat && !column.values) column.values = await unpack(column.array, about.arrays[column.array]);
  }
  showSite();
}

const handle = {
  nSites: about.n_sites,
  ready: Promise.resolve(),
  complete: Promise.resolve(),
  readyMs: NaN,
  // Site and part at a position in the window, in CSS pixels.
  pick: (px, py) => {
    const box = $("solid").getBoundingClientRect(), { site, part } = state.view.pick(px - box.left, py - box.top);
    return { site, part: part < 0 ? null : state.view.parts[part].name };
  },
  lookDown: () => gestures.look(ABOVE),
  draw: () => state.view.draw(),
  picture: () => viewAsPicture().toDataURL("image/png"),
  // Whether all is drawn.
  get isIdle() { return !state.isAsked; },
  get hovered() { return state.view.hovered; },
  get pinned() { return state.pinned; },
  get parts() { return state.view.parts.map((part) => part.name); },
  get cut() { return state.view.cut; },
  get scaleBarUm() { return find($("scale-bar"), "i").getBoundingClientRect().width / state.view.orbit.pixelsPerUm(); },
  // Colours of a site on the scale in use, (r, g, b).
  colour: (site) => state.scale && state.scale.colour(site),
  get counts() { return { ...state.view.counts }; },
  // The eye, the target, and the visible length of a vertical line at the target, in µm with heights scaled.
  get camera() {
    const { orbit } = state.view;
    return { eye: [...orbit.eye([0, 0, 0])], target: [...orbit.target], distance: orbit.distance, height: orbit.height,
      near: orbit.near, far: orbit.far };
  },
  // CSS pixels in the window of a position on the sensor in µm.
  toWindow: (x, y, z) => {
    const box = $("solid").getBoundingClientRect(), [px, py] = state.view.orbit.project(x, y, z, [0, 0]);
    return [box.left + px, box.top + py];
  },
};
Object.assign(window, { foveasim: handle });
handle.ready = open().then(() => { handle.readyMs = performance.now(); });
handle.complete = handle.ready.then(() => state.view && openRest());
handle.ready.catch((error) => { $("opening").textContent = "The solids cannot be shown (" + error.message + ")."; });
handle.complete.catch(() => {});
