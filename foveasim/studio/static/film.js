// Frames of a video file or a folder, one at a time: play, step, scrub.

// Time of a picture of a folder in s.
const PICTURE_S = 0.5;

export class Film {
  /** @type {[number, boolean] | null} */ wanted = null;
  // Number of the frame that is computed.
  next = 0;

  // show(n, isFinal) shows a frame, and resolves to false when it failed; changed() is called when the state changes. settles:
  // whether a pause shows its frame again as the final one.
  /**
   * @param {{ count: number, frameS?: number | null, timesS?: number[] | null, isSkipping: boolean, n?: number, settles?: boolean,
   *   show: (n: number, isFinal: boolean) => Promise<boolean>, changed: () => void }} options
   */
  constructor({ count, frameS, timesS = null, isSkipping, show, changed, n = 0, settles = false }) {
    this.count = count;
    this.n = n;
    this.frameS = frameS || PICTURE_S;
    this.timesS = timesS;
    this.isSkipping = isSkipping;
    this.settles = settles;
    this.show = show;
    this.changed = changed;
    this.isPlaying = false;
    this.isBusy = false;
    this.rate = new Rate();
  }

  // Time of a frame in s: at equal steps, or as the file specifies.
  /** @param {number} n */
  timeOf(n) { return this.timesS?.[n] ?? this.frameS * n; }

  // The frame that is due at a time; not before the present one.
  /** @param {number} t */
  frameAt(t) {
    if (!this.timesS) return Math.floor(t / this.frameS);
    let n = this.n;
    while (n + 1 < this.count && this.timeOf(n + 1) <= t) n++;
    return n;
  }

  // The frame that is shown, or will be.
  get target() { return this.wanted?.[0] ?? (this.isBusy ? this.next : this.n); }

  // Shows a frame; while another is computed, only the newest is shown next.
  /** @type {(n: number, isFinal?: boolean) => Promise<boolean>} */
  async go(n, isFinal = true) {
    this.wanted = [Math.max(0, Math.min(this.count - 1, n)), isFinal];
    if (this.isBusy) return true;
    this.isBusy = true;
    let isShown = false;
    while (this.wanted) {
      const { wanted } = this;
      this.next = wanted[0];
      this.wanted = null;
      isShown = await this.show(...wanted).catch(() => false);
      if (isShown) {
        this.n = this.next;
        this.rate.count();
      } else this.isPlaying = false;
      this.isBusy = this.wanted !== null;
      this.changed();
    }
    return isShown;
  }

  /** @param {number} by */
  step(by) {
    this.pause();
    return this.go(this.target + by);
  }

  // Plays at the rate of the file; frames are skipped when they take longer to compute.
  async play() {
    if (this.isPlaying || this.count < 2) return;
    this.isPlaying = true;
    this.rate = new Rate();
    this.changed();
    if (this.n >= this.count - 1) await this.go(0, false);
    let start = performance.now() - 1000 * this.timeOf(this.n);
    while (this.isPlaying && this.n < this.count - 1) {
      const due = this.frameAt((performance.now() - start) / 1000);
      const next = this.isSkipping ? Math.max(due, this.n + 1) : this.n + 1;
      const wait = start + 1000 * this.timeOf(next) - performance.now();
      if (wait > 0) await new Promise((resolve) => { setTimeout(resolve, wait); });
      if (!this.isPlaying) break;
      const before = this.n;
      await this.go(next, false);
      // A step of the slider or a late picture: time continues from there.
      if (this.n !== next || (!this.isSkipping && wait < 0)) start = performance.now() - 1000 * this.timeOf(this.n);
      if (this.n === before && !this.isBusy) break;
    }
    const wasPlaying = this.isPlaying;
    this.isPlaying = false;
    this.changed();
    if (wasPlaying) await this.go(this.n, true);
  }

  pause() {
    const wasPlaying = this.isPlaying;
    this.isPlaying = false;
    this.changed();
    if (wasPlaying && this.settles && !this.wanted) this.go(this.target, true);
  }
}

// Frames per second over the last second or two.
export class Rate {
  /** @type {number[]} */ times = [];

  count() {
    const now = performance.now();
    this.times = [...this.times.filter((time) => now - time < 2000), now];
  }

  get perS() {
    const { times } = this;
    return times.length > 2 ? ((times.length - 1) * 1000) / (times[times.length - 1] - times[0]) : NaN;
  }
}
