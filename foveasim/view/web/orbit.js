// Camera that orbits a target. Right-handed, x to the right, y up, z toward the lens; lengths in µm, heights scaled.

import { clamp } from "./colours.js";

const HALF_FOV = (17.5 * Math.PI) / 180;
const FOCAL = 1 / Math.tan(HALF_FOV);
// Fraction of the view that the complete scene fills.
const FILLED = 0.94;
// Distance of the near plane as a fraction of the target's distance, which preserves depth precision.
const NEAREST_DEPTH = 0.01;

export class Orbit {
  // The scene lies between two corners; the second length is the smallest distance.
  constructor(low, high, nearest) {
    this.corners = [low, high];
    this.nearest = nearest;
    this.height = 1;
    this.width = this.tall = 1;
    this.target = new Float64Array(3);
    this.right = new Float64Array(3);
    this.up = new Float64Array(3);
    this.toEye = new Float64Array(3);
    // From positions relative to the target, in units of its distance, to clip space; column-major.
    this.toClip = new Float32Array(16);
    this.azimuth = -0.5 * Math.PI;
    this.elevation = 0.5 * Math.PI;
    this.distance = 1;
    this.near = NEAREST_DEPTH;
    this.far = 2;
    this.centre();
  }

  low(axis) { return this.corners[0][axis] * (axis === 2 ? this.height : 1); }
  high(axis) { return this.corners[1][axis] * (axis === 2 ? this.height : 1); }

  centre() { for (let i = 0; i < 3; i++) this.target[i] = 0.5 * (this.low(i) + this.high(i)); }

  setSize(width, height) {
    this.width = Math.max(1, width);
    this.tall = Math.max(1, height);
    this._update();
  }

  // Scales heights; the target remains in the centre of the view.
  setHeight(factor) {
    this.target[2] *= factor / this.height;
    this.height = factor;
    this._update();
  }

  turn(aside, up) {
    this.azimuth = (this.azimuth + aside) % (2 * Math.PI);
    this.elevation = clamp(this.elevation + up, -0.5 * Math.PI, 0.5 * Math.PI);
    this._update();
  }

  // Pans points at a depth, in units of the target's distance, by pixels.
  pan(dx, dy, depth = 1) {
    const perPixel = (2 * this.distance * depth) / (FOCAL * this.tall);
    for (let i = 0; i < 3; i++) this.target[i] += perPixel * (dy * this.up[i] - dx * this.right[i]);
    this._update();
  }

  // Changes the distance by a factor about a point, whose position in the view does not change.
  zoom(factor, point = this.target) {
    const distance = clamp(this.distance * factor, this.nearest, 4 * this.fitDistance()), ratio = distance / this.distance;
    for (let i = 0; i < 3; i++) this.target[i] = point[i] + (this.target[i] - point[i]) * ratio;
    this.distance = distance;
    this._update();
  }

  // Shows the complete scene from a direction.
  look(azimuth, elevation) {
    this.azimuth = azimuth;
    this.elevation = elevation;
    this.centre();
    this._orient();
    this.distance = this.fitDistance();
    this._update();
  }

  // Returns the distance from the centre of the box at which all its corners are in view.
  fitDistance() {
    const { right, up, toEye } = this, wide = (this.width / this.tall / FOCAL) * FILLED, tall = FILLED / FOCAL;
    let distance = this.nearest;
    for (let k = 0; k < 8; k++) {
      let x = 0, y = 0, z = 0;
      for (let i = 0; i < 3; i++) {
        const half = 0.5 * (this.high(i) - this.low(i)) * ((k >> i) & 1 ? 1 : -1);
        x += right[i] * half;
        y += up[i] * half;
        z += toEye[i] * half;
      }
      distance = Math.max(distance, z + Math.max(Math.abs(x) / wide, Math.abs(y) / tall));
    }
    return distance;
  }

  // Pixels per µm at the target.
  pixelsPerUm() { return (0.5 * FOCAL * this.tall) / this.distance; }

  eye(out) {
    for (let i = 0; i < 3; i++) out[i] = this.target[i] + this.distance * this.toEye[i];
    return out;
  }

  // Returns the point at a pixel of the view and a depth.
  pointAt(px, py, depth, out) {
    const x = ((2 * px) / this.width - 1) * (this.width / this.tall / FOCAL) * depth, y = ((1 - (2 * py) / this.tall) / FOCAL) * depth;
    for (let i = 0; i < 3; i++) {
      out[i] = this.target[i] + this.distance * ((1 - depth) * this.toEye[i] + x * this.right[i] + y * this.up[i]);
    }
    return out;
  }

  // Returns the depth of a window depth from 0 to 1.
  depthOf(windowDepth) {
    const { near, far } = this;
    return (far * near) / (far - windowDepth * (far - near));
  }

  // Returns the pixel of a point whose height is not scaled yet.
  project(x, y, z, out) {
    let right = 0, up = 0, toEye = 0;
    for (let i = 0; i < 3; i++) {
      const part = ((i === 0 ? x : i === 1 ? y : z * this.height) - this.target[i]) / this.distance;
      right += part * this.right[i];
      up += part * this.up[i];
      toEye += part * this.toEye[i];
    }
    const scale = (0.5 * this.tall * FOCAL) / (1 - toEye);
    out[0] = 0.5 * this.width + right * scale;
    out[1] = 0.5 * this.tall - up * scale;
    return out;
  }

  _orient() {
    const { right, up, toEye } = this;
    const ca = Math.cos(this.azimuth), sa = Math.sin(this.azimuth), ce = Math.cos(this.elevation), se = Math.sin(this.elevation);
    toEye[0] = ca * ce; toEye[1] = sa * ce; toEye[2] = se;
    right[0] = -sa; right[1] = ca; right[2] = 0;
    up[0] = -se * ca; up[1] = -se * sa; up[2] = ce;
  }

  _update() {
    this._orient();
    for (let i = 0; i < 3; i++) this.target[i] = clamp(this.target[i], this.low(i), this.high(i));
    const { right, up, toEye, toClip } = this;
    let nearest = Infinity, farthest = -Infinity;
    for (let k = 0; k < 8; k++) {
      let depth = 1;
      for (let i = 0; i < 3; i++) depth -= (toEye[i] * (((k >> i) & 1 ? this.high(i) : this.low(i)) - this.target[i])) / this.distance;
      nearest = Math.min(nearest, depth);
      farthest = Math.max(farthest, depth);
    }
    // Only the box with a small margin: a tight range gives fine depths.
    const near = Math.max(0.999 * nearest, NEAREST_DEPTH), far = Math.max(1.001 * farthest, 1.01 * near);
    this.near = near;
    this.far = far;
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    for (let i = 0; i < 3; i++) {
      toClip[4 * i] = (right[i] * FOCAL * this.tall) / this.width;
      toClip[4 * i + 1] = up[i] * FOCAL;
      toClip[4 * i + 2] = a * toEye[i];
      toClip[4 * i + 3] = -toEye[i];
    }
    toClip[12] = 0;
    toClip[13] = 0;
    toClip[14] = b - a;
    toClip[15] = 1;
  }
}
