// Violations of design rules: their values, sites and markers.

import { shown } from "./colours.js";
import { MOST_OUTLINES } from "./marks.js";
import { offsetsOf } from "./unpack.js";

export class Violations {
  // Arrays of the page by their names, its rules, and its sites.
  constructor(arrays, rules, sites) {
    this.n = arrays.violation_value.length;
    this.rules = rules;
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

  // Draws the markers in view of a rule by its index, or of all rules for -1.
  drawMarkers(context, map, rule) {
    const x0 = map.fromX(0), y0 = map.fromY(map.height), x1 = map.fromX(map.width), y1 = map.fromY(0);
    context.beginPath();
    for (let i = 0, drawn = 0; i < this.n && drawn < MOST_OUTLINES; i++) {
      const [a, b, c, d] = this.boxes.subarray(4 * i, 4 * i + 4);
      if ((rule >= 0 && this.rule[i] !== rule) || a > x1 || c < x0 || b > y1 || d < y0) continue;
      drawn++;
      if ((c - a) * map.scale < 3 && (d - b) * map.scale < 3) {
        const x = map.toX(0.5 * (a + c)), y = map.toY(0.5 * (b + d));
        context.moveTo(x + 2.5, y);
        context.arc(x, y, 2.5, 0, 7);
      } else this.trace(context, i, map);
    }
    for (const [width, ink] of [[4, "rgb(255 255 255 / 70%)"], [2, "#d3261b"]]) {
      context.lineWidth = width;
      context.strokeStyle = ink;
      context.stroke();
    }
  }

  // Returns the sites and the value of a violation in words.
  describe(i) {
    const rule = this.rules[this.rule[i]], ids = [...this.sitesOf(i)], unit = rule.unit ? " " + rule.unit : "";
    const sites = ids.length ? (ids.length > 1 ? "sites " : "site ") + ids.slice(0, 4).join(", ") + (ids.length > 4 ? ", …" : "")
      : "position";
    const limit = rule.limit === null ? "" : ", limit " + shown(rule.limit) + unit;
    return { rule, sites, value: Number.isNaN(this.value[i]) ? "" : shown(Number(this.value[i].toPrecision(4))) + unit + limit };
  }

  // Largest extent in µm of the markers of a violation and its sites, for a view of it.
  widthOf(i, sites) {
    const [a, b, c, d] = this.boxes.subarray(4 * i, 4 * i + 4);
    let width = Math.max(c - a, d - b);
    for (const site of this.sitesOf(i)) {
      if (site >= sites.n) continue;
      const [left, low, right, high] = sites.box.subarray(4 * site, 4 * site + 4);
      width = Math.max(width, Math.min(Math.max(right - left, high - low), 20 * width || Infinity));
    }
    return width;
  }
}
