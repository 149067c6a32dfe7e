// Edits of the layout: their descriptions, positions and outlines. Positions are in µm, before the layout is moved.

import { shown } from "/web/colours.js";
import { eachEdge } from "./snapping.js";

export const KEY = "layout.edits";
// Names of kinds in words.
const NAMES = {
  draw: "Draw", remove_at: "Delete", merge_at: "Merge", cut_along: "Cut", split_at: "Split", move_sites: "Move",
  move_vertices: "Move vertex", remove_vertices: "Remove vertex",
  set_channel: "Set filter", overlay: "Layer", clip: "Clip", cut_out: "Cut out", inset: "Inset", snap: "Snap to grid",
  split: "Split all", merge_small: "Merge small sites",
  node: "Add shared vertices", repair: "Repair", rotate: "Rotate", scale: "Scale",
};
// Values of parameters that are words.
export const CHOICES = { overlap: ["cut", "fill", "keep"], operation: ["replace", "fill", "union", "clip", "cut_out"],
  cut: ["pieces", "drop"] };

const isPoint = (value) => Array.isArray(value) && value.length === 2 && value.every((v) => typeof v === "number");
const figure = (value) => shown(Number(value.toPrecision(4)));
const count = (n, what) => shown(n) + " " + what + (n === 1 ? "" : "s");

// Rings or lines of an edit, each a list of positions; positions of sites and vertices are single ones.
export function pathsOf(edit) {
  const { outlines_um: outlines, line_um: line, region, points_um: points, from_um: from, to_um: to } = edit;
  if (Array.isArray(outlines)) return outlines.filter((ring) => Array.isArray(ring)
    && ring.every(isPoint)).map((ring) => ({ points: ring, isClosed: true }));
  if (Array.isArray(region) && region.every(isPoint)) return [{ points: region, isClosed: true }];
  if (Array.isArray(line) && line.every(isPoint)) return [{ points: line }];
  if (Array.isArray(from) && Array.isArray(to)) return from.map((point, i) => ({ points: [point, to[i]].filter(isPoint) }));
  return (Array.isArray(points) ? points : []).filter(isPoint).map((point) => ({ points: [point] }));
}

export function boxOf(points) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [x, y] of points) {
    box[0] = Math.min(box[0], x);
    box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x);
    box[3] = Math.max(box[3], y);
  }
  return Number.isFinite(box[0]) ? box : null;
}

// Name of an edit, and its numbers in words.
export function describe(edit) {
  const name = NAMES[edit.kind] || String(edit.kind).replaceAll("_", " "), box = boxOf(pathsOf(edit).flatMap((path) => path.points));
  const size = box ? figure(box[2] - box[0]) + " × " + figure(box[3] - box[1]) + " µm" : "";
  const detail = () => {
    switch (edit.kind) {
      case "draw": return (edit.outlines_um.length === 1 ? shown(edit.outlines_um[0].length) + " vertices"
        : count(edit.outlines_um.length, "outline")) + ", " + size;
      case "cut_along": return "line, " + size;
      case "split_at": return count(edit.points_um.length, "site") + " into " + (edit.n_x ?? 2) + " × " + (edit.n_y ?? 1);
      case "move_sites": return count(edit.points_um.length, "site") + " by " + edit.by_um.map(figure).join(", ") + " µm";
      case "move_vertices": return edit.from_um.length === 1
        ? "by " + [0, 1].map((k) => figure(edit.to_um[0][k] - edit.from_um[0][k])).join(", ") + " µm"
          : shown(edit.from_um.length) + " vertices";
      case "overlay": return (edit.layer?.generator || "file").replaceAll("_", " ") + ", "
        + (edit.operation || "replace").replaceAll("_", " ");
      case "set_channel": return count(edit.points_um.length, "site") + ", filter " + edit.channel;
      case "remove_at": case "merge_at": return count(edit.points_um.length, "site");
      case "remove_vertices": return shown(edit.points_um.length);
      default: return Object.entries(edit).filter(([, value]) => typeof value === "number").map(([key, value]) =>
        key.replace(/_(um|deg)$/, "").replaceAll("_", " ") + " " + figure(value)
          + (/_um$/.test(key) ? " µm" : /_deg$/.test(key) ? "°" : "")).join(", ");
    }
  };
  try { return { name, detail: detail() }; } catch { return { name, detail: "" }; }
}

// Rings of a site as lists of positions.
export function ringsOf(sites, site) {
  const { xy, position, ringOffsets } = sites, rings = [];
  for (let ring = sites.firstRing(site); ring < sites.firstRing(site + 1); ring++) {
    rings.push(Array.from(position.subarray(ringOffsets[ring], ringOffsets[ring + 1]), (p) => [xy[2 * p], xy[2 * p + 1]]));
  }
  return rings;
}

// A position inside a site: its centroid, or the centre of the widest part of a horizontal line through it.
export function pointIn(sites, site) {
  const [cx, cy] = sites.centre(site);
  if (sites.holds(site, cx, cy)) return [cx, cy];
  const [, low, , high] = sites.box.subarray(4 * site, 4 * site + 4);
  let best = [cx, cy], widest = 0;
  for (const fraction of [0.5, 0.25, 0.75, 0.375, 0.625, 0.1, 0.9]) {
    const y = low + fraction * (high - low), crossings = [];
    eachEdge(sites, site, (ax, ay, bx, by) => { if (ay > y !== by > y) crossings.push(ax + ((y - ay) / (by - ay)) * (bx - ax)); });
    crossings.sort((a, b) => a - b);
    for (let k = 0; k + 1 < crossings.length; k += 2) {
      if (crossings[k + 1] - crossings[k] > widest) {
        widest = crossings[k + 1] - crossings[k];
        best = [0.5 * (crossings[k] + crossings[k + 1]), y];
      }
    }
  }
  return best;
}
