// Violations of design rules: their values, sites and markers.

import { offsetsOf } from "./unpack.js";

export class Violations {
  // Arrays of the page by their names, its rules, and its sites.
  constructor(arrays, rules, sites) {
    this.n = arrays.violation_value.length;
    this.value = arrays.violation_value;
    this.siteOffsets = offsetsOf(arrays.violation_site_counts);
    this.sites = arrays.violation_sites;
    this.partOffsets = offsetsOf(arrays.marker_part_counts);
    this.pointOffsets = offsetsOf(arrays.marker_sizes);
    this.xy = arrays.marker_xy_um;
    this.rule = new Uint16Array(this.n);
    let at = 0;
    rules.forEach((rule, k) => { this.rule.fill(k, at, at + rule.listed); at += rule.listed; });
    this.boxes = new Float64Array(4 * this.n);
    for (let i = 0; i < this.n; i++) {
      const from = this.pointOffsets[this.partOffsets[i]], to = this.pointOffsets[this.partOffsets[i + 1]];
      const box = [Infinity, Infinity, -Infinity, -Infinity];
      for (let p = from; p < to; p++) {
        box[0] = Math.min(box[0], this.xy[2 * p]);
        box[1] = Math.min(box[1], this.xy[2 * p + 1]);
        box[2] = Math.max(box[2], this.xy[2 * p]);
        box[3] = Math.max(box[3], this.xy[2 * p + 1]);
      }
      // A violation without a marker is at its sites.
      if (from === to) for (const site of this.sitesOf(i)) box.splice(0, 4, ...sites.box.subarray(4 * site, 4 * site + 4));
      this.boxes.set(box, 4 * i);
    }
  }

  sitesOf(i) { return this.sites.subarray(this.siteOffsets[i], this.siteOffsets[i + 1]); }

  trace(context, i, view) {
    for (let part = this.partOffsets[i]; part < this.partOffsets[i + 1]; part++) {
      const from = this.pointOffsets[part], to = this.pointOffsets[part + 1];
      for (let p = from; p < to; p++) {
        const x = view.toX(this.xy[2 * p]), y = view.toY(this.xy[2 * p + 1]);
        if (to - from === 1) { context.moveTo(x + 4, y); context.arc(x, y, 4, 0, 7); }
        else if (p === from) context.moveTo(x, y);
        else context.lineTo(x, y);
      }
    }
  }
}
