// The map without WebGL2: the sites at all sample points, found again when the view changes, and their colours from a table.

import { MapView } from "/web/map.js";
import { pixelRatio, textureSize } from "/web/gl.js";

// Sites of at least this many pixels need one sample per pixel; smaller ones, and those below half a pixel, more per side.
const LARGE_PIXELS = 3, SMALL_PIXELS = 0.5;
const FEW_SAMPLES = 2, MANY_SAMPLES = 3;
const MOST_SAMPLES = 1.2e7;
// Levels of linear light in the table of bytes.
const LEVELS = 4096;
const LINEAR = Uint16Array.from({ length: 256 },
  (_, i) => Math.round((LEVELS - 1) * (i / 255 <= 0.04045 ? i / 255 / 12.92 : ((i / 255 + 0.055) / 1.055) ** 2.4)));
const ENCODED = Uint8Array.from({ length: LEVELS }, (_, i) => {
  const light = i / (LEVELS - 1);
  return Math.round(255 * (light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055));
});

// The sites at the samples of a view, and its pixels.
class Raster {
  isRendered = false;
  table = new Uint32Array(0);
  /** @type {Sites} */ sites;
  // Number of samples per side of a pixel, and pixels per row.
  /** @type {number} */ n;
  /** @type {number} */ width;
  /** @type {string} */ view;
  // Numbers of the sites at all samples.
  /** @type {Uint16Array<ArrayBuffer> | Uint32Array<ArrayBuffer>} */ owner;
  /** @type {ReturnType<typeof mixedPixels> | null} */ mixed;
  /** @type {ImageData} */ picture;
  /** @type {ImageData} */ nextPicture;

  // spare: a raster that is no longer in use, whose arrays are used again.
  /** @param {RasterMap} map @param {Raster | null} spare */
  constructor(map, spare) {
    const { sites, canvas: { width, height }, samples: n } = map, Numbers = sites.n < 2 ** 16 ? Uint16Array : Uint32Array;
    const size = n * n * width * height, isSame = spare?.owner.constructor === Numbers && spare.owner.length === size;
    Object.assign(this, { sites, width, n, view: map.viewKey });
    this.owner = spare && isSame ? spare.owner : new Numbers(size);
    findOwners(map, n * width, n * height, this.owner);
    this.mixed = n === 1 ? null : mixedPixels(this.owner, width, height, n);
    const fits = spare && spare.picture.width === width && spare.picture.height === height;
    this.picture = fits ? spare.picture : map.context.createImageData(width, height);
    this.nextPicture = fits ? spare.nextPicture : map.context.createImageData(width, height);
  }

  // Sets pixels from the colours of the sites.
  /** @param {ImageData} picture @param {Uint32Array} colours @param {number[]} ground */
  render(picture, colours, ground) {
    const { owner, mixed, sites, width, n } = this, pixels = new Uint32Array(picture.data.buffer);
    if (this.table.length !== sites.n + 1) this.table = new Uint32Array(sites.n + 1);
    const { table } = this;
    table[0] = (255 << 24 | ground[2] << 16 | ground[1] << 8 | ground[0]) >>> 0;
    table.set(colours.subarray(0, sites.n), 1);
    const first = mixed ? mixed.first : owner;
    for (let p = 0; p < pixels.length; p++) pixels[p] = table[first[p]];
    if (mixed) averageSamples(pixels, mixed.pixels, owner, width, n, lightOf(table));
  }
}

export class RasterMap extends MapView {
  /** @type {Raster | null} */ raster = null;
  // The raster of sites that are shown next, and one whose arrays can be used again.
  /** @type {Raster | null} */ next = null;
  /** @type {Raster | null} */ spare = null;

  constructor(canvas, sites) {
    super(canvas);
    this.context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
    this.use(sites);
  }

  // Works ahead for sites that are shown next, completely or in the present view.
  /** @param {Sites} sites @param {boolean} isWhole */
  prepare(sites, isWhole) {
    /** @type {RasterMap} */
    const map = Object.create(this);
    map.use(sites);
    const [x, y] = map.middle;
    if (isWhole) map.set(x, y, map.fitScale());
    else map.set(map.x, map.y, map.scale);
    this.next = new Raster(map, this.next ?? this.spare);
    this.spare = null;
  }

  // Works ahead for colours of sites: paint(colours) sets them. Returns what adopt() takes, or null if the view is another one.
  /** @param {Sites} sites @param {number[]} ground @param {(colours: Uint32Array<ArrayBuffer>) => void} paint */
  prepareColours(sites, ground, paint) {
    const raster = this.next?.sites === sites ? this.next : this.raster;
    if (raster?.sites !== sites || (raster === this.raster && raster.view !== this.viewKey)) return null;
    const colours = new Uint32Array(textureSize(sites.n));
    paint(colours);
    raster.render(raster.nextPicture, colours, ground);
    return { raster, colours };
  }

  // Shows prepared colours in the next drawing, if the view is still the same.
  adopt({ raster, colours }) {
    if (this._current() !== raster) return false;
    this.colours = colours;
    [raster.picture, raster.nextPicture] = [raster.nextPicture, raster.picture];
    raster.isRendered = true;
    return true;
  }

  // Colours are read when the map is drawn.
  sendColours() { if (this.raster) this.raster.isRendered = false; }

  get samples() {
    const { width, height } = this.canvas, pixels = this.sites.smallest * this.scale * pixelRatio();
    const wanted = pixels >= LARGE_PIXELS ? 1 : pixels >= SMALL_PIXELS ? FEW_SAMPLES : MANY_SAMPLES;
    return Math.max(1, Math.min(wanted, Math.floor(Math.sqrt(MOST_SAMPLES / (width * height)))));
  }

  get viewKey() { return [this.x, this.y, this.scale, this.canvas.width, this.canvas.height, this.samples].join(); }

  // The raster of the present view.
  _current() {
    const { raster, next, viewKey: view, sites } = this;
    if (raster?.sites === sites && raster.view === view) return raster;
    if (next?.sites === sites && next.view === view) {
      this.spare = raster;
      this.next = null;
      this.raster = next;
      return next;
    }
    this.raster = new Raster(this, raster);
    return this.raster;
  }

  draw(ground) {
    const raster = this._current();
    if (!raster.isRendered) raster.render(raster.picture, this.colours, ground);
    raster.isRendered = true;
    this.context.putImageData(raster.picture, 0, 0);
  }
}

// Returns the site of the first sample of every pixel, and the pixels that have several sites.
function mixedPixels(owner, width, height, n) {
  const row = n * width, first = new owner.constructor(width * height), pixels = new Uint32Array(width * height);
  const corner = (n - 1) * (row + 1);
  let nMixed = 0;
  for (let y = 0, p = 0; y < height; y++) {
    for (let x = 0, at = y * n * row; x < width; x++, p++, at += n) {
      const one = owner[at];
      first[p] = one;
      // Opposite corners differ in most of them. MANY_SAMPLES of a row are compared without a loop.
      let isOne = owner[at + corner] === one;
      for (let start = at; isOne && start <= at + corner; start += row) {
        isOne = owner[start] === one && owner[start + 1] === one && owner[start + n - 1] === one;
      }
      if (!isOne) pixels[nMixed++] = p;
    }
  }
  return { first, pixels: pixels.slice(0, nMixed) };
}

// Linear light of colours: red and green in 16 bits each, which hold sums of MANY_SAMPLES squared, and blue.
function lightOf(table) {
  const redGreen = new Uint32Array(table.length), blue = new Uint16Array(table.length);
  for (let i = 0; i < table.length; i++) {
    const colour = table[i];
    redGreen[i] = LINEAR[colour & 255] | LINEAR[(colour >>> 8) & 255] << 16;
    blue[i] = LINEAR[(colour >>> 16) & 255];
  }
  return { redGreen, blue };
}

// Sets pixels with several sites to the mean of their samples, n per side, in linear light.
function averageSamples(pixels, mixed, owner, width, n, { redGreen, blue }) {
  const half = (n * n) >> 1, row = n * width;
  for (let i = 0; i < mixed.length; i++) {
    const p = mixed[i], x = p % width, at = (p - x) * n * n + n * x;
    let both = 0, rest = half;
    for (let v = 0, start = at; v < n; v++, start += row) {
      for (let k = start; k < start + n; k++) {
        both = (both + redGreen[owner[k]]) | 0;
        rest += blue[owner[k]];
      }
    }
    const red = ((both & 65535) + half) / (n * n), green = ((both >>> 16) + half) / (n * n);
    pixels[p] = (255 << 24 | ENCODED[(rest / (n * n)) | 0] << 16 | ENCODED[green | 0] << 8 | ENCODED[red | 0]) >>> 0;
  }
}

// Sets the numbers of the sites at all pixel centres plus 1, top row first; 0 for none. Later sites cover earlier ones.
function findOwners(view, width, height, owner) {
  const { sites } = view, { xy, position, ringOffsets, box } = sites, step = (view.scale * width) / view.width;
  const left = view.fromX(0), top = view.fromY(0), right = view.fromX(view.width), bottom = view.fromY(view.height);
  // Positions in columns and rows of pixel centres: sites of a common edge have equal numbers.
  const places = new Float64Array(xy.length);
  for (let at = 0; at < xy.length; at += 2) {
    places[at] = (xy[at] - left) * step - 0.5;
    places[at + 1] = (top - xy[at + 1]) * step - 0.5;
  }
  // First columns after the crossings of outlines and rows: in each row up to one per vertex.
  const counts = new Uint32Array(height);
  let crossings = new Int32Array(4096);
  owner.fill(0);
  for (let site = 0; site < sites.n; site++) {
    const at = 4 * site;
    if (box[at] > right || box[at + 2] < left || box[at + 1] > top || box[at + 3] < bottom) continue;
    const firstRing = sites.firstRing(site), endRing = sites.firstRing(site + 1), most = ringOffsets[endRing] - ringOffsets[firstRing];
    const first = Math.max(0, Math.ceil((top - box[at + 3]) * step - 0.5));
    const last = Math.min(height - 1, Math.floor((top - box[at + 1]) * step - 0.5));
    if (last < first) continue;
    if ((last - first + 1) * most > crossings.length) crossings = new Int32Array(2 * (last - first + 1) * most);
    for (let ring = firstRing; ring < endRing; ring++) {
      const to = ringOffsets[ring + 1];
      let p = 2 * position[to - 1];
      for (let v = ringOffsets[ring]; v < to; v++) {
        const q = 2 * position[v], low = places[p + 1] < places[q + 1] ? p : q, high = p + q - low;
        // The upper end belongs to the edge, the lower one does not.
        const begin = places[low + 1], from = Math.max(first, Math.ceil(begin)), end = Math.min(last + 1, Math.ceil(places[high + 1]));
        p = q;
        if (end <= from) continue;
        const slope = (places[high] - places[low]) / (places[high + 1] - begin);
        for (let row = from; row < end; row++) {
          crossings[(row - first) * most + counts[row]++] = Math.min(width, Math.max(0, Math.ceil(places[low] + (row - begin) * slope)));
        }
      }
    }
    for (let row = first; row <= last; row++) {
      const start = (row - first) * most, n = counts[row], base = row * width;
      counts[row] = 0;
      if (n > 2) crossings.subarray(start, start + n).sort();
      for (let k = start; k + 1 < start + n; k += 2) {
        const a = crossings[k], b = crossings[k + 1];
        for (let x = base + Math.min(a, b), to = base + Math.max(a, b); x < to; x++) owner[x] = site + 1;
      }
    }
  }
}
