// The page of solids: parts in three dimensions, and the photosite under the mouse.

import { Bodies } from "./bodies.js";
import { COLOUR_MAPS } from "./colour_maps.js";
import { Scale, bytesOfHex, clamp, formatLength, roundStep, shown, textOf } from "./colours.js";
import { listenToPointers } from "./gestures.js";
import { findRenderer, fitCanvas, pixelRatio, textureSize, watchSize } from "./gl.js";
import { drawRamp, kindsOf, pictureOf, summaryOf, swatchItem, swatchesOf, tickLabels, titleOf } from "./legend.js";
import { Orbit } from "./orbit.js";
import { $, downloadPicture, inkOf, isForPage, listenToHelp, make, notice, speak, startTheme, stayingNotice } from "./page_parts.js";
import { SolidView } from "./solid_view.js";
import { unpack } from "./unpack.js";

const about = JSON.parse($("about").textContent);
const ARRAYS = ["position_x", "position_y", "positions", "z", "corners", "run_sites", "run_points", "run_triangles", "run_colours",
  "tile_runs"];
const state = { view: null, area: null, pinned: -1, part: -1, pinnedPart: -1, pointer: null, anchor: null, isAsked: false, scale: null };
// Steps of the position of the cut.
const CUT_STEPS = 200;
// Parts of more colours have no swatches.
const MOST_SWATCHES = 4;
const ASIDE = [Math.atan2(-0.9, 0.35), Math.atan2(0.75, Math.hypot(0.35, 0.9))], ABOVE = [-0.5 * Math.PI, 0.5 * Math.PI];

// -- the photosite --------------------------------------------------------------------------------------------------------

function showSite() {
  const { view, pinned } = state, hovered = view.hovered, site = hovered >= 0 ? hovered : pinned;
  const part = hovered >= 0 ? state.part : pinned >= 0 ? state.pinnedPart : -1, isPinned = site >= 0 && site === pinned;
  const columns = about.columns.filter((column) => !column.is_repeat);
  const notes = [part >= 0 ? view.parts[part].name : "", isPinned ? "pinned" : ""].filter(Boolean).join(", ");
  $("site").classList.toggle("empty", site < 0);
  $("unpin").hidden = pinned < 0;
  $("site-heading").textContent = site < 0 ? "Photosite" : "Photosite " + site.toLocaleString("en-US") + (notes ? " (" + notes + ")" : "");
  $("values").replaceChildren(...columns.flatMap((column) =>
    [make("dt", column.label), make("dd", site < 0 ? "–" : textOf(column, site, state.area))]));
  speak(site < 0 ? null
    : () => "Photosite " + site + ": " + columns.map((column) => column.label + " " + textOf(column, site, state.area)).join(", "));
}

// The site and part of the nearest surface under the pointer; the surface stays under it during zoom.
function hover() {
  const { view, pointer } = state, found = pointer ? view.pick(pointer[0], pointer[1]) : null;
  const site = found ? found.site : -1, part = found ? found.part : -1;
  if (pointer && !state.anchor) state.anchor = view.orbit.pointAt(pointer[0], pointer[1], found.depth, new Float64Array(3));
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
  drawScaleBar();
  if (wasMoving) ask();
}

// Lengths at the centre of the view; nearer parts appear larger.
function drawScaleBar() {
  const perUm = state.view.orbit.pixelsPerUm(), length = roundStep(45 / perUm), bar = $("scale-bar");
  bar.querySelector("span").textContent = formatLength(length);
  bar.querySelector("i").style.width = length * perUm + "px";
}

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
    drawLegend();
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

function drawLegend() {
  const { scale } = state, isKinds = scale.column.kind === "kinds";
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
  const context = ramp.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  drawRamp(context, scale, ramp.clientWidth, ramp.clientHeight);
  $("ticks").replaceChildren(...tickLabels(scale));
  $("summary").textContent = titleOf(scale.column) + ": " + summaryOf(scale);
}

// The direction of the cut and its position, from 0 at the low end of the sensor to 1 at the high end.
function cutAt() {
  const words = { x: [0, 1], "-x": [0, -1], y: [1, 1], "-y": [1, -1], z: [2, 1] }[$("cut").value], { low, high } = state.view.bodies;
  $("cut-position").hidden = $("cut-text").hidden = !words;
  if (!words) { state.view.setCut(null); moved(); return; }
  const [axis, sign] = words, position = low[axis] + ((high[axis] - low[axis]) * Number($("cut-position").value)) / CUT_STEPS;
  $("cut-text").textContent = "xyz"[axis] + (sign > 0 ? " above " : " below ") + Number(position.toPrecision(4)) + " µm is removed";
  state.view.setCut({ axis, sign, position });
  moved();
}

// The view has changed, by more than a zoom about the pointer.
function moved() {
  state.anchor = null;
  changed();
}

function changed() {
  state.view.change();
  ask();
}

function look(direction) {
  state.view.orbit.look(...direction);
  moved();
}

function turn(aside, up) {
  state.view.orbit.turn(aside, up);
  moved();
}

function approach(factor) {
  state.view.orbit.zoom(1 / factor);
  moved();
}

function showTheme() {
  state.view.setGround(bytesOfHex(inkOf("--map")));
  ask();
}

function resize() {
  const { width, height } = $("map").getBoundingClientRect();
  state.view.resize(width, height);
  moved();
}

// -- mouse, touch and keys ------------------------------------------------------------------------------------------------

function listenToCanvas() {
  const canvas = $("solid"), { orbit } = state.view, point = new Float64Array(3);
  // Point of the pointer on a surface, cached since it arrived there; else in front of the target.
  const under = (px, py) => state.anchor || orbit.pointAt(px, py, 1, point);
  const depthOf = (position) => {
    let depth = 1;
    for (let i = 0; i < 3; i++) depth -= (orbit.toEye[i] * (position[i] - orbit.target[i])) / orbit.distance;
    return Math.max(depth, 0.05);
  };
  let held = 1;
  listenToPointers(canvas, {
    takesRightButton: true,
    press: () => { held = state.anchor ? depthOf(state.anchor) : 1; },
    drag: (dx, dy, { isSecond, isMiddle }) => {
      if (isMiddle) orbit.zoom(Math.exp(0.005 * dy));
      else if (isSecond) orbit.pan(dx, dy, held);
      else orbit.turn((-2 * Math.PI * dx) / orbit.tall, (2 * Math.PI * dy) / orbit.tall);
      moved();
    },
    pinch: (factor, px, py) => { orbit.zoom(1 / factor, orbit.pointAt(px, py, 1, point)); moved(); },
    wheel: (factor, px, py) => { orbit.zoom(1 / factor, under(px, py)); changed(); },
    click: (px, py) => { const found = state.view.pick(px, py); pin(found.site, found.part); },
    move: (px, py, isHeld) => { state.pointer = isHeld ? null : [px, py]; state.anchor = null; ask(); },
    leave: () => { state.pointer = null; state.anchor = null; ask(); },
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (way && event.shiftKey) { orbit.pan(-60 * way[0], 60 * way[1]); moved(); }
    else if (way) turn(0.12 * way[0], 0.1 * way[1]);
    else if (event.key === "Enter" || event.key === " ") {
      const found = state.view.pick(0.5 * orbit.width, 0.5 * orbit.tall);
      if (found.site < 0) notice("No photosite in the centre of the view");
      pin(found.site, found.part);
    } else return;
    event.preventDefault();
  });
  document.addEventListener("keydown", (event) => {
    if (!isForPage(event)) return;
    if (event.key === "+" || event.key === "=") approach(1.3);
    else if (event.key === "-" || event.key === "_") approach(1 / 1.3);
    else if (event.key === "0") look(ASIDE);
    else if (event.key === "t" || event.key === "T") look(ABOVE);
    else if (event.key === "c" || event.key === "C") nextCut();
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
  $("colouring").append(...[["", "of the parts"], ...about.columns.map((column) => [column.key, titleOf(column)])].map(([key, text]) => {
    const option = make("option", text);
    option.value = key;
    return option;
  }));
  $("colour-map").append(...COLOUR_MAPS.map((name) => make("option", name)));
  $("colouring").addEventListener("change", () => { $("colour-map").value = COLOUR_MAPS[0]; colourBy($("colouring").value); });
  $("colour-map").addEventListener("change", () => colourBy($("colouring").value));
  $("cut").addEventListener("change", cutAt);
  $("cut-position").addEventListener("input", cutAt);
  $("nearer").addEventListener("click", () => approach(1.5));
  $("farther").addEventListener("click", () => approach(1 / 1.5));
  $("fit").addEventListener("click", () => look(ASIDE));
  $("above").addEventListener("click", () => look(ABOVE));
  $("unpin").addEventListener("click", () => pin(-1, -1));
  $("height").addEventListener("input", () => {
    const factor = 2 ** Number($("height").value);
    $("height-scale").textContent = "× " + Number(factor.toPrecision(2));
    state.view.setHeight(factor);
    moved();
  });
  $("save").addEventListener("click", () => downloadPicture(viewAsPicture(), about.name));
}

// Returns the displayed view with its scale bar, and the legend of its colours or of the visible parts.
function viewAsPicture() {
  const { view, scale } = state, { width, tall } = view.orbit, bar = $("scale-bar");
  const items = view.parts.filter((part) => part.isVisible).map((part) => ({ colours: coloursOf(part), text: part.name }));
  view.draw();
  return pictureOf([[$("solid")]], {
    width, height: tall, scales: scale ? [scale] : [], items: scale ? [] : items,
    bar: { text: bar.querySelector("span").textContent, width: bar.querySelector("i").getBoundingClientRect().width },
  });
}

// Colours of a part of its own for a legend; none if there are many.
function coloursOf(part) {
  const colours = state.view.bodies.coloursOf(part.body, MOST_SWATCHES + 1);
  return colours.length > MOST_SWATCHES ? [] : colours;
}

function partItem(part) {
  const item = make("li"), label = make("label"), box = make("input");
  box.type = "checkbox";
  box.checked = true;
  box.addEventListener("change", () => { state.view.setVisible(part, box.checked); moved(); });
  label.append(box, ...swatchesOf(coloursOf(part)), make("span", part.name + " · " + shown(part.nTriangles) + " triangles"));
  item.append(label);
  return item;
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
    moved();
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
  orbit.look(...ASIDE);
  showTheme();
  listenToCanvas();
  listenToTools();
  listenToLosses();
  watchSize($("map"), resize);
  showSite();
  if (about.colouring) await colourBy(about.colouring);
  state.view.draw();
  drawScaleBar();
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
  ready: null,
  complete: null,
  readyMs: NaN,
  // Site and part at a position in the window, in CSS pixels.
  pick: (px, py) => {
    const box = $("solid").getBoundingClientRect(), { site, part } = state.view.pick(px - box.left, py - box.top);
    return { site, part: part < 0 ? null : state.view.parts[part].name };
  },
  lookDown: () => look(ABOVE),
  draw: () => state.view.draw(),
  picture: () => viewAsPicture().toDataURL("image/png"),
  get hovered() { return state.view.hovered; },
  get pinned() { return state.pinned; },
  get parts() { return state.view.parts.map((part) => part.name); },
  get cut() { return state.view.cut; },
  get scaleBarUm() { return $("scale-bar").querySelector("i").getBoundingClientRect().width / state.view.orbit.pixelsPerUm(); },
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
