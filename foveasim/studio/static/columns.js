// Photosites as prisms for SolidView: the outlines of a layout, whose heights the graphics card reads from a table.

// Positions as integers: number of steps along the longer side of the layout.
const STEPS = 2 ** 30;
// Height of the tallest prism as a fraction of the longer side.
const TALLEST = 0.15;

export class Columns {
  constructor(sites) {
    const [x0, y0, x1, y1] = sites.bounds, extent = Math.max(x1 - x0, y1 - y0);
    this.sites = sites;
    this.lattice = extent / STEPS;
    this.origin = [0.5 * (x0 + x1), 0.5 * (y0 + y1), 0];
    this.low = [x0, y0, 0];
    this.high = [x1, y1, TALLEST * extent];
    this.tallest = TALLEST * STEPS;
    this.list = [{ name: "columns" }];
  }

  // Vertices at the bottom, then at the top; z is 0 and 1. Triangles of walls and tops by the tiles of the layout.
  build() {
    const { sites, lattice, origin } = this, { xy, position } = sites, n = position.length;
    const positions = new Int32Array(6 * n), owners = new Uint32Array(2 * n), after = new Uint32Array(n);
    for (let v = 0; v < n; v++) {
      const p = 2 * position[v], x = Math.round((xy[p] - origin[0]) / lattice), y = Math.round((xy[p + 1] - origin[1]) / lattice);
      positions[3 * v] = positions[3 * (v + n)] = x;
      positions[3 * v + 1] = positions[3 * (v + n) + 1] = y;
      positions[3 * (v + n) + 2] = 1;
    }
    for (let site = 0; site < sites.n; site++) {
      const from = sites.firstVertex(site), to = sites.firstVertex(site + 1);
      owners.fill(site + 1, from, to);
      owners.fill(site + 1, n + from, n + to);
      for (let ring = sites.firstRing(site); ring < sites.firstRing(site + 1); ring++) {
        for (let v = sites.ringOffsets[ring], end = sites.ringOffsets[ring + 1]; v < end; v++) after[v] = v + 1 < end ? v + 1
          : sites.ringOffsets[ring];
      }
    }
    const { corners, tiles: flat } = sites.triangles(), indices = new Uint32Array(corners.length + 6 * n), tiles = [];
    let at = 0;
    for (const { reach, from, to } of flat) {
      const start = at;
      let owner = -1;
      for (let i = from; i < to; i += 3) {
        if (owners[corners[i]] !== owner) {
          owner = owners[corners[i]];
          for (let v = sites.firstVertex(owner - 1); v < sites.firstVertex(owner); v++) {
            const w = after[v];
            indices[at++] = v;
            indices[at++] = w;
            indices[at++] = w + n;
            indices[at++] = v;
            indices[at++] = w + n;
            indices[at++] = v + n;
          }
        }
        indices[at++] = corners[i] + n;
        indices[at++] = corners[i + 1] + n;
        indices[at++] = corners[i + 2] + n;
      }
      const [x0, y0, x1, y1] = reach.map((v, axis) => (v - origin[axis % 2]) / lattice);
      tiles.push({ box: [x0, y0, 0, x1, y1, this.tallest], from: start, to: at });
    }
    return { positions, sites: owners, indices: indices.subarray(0, at), tiles };
  }

  // Colours are those of the map.
  paint() {}

  coloursOf() { return []; }
}
