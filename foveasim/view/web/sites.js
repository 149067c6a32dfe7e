// Photosites: exact outlines, sites under a point, and triangles to draw.

import { offsetsOf, positionsOf } from "./unpack.js";

export class Sites {
  /** @type {Float64Array | undefined} */ _sizes;
  // Boxes in µm, and areas in µm².
  /** @type {Float64Array} */ box;
  /** @type {Float64Array} */ area;
  // Longer side of the smallest box in µm.
  smallest = Infinity;
  // Bins: columns, rows, both per µm, and the sites of all bins.
  nx = 1; ny = 1; perX = 1; perY = 1;
  /** @type {Uint32Array} */ binOffsets;
  /** @type {Uint32Array} */ inBin;

  /** @param {Arrays} arrays @param {SitesAbout} about */
  constructor(arrays, about) {
    this.n = about.n_sites;
    this.bounds = about.bounds_um;
    this.xy = arrays.xy_um;
    this.ringOffsets = offsetsOf(arrays.ring_sizes);
    this.siteOffsets = arrays.site_rings ? offsetsOf(arrays.site_rings) : null;
    this.position = positionsOf(arrays.position);
    this.cuts = { sites: arrays.cut_sites, counts: arrays.cut_counts, corners: arrays.cuts };
    this._measure();
    this._sortIntoBins();
  }

  // Square roots of the areas.
  get sizes() {
    this._sizes ||= this.area.map(Math.sqrt);
    return this._sizes;
  }

  /** @param {number} site */
  firstRing(site) { return this.siteOffsets ? this.siteOffsets[site] : site; }
  /** @param {number} site */
  firstVertex(site) { return this.ringOffsets[this.firstRing(site)]; }

  // Boxes and areas of all sites, and the longer side of the smallest box; holes have the opposite winding, so that their areas subtract.
  _measure() {
    const { n, xy, position, ringOffsets } = this;
    this.box = new Float64Array(4 * n);
    this.area = new Float64Array(n);
    let smallest = Infinity;
    for (let site = 0; site < n; site++) {
      let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity, twice = 0;
      const ax = xy[2 * position[this.firstVertex(site)]], ay = xy[2 * position[this.firstVertex(site)] + 1];
      for (let ring = this.firstRing(site); ring < this.firstRing(site + 1); ring++) {
        const from = ringOffsets[ring], to = ringOffsets[ring + 1];
        let px = xy[2 * position[to - 1]] - ax, py = xy[2 * position[to - 1] + 1] - ay;
        for (let v = from; v < to; v++) {
          const x = xy[2 * position[v]], y = xy[2 * position[v] + 1];
          if (x < x0) x0 = x;
          if (x > x1) x1 = x;
          if (y < y0) y0 = y;
          if (y > y1) y1 = y;
          const qx = x - ax, qy = y - ay;
          twice += px * qy - py * qx;
          px = qx; py = qy;
        }
      }
      this.box[4 * site] = x0;
      this.box[4 * site + 1] = y0;
      this.box[4 * site + 2] = x1;
      this.box[4 * site + 3] = y1;
      this.area[site] = twice / 2;
      const side = x1 - x0 > y1 - y0 ? x1 - x0 : y1 - y0;
      if (side < smallest) smallest = side;
    }
    this.smallest = smallest;
  }

  // A grid of bins, each with the sites whose boxes intersect it; coarser where boxes are large or many overlap.
  _sortIntoBins() {
    const [x0, y0, x1, y1] = this.bounds, { n, box } = this;
    const width = Math.max(x1 - x0, 1e-12), height = Math.max(y1 - y0, 1e-12);
    // Columns and rows of the first and last bin of each site.
    const spans = new Uint16Array(4 * n);
    for (let wanted = Math.max(n, 1); ; wanted /= 4) {
      const side = Math.sqrt((width * height) / wanted);
      this.nx = Math.min(4096, Math.max(1, Math.round(width / side)));
      this.ny = Math.min(4096, Math.max(1, Math.round(height / side)));
      this.perX = this.nx / width;
      this.perY = this.ny / height;
      let total = 0;
      for (let at = 0; at < 4 * n; at += 4) {
        for (let k = 0; k < 4; k += 2) {
          spans[at + k] = this._column(box[at + k]);
          spans[at + k + 1] = this._row(box[at + k + 1]);
        }
        total += (spans[at + 2] - spans[at] + 1) * (spans[at + 3] - spans[at + 1] + 1);
      }
      if (total <= 16 * n + 4096 || wanted < 1) break;
    }
    /** @param {(bin: number, site: number) => void} visit */
    const eachBin = (visit) => {
      for (let site = 0; site < n; site++) {
        const last = spans[4 * site + 2], top = spans[4 * site + 3];
        for (let row = spans[4 * site + 1]; row <= top; row++) {
          for (let column = spans[4 * site]; column <= last; column++) visit(row * this.nx + column, site);
        }
      }
    };
    const counts = new Uint32Array(this.nx * this.ny);
    eachBin((bin) => { counts[bin]++; });
    this.binOffsets = offsetsOf(counts);
    this.inBin = new Uint32Array(this.binOffsets[counts.length]);
    const next = this.binOffsets.slice();
    eachBin((bin, site) => { this.inBin[next[bin]++] = site; });
  }

  /** @param {number} x */
  _column(x) { return Math.min(this.nx - 1, Math.max(0, Math.floor((x - this.bounds[0]) * this.perX))); }
  /** @param {number} y */
  _row(y) { return Math.min(this.ny - 1, Math.max(0, Math.floor((y - this.bounds[1]) * this.perY))); }

  // All sites that contain a point, in ascending order. A point on a boundary belongs to the site on its +x side,
  // on a horizontal boundary to the site on its +y side.
  /** @type {(x: number, y: number) => number[]} */
  pickAll(x, y) {
    /** @type {number[]} */
    const found = [];
    const [x0, y0, x1, y1] = this.bounds;
    if (!(x >= x0 && x <= x1 && y >= y0 && y <= y1)) return found;
    const bin = this._row(y) * this.nx + this._column(x);
    for (let i = this.binOffsets[bin]; i < this.binOffsets[bin + 1]; i++) {
      if (this.holds(this.inBin[i], x, y)) found.push(this.inBin[i]);
    }
    return found;
  }

  // The last, and thus uppermost, site that contains a point; -1 for none.
  /** @type {(x: number, y: number) => number} */
  pick(x, y) { return this.pickAll(x, y).at(-1) ?? -1; }

  /** @param {number} site @param {number} x @param {number} y */
  holds(site, x, y) {
    const { box, xy, position, ringOffsets } = this, at = 4 * site;
    if (x < box[at] || y < box[at + 1] || x > box[at + 2] || y > box[at + 3]) return false;
    let inside = false;
    for (let ring = this.firstRing(site); ring < this.firstRing(site + 1); ring++) {
      const to = ringOffsets[ring + 1];
      let p = 2 * position[to - 1];
      for (let v = ringOffsets[ring]; v < to; v++) {
        const q = 2 * position[v], py = xy[p + 1], qy = xy[q + 1];
        if (py > y !== qy > y) {
          // From the lower end in both directions, so that both sites of the edge agree bit-identically.
          const low = py < qy ? p : q, high = py < qy ? q : p;
          const fraction = (y - xy[low + 1]) / (xy[high + 1] - xy[low + 1]);
          if (x < xy[low] + fraction * (xy[high] - xy[low])) inside = !inside;
        }
        p = q;
      }
    }
    return inside;
  }

  // Sites whose boxes intersect a rectangle, or null when there are more than a limit.
  /** @type {(x0: number, y0: number, x1: number, y1: number, limit: number) => Set<number> | null} */
  within(x0, y0, x1, y1, limit) {
    const a = this._column(x0), b = this._row(y0), c = this._column(x1), d = this._row(y1), { box } = this;
    const found = new Set();
    for (let row = b; row <= d; row++) {
      const from = this.binOffsets[row * this.nx + a], to = this.binOffsets[row * this.nx + c + 1];
      if (to - from > 16 * limit) return null;
      for (let i = from; i < to; i++) {
        const site = this.inBin[i], at = 4 * site;
        if (box[at] > x1 || box[at + 2] < x0 || box[at + 1] > y1 || box[at + 3] < y0) continue;
        found.add(site);
        if (found.size > limit) return null;
      }
    }
    return found;
  }

  /** @type {(site: number) => Point} */
  centre(site) {
    const { xy, position, ringOffsets } = this;
    const a = 2 * position[this.firstVertex(site)], ax = xy[a], ay = xy[a + 1];
    let twice = 0, mx = 0, my = 0;
    for (let ring = this.firstRing(site); ring < this.firstRing(site + 1); ring++) {
      const to = ringOffsets[ring + 1];
      let px = xy[2 * position[to - 1]] - ax, py = xy[2 * position[to - 1] + 1] - ay;
      for (let v = ringOffsets[ring]; v < to; v++) {
        const qx = xy[2 * position[v]] - ax, qy = xy[2 * position[v] + 1] - ay, cross = px * qy - py * qx;
        twice += cross;
        mx += (px + qx) * cross;
        my += (py + qy) * cross;
        px = qx; py = qy;
      }
    }
    return [ax + mx / (3 * twice), ay + my / (3 * twice)];
  }

  // Corners of all triangles, by tiles of the layout, so that tiles out of view need not be drawn.
  triangles() {
    const { n, box, cuts } = this, [x0, y0, x1, y1] = this.bounds;
    const side = Math.max(1, Math.min(64, Math.round(Math.sqrt(n / 1500))));
    const counts = new Uint32Array(side * side), tileOf = new Uint16Array(n);
    for (let site = 0; site < n; site++) {
      const u = (0.5 * (box[4 * site] + box[4 * site + 2]) - x0) / (x1 - x0 || 1);
      const v = (0.5 * (box[4 * site + 1] + box[4 * site + 3]) - y0) / (y1 - y0 || 1);
      tileOf[site] = Math.min(side - 1, Math.floor(v * side)) * side + Math.min(side - 1, Math.floor(u * side));
      counts[tileOf[site]]++;
    }
    const tileOffsets = offsetsOf(counts), next = tileOffsets.slice(), order = new Uint32Array(n);
    for (let site = 0; site < n; site++) order[next[tileOf[site]]++] = site;

    const cutOf = new Map(), cutOffsets = offsetsOf(cuts.counts);
    cuts.sites.forEach((site, i) => cutOf.set(site, i));
    let total = cuts.corners.length;
    for (let site = 0; site < n; site++) {
      if (!cutOf.size || !cutOf.has(site)) total += 3 * (this.firstVertex(site + 1) - this.firstVertex(site) - 2);
    }
    const corners = new Uint32Array(total), tiles = [];
    let at = 0;
    for (let tile = 0; tile < counts.length; tile++) {
      const reach = [Infinity, Infinity, -Infinity, -Infinity], from = at;
      for (let i = tileOffsets[tile]; i < tileOffsets[tile + 1]; i++) {
        const site = order[i], b = 4 * site;
        if (box[b] < reach[0]) reach[0] = box[b];
        if (box[b + 1] < reach[1]) reach[1] = box[b + 1];
        if (box[b + 2] > reach[2]) reach[2] = box[b + 2];
        if (box[b + 3] > reach[3]) reach[3] = box[b + 3];
        const cut = cutOf.size ? cutOf.get(site) : undefined;
        if (cut === undefined) {
          const first = this.firstVertex(site), last = this.firstVertex(site + 1);
          for (let v = first + 1; v < last - 1; v++) {
            corners[at++] = first;
            corners[at++] = v;
            corners[at++] = v + 1;
          }
        } else {
          for (let k = 3 * cutOffsets[cut]; k < 3 * cutOffsets[cut + 1]; k++) corners[at++] = cuts.corners[k];
        }
      }
      if (at > from) tiles.push({ reach, from, to: at });
    }
    return { corners, tiles };
  }

  // Traces the rings of a site on a canvas, through a function from µm to pixels.
  /** @param {CanvasRenderingContext2D} context @param {number} site @param {View} view */
  trace(context, site, view) {
    const { xy, position, ringOffsets } = this;
    for (let ring = this.firstRing(site); ring < this.firstRing(site + 1); ring++) {
      for (let v = ringOffsets[ring]; v < ringOffsets[ring + 1]; v++) {
        const p = 2 * position[v], x = view.toX(xy[p]), y = view.toY(xy[p + 1]);
        if (v === ringOffsets[ring]) context.moveTo(x, y);
        else context.lineTo(x, y);
      }
      context.closePath();
    }
  }
}
