// Boundary of a layout: edges of its outlines that no two photosites have in common.

// More edges than this are drawn as the bounding box only.
const MOST_EDGES = 20000;

// Returns a function that traces the boundary on a context through conversions from µm to pixels.
export function boundaryOf(sites) {
  const edges = outerEdges(sites), [x0, y0, x1, y1] = sites.bounds, { xy } = sites;
  // Photosites with gaps have no common edges: the box is more legible than all of them.
  const isBox = edges.length / 2 > Math.min(MOST_EDGES, 24 * Math.sqrt(sites.n) + 64);
  return (context, toX, toY) => {
    if (isBox) {
      context.rect(toX(x0), toY(y1), toX(x1) - toX(x0), toY(y0) - toY(y1));
      return;
    }
    for (let i = 0; i < edges.length; i += 2) {
      context.moveTo(toX(xy[2 * edges[i]]), toY(xy[2 * edges[i] + 1]));
      context.lineTo(toX(xy[2 * edges[i + 1]]), toY(xy[2 * edges[i + 1] + 1]));
    }
  };
}

// Pairs of positions of the edges that occur once.
function outerEdges({ position, ringOffsets }) {
  const n = position.length, size = 2 ** Math.ceil(Math.log2(4 * n + 16)), table = new Int32Array(size).fill(-1);
  const next = new Uint32Array(n), count = new Uint8Array(n);
  for (let ring = 0; ring + 1 < ringOffsets.length; ring++) {
    for (let v = ringOffsets[ring], to = ringOffsets[ring + 1]; v < to; v++) next[v] = v + 1 < to ? v + 1 : ringOffsets[ring];
  }
  for (let v = 0; v < n; v++) {
    const a = Math.min(position[v], position[next[v]]), b = Math.max(position[v], position[next[v]]);
    let at = (Math.imul(a, 0x9e3779b1) ^ Math.imul(b, 0x85ebca6b)) & (size - 1);
    for (; table[at] >= 0; at = (at + 1) & (size - 1)) {
      const w = table[at];
      if (Math.min(position[w], position[next[w]]) === a && Math.max(position[w], position[next[w]]) === b) break;
    }
    if (table[at] < 0) table[at] = v;
    count[table[at]]++;
  }
  const found = [];
  for (let v = 0; v < n; v++) if (count[v] === 1) found.push(position[v], position[next[v]]);
  return found;
}
