// Values to colours: scales, their ticks, and formatted numbers.

// matplotlib's viridis, which is perceptually uniform: 256 colours of three bytes.
const VIRIDIS = [
  "44015444025645045745055946075a46085c460a5d460b5e470d60470e61471063471164471365481467481668481769",
  "48186a481a6c481b6d481c6e481d6f481f70482071482173482374482475482576482677482878482979472a7a472c7a",
  "472d7b472e7c472f7d46307e46327e46337f463480453581453781453882443983443a83443b84433d84433e85423f85",
  "4240864241864142874144874045884046883f47883f48893e49893e4a893e4c8a3d4d8a3d4e8a3c4f8a3c508b3b518b",
  "3b528b3a538b3a548c39558c39568c38588c38598c375a8c375b8d365c8d365d8d355e8d355f8d34608d34618d33628d",
  "33638d32648e32658e31668e31678e31688e30698e306a8e2f6b8e2f6c8e2e6d8e2e6e8e2e6f8e2d708e2d718e2c718e",
  "2c728e2c738e2b748e2b758e2a768e2a778e2a788e29798e297a8e297b8e287c8e287d8e277e8e277f8e27808e26818e",
  "26828e26828e25838e25848e25858e24868e24878e23888e23898e238a8d228b8d228c8d228d8d218e8d218f8d21908d",
  "21918c20928c20928c20938c1f948c1f958b1f968b1f978b1f988b1f998a1f9a8a1e9b8a1e9c891e9d891f9e891f9f88",
  "1fa0881fa1881fa1871fa28720a38620a48621a58521a68522a78522a88423a98324aa8325ab8225ac8226ad8127ad81",
  "28ae8029af7f2ab07f2cb17e2db27d2eb37c2fb47c31b57b32b67a34b67935b77937b87838b9773aba763bbb753dbc74",
  "3fbc7340bd7242be7144bf7046c06f48c16e4ac16d4cc26c4ec36b50c46a52c56954c56856c66758c7655ac8645cc863",
  "5ec96260ca6063cb5f65cb5e67cc5c69cd5b6ccd5a6ece5870cf5773d05675d05477d1537ad1517cd2507fd34e81d34d",
  "84d44b86d54989d5488bd6468ed64590d74393d74195d84098d83e9bd93c9dd93ba0da39a2da37a5db36a8db34aadc32",
  "addc30b0dd2fb2dd2db5de2bb8de29bade28bddf26c0df25c2df23c5e021c8e020cae11fcde11dd0e11cd2e21bd5e21a",
  "d8e219dae319dde318dfe318e2e418e5e419e7e419eae51aece51befe51cf1e51df4e61ef6e620f8e621fbe723fde725",
].join("");
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const packedColour = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
const table = (colourOf) => Array.from({ length: 256 }, (_, i) => colourOf(i / 255));

export function bytesOfHex(hex) {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

function viridis(fraction) {
  const at = 6 * Math.round(255 * fraction);
  return [0, 2, 4].map((i) => parseInt(VIRIDIS.slice(at + i, at + i + 2), 16));
}

// Displayed colour of a signal: a fraction of white through a filter, with gamma so that dark sites are distinguishable.
function lit(fraction, colour, palette) {
  const level = fraction ** palette.gamma;
  return colour.map((c) => Math.round(c * level));
}

// Mapping of a column's values to colours. Kinds of columns:
//   linear numbers, on a perceptually uniform scale
//   grey   numbers as grey levels
//   lit    numbers as brightness of the colour of each site's filter
//   kinds  integers of categories
export class Scale {
  constructor(column, values, filterOf, palette, wantsLog) {
    Object.assign(this, { column, values, filterOf, palette });
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < values.length; i++) {
      const v = values[i];
      if (v < low && v > -Infinity) low = v;
      if (v > high && v < Infinity) high = v;
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
    if (column.kind === "linear") this.tables = [table(viridis)];
    else if (column.kind === "grey") this.tables = [table((fraction) => lit(fraction, [255, 255, 255], palette))];
    else if (column.kind === "lit") this.tables = column.colours.map((c) => table((fraction) => lit(fraction, bytesOfHex(c), palette)));
  }

  fraction(value) {
    if (this.isLog) return Math.log(value / this.from) / Math.log(this.to / this.from);
    return (value - this.from) / (this.to - this.from);
  }

  value(fraction) {
    return this.isLog ? this.from * (this.to / this.from) ** fraction : this.from + fraction * (this.to - this.from);
  }

  colour(site) {
    const value = this.values[site];
    if (this.column.kind === "kinds") return this.kindColour(value);
    if (!Number.isFinite(value)) return bytesOfHex(this.palette.no_data);
    const shades = this.tables[this.tables.length > 1 ? this.filterOf[site] : 0];
    return shades[Math.round(255 * clamp(this.fraction(value), 0, 1))];
  }

  kindColour(kind) {
    const own = this.column.colours && this.column.colours[kind];
    return bytesOfHex(own || this.palette.kinds[kind % this.palette.kinds.length]);
  }

  // Colours of all sites for the map; sites outside a range of values fade into the background.
  paint(out, range, ground) {
    const { values, column, filterOf } = this;
    const fade = (colour) => packedColour(colour.map((c, i) => Math.round(0.12 * c + 0.88 * ground[i])));
    const both = (colours) => [colours.map(packedColour), colours.map(fade)];
    const tables = (this.tables || []).map(both), nothing = both([bytesOfHex(this.palette.no_data)]);
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
export function roundStep(length, isWhole) {
  if (!(length > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(length)), lead = length / power;
  const step = power * (lead <= 1 ? 1 : lead <= 2 ? 2 : lead <= 5 ? 5 : 10);
  return isWhole ? Math.max(1, step) : step;
}

// Formats integers exactly, other numbers with six significant digits.
export function shown(value) {
  if (Number.isNaN(value)) return "no value";
  if (!Number.isFinite(value)) return value > 0 ? "infinite" : "minus infinite";
  if (Number.isSafeInteger(value)) return value.toLocaleString("en-US");
  const size = Math.abs(value);
  return size >= 1e-3 && size < 1e7 ? String(Number(value.toPrecision(6))) : value.toExponential(4);
}

// Formats a site's value of a column with its unit, using the site areas in µm²; "…" while the column is not loaded.
export function textOf(column, site, areas) {
  if (column.of) return shown(column.of === "size" ? Math.sqrt(areas[site]) : areas[site]) + " " + column.unit;
  if (!column.values) return "…";
  const value = column.values[site];
  if (column.names) return column.names[value];
  return column.unit ? shown(value) + " " + column.unit : shown(value);
}

// Short number format for axes.
export function brief(value) {
  const size = Math.abs(value);
  if (size >= 1e6 || (size < 1e-3 && size > 0)) return value.toExponential(0).replace("e+", "e");
  return size >= 1e4 ? (value / 1e3).toLocaleString("en-US") + "k" : String(Number(value.toPrecision(3)));
}
