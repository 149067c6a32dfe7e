// Marks on maps: outlines of sites, crosses, rectangles; positions as text; and the path of a flight between two views.

import { clamp } from "./colours.js";

// Inks of lines around others: on maps, of the pinned, the hovered and a wrong site; on pictures.
const WHITE = "#ffffff", ACCENT = "#1f5fbf", DARK = "#10151f", WRONG = "#d3261b", SHADE = "rgb(0 0 0 / 60%)";
// More outlines than this are not drawn, because they would not be distinguishable.
export const MOST_OUTLINES = 4000;

// Strokes a path several times, wide lines first.
/** @param {CanvasRenderingContext2D} context @param {() => void} trace @param {number[]} widths @param {string[]} inks */
export function outline(context, trace, widths, inks) {
  context.beginPath();
  trace();
  context.lineJoin = "round";
  widths.forEach((width, i) => {
    context.lineWidth = width;
    context.strokeStyle = inks[i];
    context.stroke();
  });
}

// Draws the cursor of another view: four lines around a point, of a map or a picture.
/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y */
export function drawCross(context, x, y, isOnPicture = false) {
  const from = isOnPicture ? 3 : 4, to = isOnPicture ? 10 : 13;
  const trace = () => {
    for (const [u, v] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + from * u, y + from * v);
      context.lineTo(x + to * u, y + to * v);
    }
  };
  outline(context, trace, [4, 2], isOnPicture ? [SHADE, WHITE] : [WHITE, DARK]);
}

// Outlines a site, with a circle around sites of a few pixels, which could be missed.
/** @param {CanvasRenderingContext2D} context @param {MapView} map @param {number} site @param {string[]} inks */
function ringSite(context, map, site, inks) {
  const { sites } = map, [a, b, c, d] = sites.box.subarray(4 * site, 4 * site + 4);
  outline(context, () => sites.trace(context, site, map), [5, 2.5], inks);
  if ((c - a) * map.scale < 10 && (d - b) * map.scale < 10) {
    outline(context, () => context.arc(map.toX(0.5 * (a + c)), map.toY(0.5 * (b + d)), 9, 0, 7), [4, 2], inks);
  }
}

// Outlines the pinned and the hovered site, -1 for none.
/** @param {CanvasRenderingContext2D} context @param {MapView} map @param {number} pinned @param {number} hovered */
export function ringSites(context, map, pinned, hovered) {
  const isSite = (/** @type {number} */ site) => site >= 0 && site < map.sites.n;
  if (isSite(pinned)) ringSite(context, map, pinned, [WHITE, ACCENT]);
  if (isSite(hovered) && hovered !== pinned) ringSite(context, map, hovered, [WHITE, DARK]);
}

// Draws the rectangle of a selection, and outlines selected sites.
/** @type {(context: CanvasRenderingContext2D, map: MapView, rectangle: Rectangle | null, selected: number[]) => void} */
export function drawSelected(context, map, rectangle, selected) {
  const { sites } = map, trace = () => {
    for (const site of selected.slice(0, MOST_OUTLINES)) if (site < sites.n) sites.trace(context, site, map);
  };
  if (selected.length) outline(context, trace, [3, 1.5], [WHITE, ACCENT]);
  if (!rectangle) return;
  const [[x0, y0], [x1, y1]] = rectangle, wide = Math.abs(x1 - x0) * map.scale, tall = Math.abs(y1 - y0) * map.scale;
  /** @type {[number, number, number, number]} */
  const box = [map.toX(Math.min(x0, x1)), map.toY(Math.max(y0, y1)), wide, tall];
  context.fillStyle = "rgb(31 95 191 / 14%)";
  context.fillRect(...box);
  outline(context, () => context.rect(...box), [4, 2], [WHITE, ACCENT]);
}

// Draws a chosen violation { path, box }, with a circle around it.
/** @type {(context: CanvasRenderingContext2D, map: MapView, trace: Trace) => void} */
export function drawTrace(context, map, { path, box }) {
  const [a, b, c, d] = box, radius = Math.max(16, 0.75 * map.scale * Math.hypot(c - a, d - b));
  outline(context, () => path(context, map), [8, 4], [WHITE, WRONG]);
  outline(context, () => context.arc(map.toX(0.5 * (a + c)), map.toY(0.5 * (b + d)), radius, 0, 7), [4, 2], [WHITE, WRONG]);
}

// Draws the view of a map as a rectangle on a picture of this size, unless the map shows all of it.
/** @type {(context: CanvasRenderingContext2D, picture: View, map: MapView, width: number, height: number) => void} */
export function drawView(context, picture, map, width, height) {
  const far = [picture.toX(map.fromX(0)), picture.toY(map.fromY(0)), picture.toX(map.fromX(map.width)), picture.toY(map.fromY(map.height))];
  // Sides outside the picture are at its edge.
  const [x0, y0, x1, y1] = far.map((at, i) => clamp(at, 2, (i % 2 ? height : width) - 2));
  if (x0 <= 2 && y0 <= 2 && x1 >= width - 2 && y1 >= height - 2) return;
  const w = Math.max(5, x1 - x0), h = Math.max(5, y1 - y0);
  outline(context, () => context.rect(0.5 * (x0 + x1 - w), 0.5 * (y0 + y1 - h), w, h), [3.5, 1.75], [SHADE, WHITE]);
}

// Draws the outlines of all sites in view, if they are sufficiently large.
/** @type {(context: CanvasRenderingContext2D, map: MapView, width: number, height: number) => void} */
export function drawOutlines(context, map, width, height) {
  const { sites } = map, found = sites.within(map.fromX(0), map.fromY(height), map.fromX(width), map.fromY(0), MOST_OUTLINES);
  if (!found || !found.size) return;
  const side = Math.sqrt((width * height) / found.size), ink = clamp((side - 7) / 25, 0, 0.5);
  if (!(ink > 0)) return;
  context.lineWidth = 1;
  // A grey between those of dark and bright sites, visible on both.
  context.strokeStyle = "rgb(112 120 134 / " + 1.6 * ink + ")";
  // In groups: the time per path grows faster than its length.
  let traced = 0;
  context.beginPath();
  for (const site of found) {
    sites.trace(context, site, map);
    if (++traced % 20 === 0) { context.stroke(); context.beginPath(); }
  }
  context.stroke();
}

// Formats a position with the digits that a scale resolves.
/** @param {number} value @param {number} scale */
export function positionText(value, scale) {
  return value.toFixed(clamp(Math.ceil(Math.log10(scale)) + 1, 0, 6));
}

// Returns the view { x, y, scale } at a fraction of the path between two views.
/** @param {Placed & { scale: number }} from @param {Placed & { scale: number }} to */
export function pathBetween(from, to) {
  const ratio = to.scale / from.scale;
  return (/** @type {number} */ t) => {
    const eased = t * t * (3 - 2 * t);
    // The path follows the width of the view, which gives the impression of falling towards the target.
    const way = Math.abs(ratio - 1) < 1e-3 ? eased : (1 - ratio ** -eased) / (1 - 1 / ratio);
    return { x: from.x + way * (to.x - from.x), y: from.y + way * (to.y - from.y), scale: from.scale * ratio ** eased };
  };
}
