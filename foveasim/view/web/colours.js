// Values to colours: scales, their ticks, and formatted numbers.

import { COLOUR_MAPS, mapColour } from "./colour_maps.js";

/** @type {(x: number, low: number, high: number) => number} */
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
/** @param {number[]} colour */
const packedColour = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
/** @param {(fraction: number) => number[]} colourOf */
const table = (colourOf) => Array.from({ length: 256 }, (_, i) => colourOf(i / 255));

/** @param {string} hex */
export function bytesOfHex(hex) {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

// Displayed colour of a signal: a fraction of white through a filter, with gamma so that dark sites are distinguishable.
/** @param {number} fraction @param {number[]} colour @param {Palette} palette */
function lit(fraction, colour, palette) {
  const level = fraction ** palette.gamma;
  return colour.map((c) => Math.round(c * level));
}

// Mapping of a column's values to colours. Kinds of columns:
//   linear numbers, on a perceptually uniform scale
//   grey   numbers as grey levels
//   lit    numbers as brightness of the colour of each site's filter
//   kinds  integers of categories
// alsoValues are other values that the scale includes.
export class Scale {
  column; values; filterOf; palette;
  // Colours of 256 steps, for each filter.
  /** @type {number[][][]} */ tables = [];

  /** @typedef {{ wantsLog?: boolean, wantedMap?: string | null, alsoValues?: ArrayLike<number> | null }} ScaleOptions */
  constructor(column, values, filterOf, palette, /** @type {ScaleOptions} */ { wantsLog, wantedMap, alsoValues } = {}) {
    Object.assign(this, { column, values, filterOf, palette });
    let low = Infinity, high = -Infinity;
    for (const part of [values, alsoValues || []]) {
      for (let i = 0; i < part.length; i++) {
        const v = part[i];
        if (v < low && v > -Infinity) low = v;
        if (v > high && v < Infinity) high = v;
      }
    }
    if (low === Infinity) { low = 0; high = 0; }
    this.lowest = low;
    this.highest = high;
    // Signals begin at zero.
    if (column.kind === "grey" || column.kind === "lit") low = 0;
    // Values that differ by rounding only are one value, in the centre of the scale.
    const isOne = high - low <= 1e-9 * Math.max(Math.abs(low), Math.abs(high));
    this.from = isOne && !column.is_integer && low !== 0 ? low - 0.5 : low;
    this.to = isOne ? this.from + 1 : high;
    this.canLog = column.kind === "linear" && low > 0 && high / low > 4;
    // Values of a large range have a logarithmic scale.
    this.isLog = this.canLog && (wantsLog ?? (Boolean(column.of) && high / low > 40));
    // Colours of categories repeat; a column may name more categories than there are colours.
    this.nKinds = column.colours ? column.colours.length : palette.kinds.length;
    // Signals are grey levels unless another colour map is chosen.
    this.canMap = column.kind === "linear" || column.kind === "grey";
    this.map = wantedMap && COLOUR_MAPS.includes(wantedMap) ? wantedMap : column.kind === "grey" ? "grey" : COLOUR_MAPS[0];
    if (column.kind === "grey" && this.map === "grey") this.tables = [table((fraction) => lit(fraction, [255, 255, 255], palette))];
    else if (this.canMap) this.tables = [table((fraction) => mapColour(this.map, fraction))];
    else if (column.kind === "lit") this.tables = column.colours.map((c) => table((fraction) => lit(fraction, bytesOfHex(c), palette)));
  }

  /** @param {number} value */
  fraction(value) {
    if (this.isLog) return Math.log(value / this.from) / Math.log(this.to / this.from);
    return (value - this.from) / (this.to - this.from);
  }

  /** @param {number} fraction */
  value(fraction) {
    return this.isLog ? this.from * (this.to / this.from) ** fraction : this.from + fraction * (this.to - this.from);
  }

  /** @param {number} site */
  colour(site) {
    const value = this.values[site];
    if (this.column.kind === "kinds") return this.kindColour(value);
    if (!Number.isFinite(value)) return bytesOfHex(this.palette.no_data);
    return this.shade(value, this.tables.length > 1 ? this.filterOf[site] : 0);
  }

  // Colour of a number, on a mosaic that of a filter.
  /** @param {number} value */
  shade(value, filter = 0) { return this.tables[filter][Math.round(255 * clamp(this.fraction(value), 0, 1))]; }

  /** @param {number} kind */
  kindColour(kind) {
    const own = this.column.colours && this.column.colours[kind];
    return bytesOfHex(own || this.palette.kinds[kind % this.palette.kinds.length]);
  }

  // Colours of all sites for the map; sites outside a range of values fade into the background.
  /** @param {Uint32Array} out @param {Interval | null} range @param {number[]} ground */
  paint(out, range, ground) {
    const { values, column, filterOf } = this;
    const fade = (colour) => packedColour(colour.map((c, i) => Math.round(0.12 * c + 0.88 * ground[i])));
    const both = (colours) => [colours.map(packedColour), colours.map(fade)];
    const tables = this.tables.map(both), nothing = both([bytesOfHex(this.palette.no_data)]);
    const kinds = column.kind === "kinds" ? both(Array.from({ length: this.nKinds }, (_, k) => this.kindColour(k))) : null;
    const [from, to] = range || [-Infinity, Infinity];
    for (let site = 0; site < values.length; site++) {
      const value = values[site], side = value >= from && value <= to ? 0 : 1;
      if (kinds) out[site] = kinds[side][value % kinds[0].length];
      else if (!Number.isFinite(value)) out[site] = nothing[range ? 1 : 0][0];
      else out[site] = tables[tables.length > 1 ? filterOf[site] : 0][side][Math.round(255 * clamp(this.fraction(value), 0, 1))];
    }
  }

  // Round values along the scale.
  /** @param {number} count */
  ticks(count) {
    if (this.isLog) {
      const ratio = this.to / this.from, steps = ratio > 200 ? [1] : ratio > 20 ? [1, 3] : [1, 2, 5], ticks = [];
      for (let e = Math.floor(Math.log10(this.from)); e <= Math.ceil(Math.log10(this.to)); e++) {
        for (const step of steps) {
          const tick = Number((step * 10 ** e).toPrecision(3));
          if (tick >= this.from * 0.999 && tick <= this.to * 1.001) ticks.push(tick);
        }
      }
      return ticks.length > 1 ? ticks : [this.from, this.to];
    }
    const step = roundStep((this.to - this.from) / count, this.column.is_integer), ticks = [];
    for (let k = Math.ceil(this.from / step - 1e-9); k * step <= this.to + 1e-9 * step; k++) {
      ticks.push(Number((k * step).toPrecision(12)));
    }
    return ticks;
  }

  // Number of sites in each of n steps along the scale.
  /** @param {number} most */
  histogram(most) {
    const { values } = this, span = this.to - this.from;
    const isCounted = this.column.is_integer && !this.isLog && span < most;
    const n = isCounted ? span + 1 : most, counts = new Uint32Array(n);
    for (let i = 0; i < values.length; i++) {
      if (!Number.isFinite(values[i])) continue;
      const bin = isCounted ? values[i] - this.from : Math.floor(this.fraction(values[i]) * n);
      counts[clamp(bin, 0, n - 1)]++;
    }
    return counts;
  }
}

// The next of 1, 2, 5, 10, ... at or above a length.
/** @param {number} length @param {boolean} [isWhole] */
export function roundStep(length, isWhole) {
  if (!(length > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(length)), lead = length / power;
  const step = power * (lead <= 1 ? 1 : lead <= 2 ? 2 : lead <= 5 ? 5 : 10);
  return isWhole ? Math.max(1, step) : step;
}

// Formats a length in nm, µm or mm.
/** @param {number} length */
export function formatLength(length) {
  return length >= 1000 ? length / 1000 + " mm" : length >= 0.1 ? Number(length.toPrecision(3)) + " µm"
    : Number((1000 * length).toPrecision(3)) + " nm";
}

// Made once: numbers are formatted many times faster than by toLocaleString.
const WHOLE = new Intl.NumberFormat("en-US"), SIX_DIGITS = new Intl.NumberFormat("en-US", { maximumSignificantDigits: 6 });

// Formats integers exactly, other numbers with six significant digits.
/** @param {number} value */
export function shown(value) {
  if (Number.isNaN(value)) return "no value";
  if (!Number.isFinite(value)) return value > 0 ? "infinite" : "minus infinite";
  if (Number.isSafeInteger(value)) return WHOLE.format(value);
  const size = Math.abs(value);
  return size >= 1e-3 && size < 1e7 ? SIX_DIGITS.format(value) : value.toExponential(4);
}

// Units with metric prefixes, from the largest.
const PREFIXED = new Set(["s", "F", "V", "bit/s"]);
/** @type {[number, string][]} */
const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"], [1e-15, "f"]];

// Text with the sign of the charge of electrons, e⁻, and of degrees.
/** @param {string} text */
export const unitText = (text) => (text === "degrees" ? "°" : text.replace(/(?<![a-z0-9.])e-(?!\w)/gi, "e⁻"));

// Formats a value with its unit, with a metric prefix where the unit has one, and otherwise with thousands; digits: significant
// ones of numbers that are not integers.
/** @param {number} value @param {string} [unit] @param {number} [digits] */
export function quantity(value, unit = "", digits = 4) {
  const size = Math.abs(value), isExact = !Number.isFinite(value) || Number.isInteger(value);
  const rounded = isExact ? value : size >= 10 ** digits ? Math.round(value) : Number(value.toPrecision(digits));
  const isPlain = !PREFIXED.has(unit) || !Number.isFinite(value) || !value;
  if (isPlain) return shown(rounded) + (unit ? " " + unitText(unit.replace(/^1\//, "/")) : "");
  const [from, prefix] = PREFIXES.find(([each]) => Math.abs(rounded) >= each * (1 - 1e-9)) ?? PREFIXES[PREFIXES.length - 1];
  return shown(Number((rounded / from).toPrecision(digits))) + " " + prefix + unit;
}

// Formats a site's value of a column with its unit, using the site areas in µm²; "…" while the column is not loaded.
/** @param {Column} column @param {number} site @param {Numbers} areas */
export function textOf(column, site, areas) {
  if (column.of) return shown(column.of === "size" ? Math.sqrt(areas[site]) : areas[site]) + " " + unitText(column.unit);
  if (!column.values) return "…";
  const value = column.values[site];
  if (column.names) return column.names[value];
  return column.unit ? shown(value) + " " + unitText(column.unit) : shown(value);
}

// Short number format for axes.
/** @param {number} value */
export function brief(value) {
  const size = Math.abs(value);
  if (size >= 1e6 || (size < 1e-3 && size > 0)) return value.toExponential(0).replace("e+", "e");
  return size >= 1e4 ? (value / 1e3).toLocaleString("en-US") + "k" : String(Number(value.toPrecision(3)));
}
