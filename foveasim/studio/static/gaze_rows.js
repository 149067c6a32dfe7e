// Rows [t, x, y] of a gaze path, in s and µm: changes that keep them in the order of their times.

/** @typedef {[number, number, number]} GazeRow */

// Times closer than this fraction of a step are the same.
const SAME = 0.5;

/** @type {(rows: GazeRow[]) => GazeRow[]} */
const sorted = (rows) => [...rows].sort((a, b) => a[0] - b[0]);

// Returns rows with a further one, which replaces those at its time.
/** @type {(rows: GazeRow[], row: GazeRow, step: number) => GazeRow[]} */
export function withRow(rows, row, step) {
  return sorted([...rows.filter(([t]) => Math.abs(t - row[0]) >= SAME * step), row]);
}

// Returns rows with another one at an index.
/** @type {(rows: GazeRow[], index: number, row: GazeRow) => GazeRow[]} */
export function withChanged(rows, index, row) { return sorted(rows.map((each, k) => (k === index ? row : each))); }

// Index of the last row at a time or before it; -1 before the first.
/** @type {(rows: GazeRow[], t: number, step: number) => number} */
export function rowAt(rows, t, step) { return rows.findLastIndex((row) => row[0] < t + 1e-6 * step); }

// A recording: its rows by the number of their step, the last movement in each.
export class Recording {
  /** @type {Map<number, GazeRow>} */ found = new Map();
  startedAt = performance.now();
  nMoved = 0;

  // Over a picture the steps are those of the clock, and a rest between two movements is recorded too; over a video they are frames.
  /** @param {{ step: number, isVideo: boolean, position: Point, timesS?: number[] | null }} options */
  constructor({ step, isVideo, position, timesS = null }) {
    this.timesS = timesS;
    this.step = step;
    this.isVideo = isVideo;
    this.position = position;
    if (!isVideo) this._add(0, position);
  }

  // Time since the start in s.
  get elapsed() { return (performance.now() - this.startedAt) / 1000; }

  _add(k, [x, y]) { this.found.set(k, [this.timesS?.[k] ?? k * this.step, x, y]); }

  // The gaze has moved; frame: number of the frame of a video.
  /** @param {Point} position @param {number} frame */
  move(position, frame) {
    const k = this.isVideo ? frame : Math.round(this.elapsed / this.step);
    if (!this.isVideo && !this.found.has(k - 1) && k > 0) this._add(k - 1, this.position);
    this._add(k, position);
    this.position = position;
    this.nMoved++;
  }

  // Rows of the recording; over a video with those of other frames before it.
  /** @param {GazeRow[]} before */
  rows(before) {
    const own = sorted([...this.found.values()]);
    return this.isVideo ? own.reduce((rows, row) => withRow(rows, row, this.step), before) : own;
  }
}
