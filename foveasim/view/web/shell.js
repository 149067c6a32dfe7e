// Shell of the pages with a map of photosites: flights, keys, the scale bar, texts of a photosite.

import { clamp, formatLength, roundStep, shown, textOf } from "./colours.js";
import { pathBetween } from "./marks.js";
import { find } from "./page_parts.js";

const FLIGHT_MS = 400;
// Steps of the arrow keys in CSS pixels, and factor of the zoom by keys.
const KEY_PIXELS = 60, KEY_ZOOM = 1.4;
// Length of the scale bar in CSS pixels, before it is rounded.
const BAR_PIXELS = 45;
/** @type {{ [key: string]: [number, number] }} */
export const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const reducesMotion = matchMedia("(prefers-reduced-motion: reduce)");

// -- navigation -----------------------------------------------------------------------------------------------------------

let flight = 0;

export function stopFlight() { cancelAnimationFrame(flight); }

// Moves a map to a position and scale, within its limits; moved() is called after each step.
/** @param {MapView} map @param {[number, number, number]} view @param {() => void} moved */
export function flyTo(map, [x, y, scale], moved) {
  const from = { x: map.x, y: map.y, scale: map.scale };
  map.set(x, y, scale);
  const to = { x: map.x, y: map.y, scale: map.scale };
  stopFlight();
  if (reducesMotion.matches) { moved(); return; }
  const start = performance.now(), path = pathBetween(from, to);
  const step = () => {
    const t = clamp((performance.now() - start) / FLIGHT_MS, 0, 1), at = t < 1 ? path(t) : to;
    map.set(at.x, at.y, at.scale);
    moved();
    if (t < 1) flight = requestAnimationFrame(step);
  };
  step();
}

// Zooms a map by a key; returns whether it did.
/** @param {MapView} map @param {string} key */
export function zoomByKey(map, key) {
  const power = { "+": 1, "=": 1, "-": -1, _: -1 }[key];
  if (power) map.zoom(KEY_ZOOM ** power, 0.5 * map.width, 0.5 * map.height);
  return Boolean(power);
}

// Pans a map by an arrow key; returns whether it did.
/** @param {MapView} map @param {string} key */
export function panByKey(map, key) {
  const step = ARROWS[key];
  if (step) map.set(map.x + (KEY_PIXELS / map.scale) * step[0], map.y + (KEY_PIXELS / map.scale) * step[1], map.scale);
  return Boolean(step);
}

// Draws the scale bar of a map; returns its length in µm and its width in CSS pixels.
/** @param {HTMLElement} bar @param {{ scale: number }} map */
export function drawScaleBar(bar, map) {
  const length = roundStep(BAR_PIXELS / map.scale), width = length * map.scale;
  find(bar, "span").textContent = formatLength(length);
  find(bar, "i").style.width = width + "px";
  return { length, width };
}

// -- the photosite ---------------------------------------------------------------------------------------------------------

const PINNED = "pinned";

// Heading of the values of a photosite, -1 for none.
/** @param {number} site @param {number} pinned @param {string[]} notes */
export function siteHeading(site, pinned, notes = []) {
  const all = [...notes, ...(site === pinned ? [PINNED] : [])];
  return site < 0 ? "Photosite" : "Photosite " + site.toLocaleString("en-US") + (all.length ? " (" + all.join(", ") + ")" : "");
}

/** @param {Column[]} columns */
const listed = (columns) => columns.filter((column) => !column.is_repeat);

// Rows [label, text, column] of the values of a photosite, and its centre with some decimals.
/** @type {(sites: Sites, columns: Column[], site: number, digits: number) => [string, string, Column?][]} */
export function siteRows(sites, columns, site, digits) {
  /** @type {[string, string, Column?][]} */
  const rows = listed(columns).map((column) => [column.label, site < 0 ? "–" : textOf(column, site, sites.area), column]);
  const centre = site < 0 ? "–" : sites.centre(site).map((v) => shown(Math.round(10 ** digits * v) / 10 ** digits + 0)).join(", ");
  return [...rows, ["centre / µm", centre]];
}

// Sentence on a photosite for screen readers.
/** @param {Column[]} columns @param {number} site @param {Numbers} area */
export function spokenSite(columns, site, area) {
  return "Photosite " + site + ": " + listed(columns).map((column) => column.label + " " + textOf(column, site, area)).join(", ");
}

// -- ranges of values -------------------------------------------------------------------------------------------------------

// Dragging on a histogram selects a range of values of a scale, a click selects all; fractionOf(event) is the position along it.
export function listenToRange(canvas, scaleOf, fractionOf, onRange) {
  let start = null;
  const valueAt = (event) => {
    const scale = scaleOf(), value = scale.value(clamp(fractionOf(event), 0, 1));
    return scale.column.is_integer && !scale.isLog ? Math.round(value) : value;
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (!scaleOf()) return;
    start = valueAt(event);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (start === null || !event.buttons) return;
    const now = valueAt(event);
    onRange(start === now ? null : [Math.min(start, now), Math.max(start, now)]);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (start !== null && valueAt(event) === start) onRange(null);
    start = null;
  });
}
