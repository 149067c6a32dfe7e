// Splitters between panes: they are dragged, or moved by arrow keys, and their positions remain after a reload.

import { clamp } from "/web/colours.js";
import { $, make } from "/web/page_parts.js";
import { lasting } from "./memory.js";

// Smallest size of what a splitter separates, and steps of the arrow keys, in CSS pixels.
const LEAST = 120, STEP = 16, LONG_STEP = 64;
// A row of tiles is at least as high, in CSS pixels.
const ROW = 200;
const narrow = matchMedia("(max-width: 760px)"), wide = matchMedia("(min-width: 1800px)");

// A splitter changes a variable of the style sheet, in proportion to the size of an element along an axis; sign: -1 if the element
// is after the splitter.
/** @typedef {{ name: string, axis: "x" | "y", sign: number }} Way */
/** @type {[string, string, string, () => Way][]} */
const SPLITTERS = [
  ["controls", "controls", "Size of the settings", () => (narrow.matches ? { name: "--sheet", axis: "y", sign: -1 }
    : { name: "--settings", axis: "x", sign: 1 })],
  ["pane-sites", "pane-sites", "Width of the photosites", () => ({ name: "--sites", axis: "x", sign: 1 })],
  ["pane-picture", "pane-picture", "Size of the picture", () => ({ name: "--picture", axis: wide.matches ? "x" : "y", sign: 1 })],
  ["dock", "tiles", "Height of the views", () => ({ name: "--dock", axis: "y", sign: -1 })],
];

const root = document.documentElement;
/** @type {{ [name: string]: number }} */
let sizes = {};

/** @param {string} name @param {number | null} value */
function use(name, value) {
  if (value === null) { delete sizes[name]; root.style.removeProperty(name); } else {
    sizes[name] = value;
    root.style.setProperty(name, String(value));
  }
  lasting.set("panes", JSON.stringify(sizes));
}

/** @type {(place: string, id: string, label: string, way: () => Way) => HTMLElement} */
function splitterOf(place, id, label, way) {
  const title = label + " (drag, arrow keys; double click for the initial size)", sized = $(id);
  const splitter = make("div", undefined, { className: "splitter", tabIndex: 0, role: "separator", title, ariaLabel: label });
  /** @type {{ at: number, size: number, value: number } | null} */
  let start = null;
  const sizeOf = (element) => element.getBoundingClientRect()[way().axis === "x" ? "width" : "height"];
  const most = () => sizeOf(id === "tiles" ? $("views") : sized.parentElement) - LEAST;
  const grip = (at) => ({ at, size: sizeOf(sized), value: parseFloat(getComputedStyle(root).getPropertyValue(way().name)) });
  const show = () => {
    splitter.ariaOrientation = way().axis === "x" ? "vertical" : "horizontal";
    splitter.ariaValueNow = String(clamp(Math.round((100 * sizeOf(sized)) / (most() + LEAST)), 0, 100));
  };
  const move = (from, by) => {
    if (!(from.size > 0)) return;
    const size = clamp(from.size + way().sign * by, LEAST, Math.max(LEAST, most()));
    // In pixels, or relative to the size before.
    use(way().name, from.value > 1 ? Math.round(size) : Number(((from.value * size) / from.size).toPrecision(6)));
    show();
  };
  const along = (event) => (way().axis === "x" ? event.clientX : event.clientY);
  splitter.setAttribute("aria-controls", id);
  splitter.addEventListener("pointerdown", (event) => { start = grip(along(event)); splitter.setPointerCapture(event.pointerId); });
  splitter.addEventListener("pointermove", (event) => { if (start) move(start, along(event) - start.at); });
  for (const type of ["pointerup", "pointercancel"]) splitter.addEventListener(type, () => { start = null; });
  splitter.addEventListener("dblclick", () => { use(way().name, null); show(); });
  splitter.addEventListener("focus", show);
  for (const media of [narrow, wide]) media.addEventListener("change", show);
  splitter.addEventListener("keydown", (event) => {
    const [less, more] = way().axis === "x" ? ["ArrowLeft", "ArrowRight"] : ["ArrowUp", "ArrowDown"];
    const by = { [less]: -1, [more]: 1, Home: -way().sign * Infinity, End: way().sign * Infinity }[event.key];
    if (!by) return;
    move(grip(0), by * (event.shiftKey ? LONG_STEP : STEP));
    event.preventDefault();
    event.stopPropagation();
  });
  $(place).append(splitter);
  show();
  return splitter;
}

// Rows of the tiles: as many as fit, and as are needed.
export function showRows() {
  const tiles = $("tiles"), n = [...tiles.children].filter((tile) => !(/** @type {HTMLElement} */ (tile).hidden)).length;
  const columns = getComputedStyle(tiles).gridTemplateColumns.split(" ").length;
  const rows = clamp(Math.floor(tiles.clientHeight / ROW), 1, Math.max(1, Math.ceil(n / columns)));
  if (tiles.style.getPropertyValue("--rows") !== String(rows)) tiles.style.setProperty("--rows", String(rows));
}

export function startSplitters() {
  sizes = lasting.read("panes") || {};
  for (const [name, value] of Object.entries(sizes)) if (/^--[a-z]+$/.test(name) && value > 0) root.style.setProperty(name, String(value));
  for (const each of SPLITTERS) splitterOf(...each);
}
