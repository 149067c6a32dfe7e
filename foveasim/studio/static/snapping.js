// Snapping of positions to vertices, midpoints and edges of photosites and to a grid, and to directions of 0, 45 and 90 degrees.

// Distance in CSS pixels within which a position snaps.
export const REACH = 9;
// Where more sites than this are that near, only the grid counts.
const MOST_SITES = 500;
/** @typedef {{ sites: any, points?: any[], isExcluded?: Function, isSkipped?: Function, kinds?: string[] }} Where */
const KINDS = ["vertex", "midpoint", "edge"];
// Digits of positions on the grid, in µm.
const DIGITS = 9;

export const onGrid = (value, step) => Number((Math.round(value / step) * step).toFixed(DIGITS));

// Calls visit(ax, ay, bx, by, site) for the edges of a site.
export function eachEdge(sites, site, visit) {
  const { xy, position, ringOffsets } = sites;
  for (let ring = sites.firstRing(site); ring < sites.firstRing(site + 1); ring++) {
    const to = ringOffsets[ring + 1];
    let p = 2 * position[to - 1];
    for (let v = ringOffsets[ring]; v < to; v++) {
      const q = 2 * position[v];
      visit(xy[p], xy[p + 1], xy[q], xy[q + 1], site);
      p = q;
    }
  }
}

// Nearest position on a segment, with its fraction of the length.
export function nearestOn(x, y, ax, ay, bx, by) {
  const dx = bx - ax, dy = by - ay, length2 = dx * dx + dy * dy;
  const t = length2 > 0 ? Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / length2)) : 0;
  return { x: ax + t * dx, y: ay + t * dy, t };
}

// Returns the nearest vertex, midpoint and edge within a distance in µm, each { x, y, kind, distance } or null.
// points are further vertices, [x, y]; isExcluded(site) and isSkipped(x, y) exclude some; kinds are the ones of interest.
/** @type {(x: number, y: number, reach: number, where: Where) => any} */
export function featuresNear(x, y, reach, { sites, points = [], isExcluded, isSkipped, kinds = KINDS }) {
  const found = { vertex: null, midpoint: null, edge: null };
  const offer = (kind, px, py, more) => {
    const distance = Math.hypot(px - x, py - y);
    if (distance <= (found[kind]?.distance ?? reach) && kinds.includes(kind) && !isSkipped?.(px, py)) {
      found[kind] = { x: px, y: py, kind, distance, ...more };
    }
  };
  for (const [px, py] of points) offer("vertex", px, py);
  for (const site of sites?.within(x - reach, y - reach, x + reach, y + reach, MOST_SITES) || []) {
    if (isExcluded?.(site)) continue;
    eachEdge(sites, site, (ax, ay, bx, by) => {
      if (Math.max(ax, bx) < x - reach || Math.min(ax, bx) > x + reach || Math.max(ay, by) < y - reach
        || Math.min(ay, by) > y + reach) return;
      offer("vertex", bx, by);
      offer("vertex", ax, ay);
      offer("midpoint", 0.5 * (ax + bx), 0.5 * (ay + by));
      const at = nearestOn(x, y, ax, ay, bx, by);
      offer("edge", at.x, at.y, { segment: [ax, ay, bx, by] });
    });
  }
  return found;
}

// Snaps a position: to a vertex, a midpoint, an edge, else the grid. With `from` and isStraight, to a direction from there;
// with isFree, to nothing. Returns { x, y, kind }; scale is in pixels per µm, step that of the grid in µm.
export function snap(x, y, { scale, step, from, isStraight, isFree, sites, ...where }) {
  const near = isFree ? {} : featuresNear(x, y, REACH / scale, { sites, ...where });
  if (from && isStraight) return alongDirection(x, y, from, isFree ? null : step, near.vertex);
  if (isFree) return { x, y, kind: "free" };
  return near.vertex || near.midpoint || (near.edge && onLine(near.edge, step)) || { x: onGrid(x, step), y: onGrid(y, step), kind: "grid" };
}

// The position on an edge where it meets a line of the grid, if that is near.
function onLine(edge, step) {
  const { x, y, segment: [ax, ay, bx, by] } = edge, gx = onGrid(x, step), gy = onGrid(y, step), crossings = [];
  if (bx !== ax) crossings.push([gx, ay + ((gx - ax) / (bx - ax)) * (by - ay), (gx - ax) / (bx - ax)]);
  if (by !== ay) crossings.push([ax + ((gy - ay) / (by - ay)) * (bx - ax), gy, (gy - ay) / (by - ay)]);
  const [px, py] = crossings.filter(([, , t]) => t > 0 && t < 1).sort((a, b) =>
    Math.hypot(a[0] - x, a[1] - y) - Math.hypot(b[0] - x, b[1] - y))[0] || [x, y];
  return { ...edge, x: px, y: py };
}

function alongDirection(x, y, from, step, vertex) {
  const octant = Math.round(Math.atan2(y - from.y, x - from.x) / (Math.PI / 4)), ux = Math.round(Math.cos((octant * Math.PI) / 4));
  const uy = Math.round(Math.sin((octant * Math.PI) / 4));
  const round = (value) => (step ? onGrid(value, step) : value), kind = "direction";
  if (ux && uy) {
    const length = round(0.5 * (Math.abs(x - from.x) + Math.abs(y - from.y)));
    return { x: from.x + ux * length, y: from.y + uy * length, kind };
  }
  return ux ? { x: vertex ? vertex.x : round(x), y: from.y, kind } : { x: from.x, y: vertex ? vertex.y : round(y), kind };
}

// Returns the nearest vertex in a direction [ux, uy] from a position, for the arrow keys, or null.
export function nextVertex({ x, y }, [ux, uy], sites, reach) {
  /** @type {Snapped | null} */
  let found = null;
  let best = Infinity;
  for (const site of sites.within(x - reach, y - reach, x + reach, y + reach, 10 * MOST_SITES) || []) {
    eachEdge(sites, site, (ax, ay) => {
      const dx = ax - x, dy = ay - y, along = dx * ux + dy * uy, across = Math.abs(dx * uy - dy * ux);
      const cost = along + 2 * across;
      if (along > 1e-6 && across <= along && cost < best) { best = cost; found = { x: ax, y: ay, kind: "vertex" }; }
    });
  }
  return found;
}
