// Marks on maps: outlines of sites, crosses, rectangles; positions as text; and the path of a flight between two views.

import { clamp } from "./colours.js";

// More outlines than this are not drawn, because they would not be distinguishable.
export const MOST_OUTLINES = 4000;

// Strokes a path several times, wide lines first.
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

// Traces four lines around a point, from and to a distance.
export function traceCross(context, x, y, from, to) {
  for (const [u, v] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + from * u, y + from * v);
    context.lineTo(x + to * u, y + to * v);
  }
}

// Outlines a site, with a circle around sites of a few pixels, which could be missed.
export function ringSite(context, map, site, inks) {
  const { sites } = map, [a, b, c, d] = sites.box.subarray(4 * site, 4 * site + 4);
  outline(context, () => sites.trace(context, site, map), [5, 2.5], inks);
  if ((c - a) * map.scale < 10 && (d - b) * map.scale < 10) {
    outline(context, () => context.arc(map.toX(0.5 * (a + c)), map.toY(0.5 * (b + d)), 9, 0, 7), [4, 2], inks);
  }
}

// Draws the outlines of all sites in view, if they are sufficiently large.
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
export function positionText(value, scale) {
  return value.toFixed(clamp(Math.ceil(Math.log10(scale)) + 1, 0, 6));
}

// Returns the view { x, y, scale } at a fraction of the path between two views.
export function pathBetween(from, to) {
  const ratio = to.scale / from.scale;
  return (t) => {
    const eased = t * t * (3 - 2 * t);
    // The path follows the width of the view, which gives the impression of falling towards the target.
    const way = Math.abs(ratio - 1) < 1e-3 ? eased : (1 - ratio ** -eased) / (1 - 1 / ratio);
    return { x: from.x + way * (to.x - from.x), y: from.y + way * (to.y - from.y), scale: from.scale * ratio ** eased };
  };
}
