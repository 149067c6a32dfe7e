// The map without WebGL2: the site of every pixel centre, found again when the view changes, and colours from a table.

import { MapView } from "/web/map.js";

export class RasterMap extends MapView {
  constructor(canvas, sites) {
    super(canvas);
    this.context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
    this.use(sites);
  }

  use(sites) {
    super.use(sites);
    this.drawn = null;
  }

  // Colours are read when the map is drawn.
  sendColours() {}

  draw(ground) {
    const { canvas, colours } = this, { width, height } = canvas, view = [this.x, this.y, this.scale, width, height].join();
    if (this.drawn !== view) {
      this.owner = ownersOf(this, width, height);
      this.picture = this.context.createImageData(width, height);
      this.drawn = view;
    }
    const pixels = new Uint32Array(this.picture.data.buffer), { owner } = this;
    const empty = (255 << 24 | ground[2] << 16 | ground[1] << 8 | ground[0]) >>> 0;
    for (let p = 0; p < pixels.length; p++) pixels[p] = owner[p] ? colours[owner[p] - 1] : empty;
    this.context.putImageData(this.picture, 0, 0);
  }
}

// Returns the number of the site at every pixel centre plus 1, top row first; 0 for none. Later sites cover earlier ones.
export function ownersOf(view, width, height) {
  const { sites } = view, { xy, position, ringOffsets, box } = sites, step = (view.scale * width) / view.width;
  const left = view.fromX(0), top = view.fromY(0), right = view.fromX(view.width), bottom = view.fromY(view.height);
  const owner = new Uint32Array(width * height), crossings = [];
  for (let site = 0; site < sites.n; site++) {
    const at = 4 * site;
    if (box[at] > right || box[at + 2] < left || box[at + 1] > top || box[at + 3] < bottom) continue;
    const first = Math.max(0, Math.ceil((top - box[at + 3]) * step - 0.5)), last = Math.min(height - 1, Math.floor((top - box[at + 1]) * step - 0.5));
    for (let row = first; row <= last; row++) {
      const y = top - (row + 0.5) / step;
      crossings.length = 0;
      for (let ring = sites.firstRing(site); ring < sites.firstRing(site + 1); ring++) {
        const to = ringOffsets[ring + 1];
        let p = 2 * position[to - 1];
        for (let v = ringOffsets[ring]; v < to; v++) {
          const q = 2 * position[v], ay = xy[p + 1], by = xy[q + 1];
          if (ay > y !== by > y) crossings.push((xy[p] + ((y - ay) / (by - ay)) * (xy[q] - xy[p]) - left) * step);
          p = q;
        }
      }
      if (crossings.length > 2) crossings.sort((a, b) => a - b);
      else if (crossings[0] > crossings[1]) crossings.reverse();
      for (let k = 0; k + 1 < crossings.length; k += 2) {
        const from = Math.max(0, Math.ceil(crossings[k] - 0.5)), to = Math.min(width, Math.ceil(crossings[k + 1] - 0.5));
        if (to > from) owner.fill(site + 1, row * width + from, row * width + to);
      }
    }
  }
  return owner;
}
