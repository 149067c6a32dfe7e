// Area-correct picture of the view: each pixel shows the mean of the sites in it, weighted by their areas in the pixel. Numbers
// are averaged before they are mapped to a colour, other colours are averaged in linear light.

import { bytesOfHex } from "./colours.js";
import { pixelRatio } from "./gl.js";

// Sites of at least this many pixels are drawn well enough without averaging.
const LARGE_PIXELS = 3;
// Covered fractions of a pixel up to this are rounding errors.
const NO_COVERAGE = 1e-3;
// Slower pictures are drawn when the view rests for a moment.
const FRAME_MS = 25;
const REST_MS = 120;

const LINEAR = Float64Array.from({ length: 256 }, (_, i) => (i / 255 <= 0.04045 ? i / 255 / 12.92 : ((i / 255 + 0.055) / 1.055) ** 2.4));
const encoded = (light) => 255 * (light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055);

export class Overview {
  constructor(canvas, sites) {
    this.canvas = canvas;
    this.sites = sites;
    this.smallest = Infinity;
    for (let i = 0; i < sites.box.length; i += 4) {
      this.smallest = Math.min(this.smallest, Math.max(sites.box[i + 2] - sites.box[i], sites.box[i + 3] - sites.box[i + 1]));
    }
    this.ms = 0;
    this.resting = 0;
  }

  // Draws the view now, or hides the picture until the view rests.
  update(map, scale, range) {
    clearTimeout(this.resting);
    this.resting = 0;
    this.canvas.hidden = true;
    if (!this.isNeeded(map)) return;
    if (this.ms < FRAME_MS) this.draw(map, scale, range);
    else this.resting = setTimeout(() => { this.resting = 0; this.draw(map, scale, range); }, REST_MS);
  }

  // Whether there are sites of a few pixels only.
  isNeeded(map) { return this.smallest * map.scale * pixelRatio() < LARGE_PIXELS; }

  draw(map, scale, range) {
    const start = performance.now(), { canvas } = this;
    canvas.width = map.canvas.width;
    canvas.height = map.canvas.height;
    const context = canvas.getContext("2d", { willReadFrequently: true }), picture = context.createImageData(canvas.width, canvas.height);
    if (scale.canMap && !range) this._drawNumbers(map, scale, picture);
    else this._drawColours(map, picture);
    context.putImageData(picture, 0, 0);
    canvas.hidden = false;
    this.ms = performance.now() - start;
  }

  _drawNumbers(map, scale, { data, width, height }) {
    const { values, from, to } = scale, noData = bytesOfHex(scale.palette.no_data), span = to - from;
    // Covered fraction, the same of sites without a value, and the sum of the fractions of the scale.
    const [covered, missing, sum] = this._integrate(map, width, height, 3, (site, parts) => {
      const value = (values[site] - from) / span, hasValue = Number.isFinite(value);
      parts[0] = 1;
      parts[1] = hasValue ? 0 : 1;
      parts[2] = hasValue ? value : 0;
    });
    for (let p = 0; p < covered.length; p++) {
      if (covered[p] <= NO_COVERAGE) continue;
      const valid = covered[p] - missing[p], share = valid / covered[p];
      const shade = share > NO_COVERAGE ? scale.shade(from + (span * sum[p]) / valid) : noData;
      for (let c = 0; c < 3; c++) {
        data[4 * p + c] = share >= 1 - NO_COVERAGE ? shade[c] : encoded(share * LINEAR[shade[c]] + (1 - share) * LINEAR[noData[c]]);
      }
      data[4 * p + 3] = 255 * Math.min(1, covered[p]);
    }
  }

  _drawColours(map, { data, width, height }) {
    const [covered, ...light] = this._integrate(map, width, height, 4, (site, parts) => {
      const colour = map.colours[site];
      parts[0] = 1;
      for (let c = 0; c < 3; c++) parts[1 + c] = LINEAR[(colour >>> (8 * c)) & 255];
    });
    for (let p = 0; p < covered.length; p++) {
      if (covered[p] <= NO_COVERAGE) continue;
      for (let c = 0; c < 3; c++) data[4 * p + c] = encoded(Math.min(1, Math.max(0, light[c][p] / covered[p])));
      data[4 * p + 3] = 255 * Math.min(1, covered[p]);
    }
  }

  // Returns n pictures: the integral over each pixel of n quantities that are constant on every site. Exact for polygons: an
  // edge adds its area to its own pixels, and the running sum along the row its height to all pixels on its right.
  _integrate(map, width, height, n, quantitiesOf) {
    const { sites } = this, { xy, position, ringOffsets, box } = sites, ratio = map.canvas.width / map.width, step = map.scale * ratio;
    const row = width + 2, sums = Array.from({ length: n }, () => new Float64Array(row * height)), parts = new Float64Array(n);
    const left = map.fromX(0), top = map.fromY(0), right = map.fromX(map.width), bottom = map.fromY(map.height);
    const add = (at, area) => { for (let k = 0; k < n; k++) sums[k][at] += area * parts[k]; };
    const addEdge = (ax, ay, bx, by) => {
      const isDown = ay < by, [x0, y0, x1, y1] = isDown ? [ax, ay, bx, by] : [bx, by, ax, ay];
      const slope = (x1 - x0) / (y1 - y0), sign = isDown ? 1 : -1, last = Math.min(height, Math.ceil(y1));
      for (let y = Math.max(0, Math.floor(y0)); y < last; y++) {
        const from = Math.max(y, y0), to = Math.min(y + 1, y1), rise = sign * (to - from);
        const u = x0 + (from - y0) * slope, v = x0 + (to - y0) * slope;
        const low = Math.min(width, Math.max(0, Math.min(u, v))), high = Math.min(width, Math.max(0, Math.max(u, v)));
        const first = Math.floor(low), end = Math.ceil(high), line = y * row;
        if (end <= first + 1) {
          const beyond = 0.5 * (low + high) - first;
          add(line + first, rise * (1 - beyond));
          add(line + first + 1, rise * beyond);
          continue;
        }
        // The edge crosses several pixels of the row; before is the area to the right of it in all pixels so far.
        const perPixel = 1 / (high - low);
        let before = 0;
        for (let x = first; x < end; x++) {
          const a = Math.max(x, low), b = Math.min(x + 1, high), inside = (b - a) * perPixel;
          const area = inside * (x + 1 - 0.5 * (a + b)) + (a - low) * perPixel;
          add(line + x, rise * (area - before));
          before = area;
        }
        add(line + end, rise * (1 - before));
      }
    };
    for (let site = 0; site < sites.n; site++) {
      const at = 4 * site;
      if (box[at] > right || box[at + 2] < left || box[at + 1] > top || box[at + 3] < bottom) continue;
      quantitiesOf(site, parts);
      for (let ring = sites.firstRing(site); ring < sites.firstRing(site + 1); ring++) {
        const stop = ringOffsets[ring + 1];
        let p = 2 * position[stop - 1], ax = (xy[p] - left) * step, ay = (top - xy[p + 1]) * step;
        for (let v = ringOffsets[ring]; v < stop; v++) {
          p = 2 * position[v];
          const bx = (xy[p] - left) * step, by = (top - xy[p + 1]) * step;
          if (ay !== by && Math.max(ay, by) > 0 && Math.min(ay, by) < height) addEdge(ax, ay, bx, by);
          ax = bx;
          ay = by;
        }
      }
    }
    return sums.map((sum) => {
      const picture = new Float64Array(width * height);
      for (let y = 0; y < height; y++) {
        let total = 0;
        for (let x = 0; x < width; x++) picture[y * width + x] = total += sum[y * row + x];
      }
      return picture;
    });
  }
}
