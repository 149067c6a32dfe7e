// Decodes surfaces of a page: from data per photosite to vertices and triangles for the graphics card.

import { offsetsOf, positionsOf } from "./unpack.js";

export class Bodies {
  // about: { lattice_um, origin_um, low_um, high_um, list: [{ name, n_runs, n_tiles }] }; arrays by their names in the page.
  constructor(about, arrays) {
    this.lattice = about.lattice_um;
    this.origin = about.origin_um;
    this.low = about.low_um;
    this.high = about.high_um;
    this.arrays = arrays;
    this.x = runningSum(arrays.position_x);
    this.y = runningSum(arrays.position_y);
    this.firstPoint = offsetsOf(arrays.run_points);
    this.firstTriangle = offsetsOf(arrays.run_triangles);
    this.position = positionsOf(arrays.positions);
    let run = 0, tile = 0;
    this.list = about.list.map(({ name, n_runs, n_tiles }) => {
      const body = { name, runs: [run, run + n_runs], tiles: [tile, tile + n_tiles] };
      run += n_runs;
      tile += n_tiles;
      body.nTriangles = this.firstTriangle[run] - this.firstTriangle[run - n_runs];
      return body;
    });
  }

  // Vertices on the lattice, site + 1 of each vertex, corners, and tiles with their boxes on the lattice.
  build(body) {
    const { x, y, position, firstPoint, firstTriangle } = this, { z, corners, run_sites: runSites, tile_runs: tileRuns } = this.arrays;
    const [fromRun, toRun] = body.runs, base = firstPoint[fromRun], n = firstPoint[toRun] - base;
    const positions = new Int32Array(3 * n), sites = new Uint32Array(n);
    const indices = new Uint32Array(3 * body.nTriangles), tiles = [];
    let run = fromRun, at = 0;
    for (let t = body.tiles[0]; t < body.tiles[1]; t++) {
      const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity], from = at;
      for (const end = run + tileRuns[t]; run < end; run++) {
        const first = firstPoint[run] - base;
        for (let p = first; p < firstPoint[run + 1] - base; p++) {
          const u = x[position[base + p]], v = y[position[base + p]], w = z[base + p];
          positions[3 * p] = u;
          positions[3 * p + 1] = v;
          positions[3 * p + 2] = w;
          if (u < box[0]) box[0] = u;
          if (v < box[1]) box[1] = v;
          if (w < box[2]) box[2] = w;
          if (u > box[3]) box[3] = u;
          if (v > box[4]) box[4] = v;
          if (w > box[5]) box[5] = w;
        }
        sites.fill(runSites[run], first, firstPoint[run + 1] - base);
        for (let k = 3 * firstTriangle[run]; k < 3 * firstTriangle[run + 1]; k++) indices[at++] = first + corners[k];
      }
      if (at > from) tiles.push({ box, from, to: at });
    }
    return { positions, sites, indices, tiles };
  }

  // Colours of a body, at most so many, in CSS.
  coloursOf(body, most) {
    const colours = this.arrays.run_colours, found = new Set();
    for (let run = body.runs[0]; run < body.runs[1] && found.size < most; run++) {
      found.add("rgb(" + colours[3 * run] + "," + colours[3 * run + 1] + "," + colours[3 * run + 2] + ")");
    }
    return [...found];
  }

  // Colours of the sites of a body as bytes r, g, b, a, at index site + 1.
  paint(body, bytes) {
    const { run_sites: runSites, run_colours: colours } = this.arrays;
    for (let run = body.runs[0]; run < body.runs[1]; run++) {
      const at = 4 * runSites[run];
      bytes[at] = colours[3 * run];
      bytes[at + 1] = colours[3 * run + 1];
      bytes[at + 2] = colours[3 * run + 2];
      bytes[at + 3] = 255;
    }
  }
}

function runningSum(steps) {
  const sums = new Int32Array(steps.length);
  for (let i = 0, sum = 0; i < steps.length; i++) sums[i] = sum += steps[i];
  return sums;
}
