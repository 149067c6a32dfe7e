// The map without WebGL2: the sites at all sample points, found again when the view changes, and their colours from a table.

import { MapView } from "/web/map.js";
import { pixelRatio } from "/web/gl.js";

// Sites of at least this many pixels need one sample per pixel; smaller ones, and those below one pixel, more per side.
const LARGE_PIXELS = 3;
const FEW_SAMPLES = 2, MANY_SAMPLES = 3;
const MOST_SAMPLES = 1.2e7;
// Levels of linear light in the table of bytes.
const LEVELS = 4096;
const LINEAR = Float32Array.from({ length: 256 }, (_, i) => (i / 255 <= 0.04045 ? i / 255 / 12.92 : ((i / 255 + 0.055) / 1.055) ** 2.4));
const ENCODED = Uint8Array.from({ length: LEVELS }, (_, i) => {
  const light = i / (LEVELS - 1);
  return Math.round(255 * (light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055));
});

export class RasterMap extends MapView {
  constructor(canvas, sites) {
    super(canvas);
    this.context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
    this.use(sites);
  }

  use(sites) {
    super.use(sites);
    this.drawn = null;
    this.smallest = Infinity;
    for (let i = 0; i < sites.box.length; i += 4) this.smallest = Math.min(this.smallest, Math.max(sites.box[i + 2] - sites.box[i], sites.box[i + 3] - sites.box[i + 1]));
  }

  // Colours are read when the map is drawn.
  sendColours() {}

  get samples() {
    const { width, height } = this.canvas, pixels = this.smallest * this.scale * pixelRatio();
    const wanted = pixels >= LARGE_PIXELS ? 1 : pixels >= 1 ? FEW_SAMPLES : MANY_SAMPLES;
    return Math.max(1, Math.min(wanted, Math.floor(Math.sqrt(MOST_SAMPLES / (width * height)))));
  }

  draw(ground) {
    const { canvas } = this, { width, height } = canvas, n = this.samples, view = [this.x, this.y, this.scale, width, height, n].join();
    if (this.drawn !== view) {
      if (!this.owner || this.owner.length !== n * n * width * height) this.owner = new Uint32Array(n * n * width * height);
      ownersOf(this, n * width, n * height, this.owner);
      this.mixed = n === 1 ? null : mixedPixels(this.owner, width, height, n);
      if (!this.picture || this.picture.width !== width || this.picture.height !== height) this.picture = this.context.createImageData(width, height);
      if (this.table?.length !== this.sites.n + 1) this.table = new Uint32Array(this.sites.n + 1);
      this.drawn = view;
    }
    const pixels = new Uint32Array(this.picture.data.buffer), { table, owner, mixed } = this;
    table[0] = (255 << 24 | ground[2] << 16 | ground[1] << 8 | ground[0]) >>> 0;
    table.set(this.colours.subarray(0, this.sites.n), 1);
    const first = mixed ? mixed.first : owner;
    for (let p = 0; p < pixels.length; p++) pixels[p] = table[first[p]];
    if (mixed) averageSamples(pixels, mixed, table, n * n);
    this.context.putImageData(this.picture, 0, 0);
  }
}

// Returns the site of the first sample of every pixel, and the samples of the pixels with several sites.
function mixedPixels(owner, width, height, n) {
  const row = n * width, first = new Uint32Array(width * height), pixels = [], samples = [];
  for (let y = 0, p = 0; y < height; y++) {
    for (let x = 0, at = y * n * row; x < width; x++, p++, at += n) {
      const one = owner[at];
      first[p] = one;
      let isOne = true;
      for (let v = 0; isOne && v < n; v++) for (let u = 0; u < n; u++) if (owner[at + v * row + u] !== one) { isOne = false; break; }
      if (isOne) continue;
      pixels.push(p);
      for (let v = 0; v < n; v++) for (let u = 0; u < n; u++) samples.push(owner[at + v * row + u]);
    }
  }
  return { first, pixels: Uint32Array.from(pixels), samples: Uint32Array.from(samples) };
}

// Sets pixels with several sites to the mean of their samples in linear light.
function averageSamples(pixels, mixed, table, n) {
  const scale = (LEVELS - 1) / n, { samples } = mixed;
  for (let i = 0, k = 0; i < mixed.pixels.length; i++) {
    let red = 0, green = 0, blue = 0;
    for (const end = k + n; k < end; k++) {
      const colour = table[samples[k]];
      red += LINEAR[colour & 255];
      green += LINEAR[(colour >>> 8) & 255];
      blue += LINEAR[(colour >>> 16) & 255];
    }
    pixels[mixed.pixels[i]] = (255 << 24 | ENCODED[(blue * scale + 0.5) | 0] << 16 | ENCODED[(green * scale + 0.5) | 0] << 8 | ENCODED[(red * scale + 0.5) | 0]) >>> 0;
  }
}

// Finds the number of the site at every pixel centre plus 1, top row first; 0 for none. Later sites cover earlier ones.
export function ownersOf(view, width, height, owner = new Uint32Array(width * height)) {
  const { sites } = view, { xy, position, ringOffsets, box } = sites, step = (view.scale * width) / view.width;
  const left = view.fromX(0), top = view.fromY(0), right = view.fromX(view.width), bottom = view.fromY(view.height);
  const crossings = [];
  owner.fill(0);
  for (let site = 0; site < sites.n; site++) {
    const at = 4 * site;
    if (box[at] > right || box[at + 2] < left || box[at + 1] > top || box[at + 3] < bottom) continue;
    const first = Math.max(0, Math.ceil((top - box[at + 3]) * step - 0.5)), last = Math.min(height - 1, Math.floor((top - box[at + 1]) * step - 0.5));
    const firstRing = sites.firstRing(site), endRing = sites.firstRing(site + 1);
    for (let row = first; row <= last; row++) {
      const y = top - (row + 0.5) / step;
      let n = 0;
      for (let ring = firstRing; ring < endRing; ring++) {
        const to = ringOffsets[ring + 1];
        let p = 2 * position[to - 1];
        for (let v = ringOffsets[ring]; v < to; v++) {
          const q = 2 * position[v], ay = xy[p + 1], by = xy[q + 1];
          if (ay > y !== by > y) crossings[n++] = (xy[p] + ((y - ay) / (by - ay)) * (xy[q] - xy[p]) - left) * step;
          p = q;
        }
      }
      if (n > 2) {
        crossings.length = n;
        crossings.sort((a, b) => a - b);
      } else if (crossings[0] > crossings[1]) [crossings[0], crossings[1]] = [crossings[1], crossings[0]];
      for (let k = 0; k + 1 < n; k += 2) {
        const from = Math.max(0, Math.ceil(crossings[k] - 0.5)), to = Math.min(width, Math.ceil(crossings[k + 1] - 0.5));
        for (let x = from, base = row * width; x < to; x++) owner[base + x] = site + 1;
      }
    }
  }
  return owner;
}
