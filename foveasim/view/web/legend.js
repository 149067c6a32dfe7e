// Legend of a colour scale: its colours with round values, or the categories with their counts.

import { brief, clamp, shown } from "./colours.js";
import { make } from "./page_parts.js";

// More categories than this are not listed.
const MOST_KINDS = 40;

export const titleOf = (column) => (column.unit ? column.label + " / " + column.unit : column.label);

// Draws the colours of a scale, one row per filter on a mosaic.
export function drawRamp(context, scale, width, height) {
  const rows = scale.tables.length;
  scale.tables.forEach((shades, row) => {
    for (let px = 0; px < width; px++) {
      context.fillStyle = "rgb(" + shades[Math.round((255 * px) / Math.max(1, width - 1))] + ")";
      context.fillRect(px, (row * height) / rows, 1.5, height / rows);
    }
  });
}

export function tickLabels(scale) {
  return scale.ticks(4).map((tick) => {
    const label = make("span", brief(tick)), fraction = scale.fraction(tick);
    label.style.left = 100 * clamp(fraction, 0, 1) + "%";
    if (fraction < 0.04) label.style.transform = "none";
    if (fraction > 0.96) label.style.transform = "translateX(-100%)";
    return label;
  });
}

// Items of the categories of a scale, and a note if they are not all.
export function kindItems(scale) {
  const { column, values } = scale, counts = new Map();
  for (let i = 0; i < values.length; i++) counts.set(values[i], (counts.get(values[i]) || 0) + 1);
  const kinds = [...counts.keys()].sort((a, b) => a - b);
  const items = kinds.slice(0, MOST_KINDS).map((kind) => {
    const item = make("li"), swatch = make("i");
    swatch.style.background = "rgb(" + scale.kindColour(kind) + ")";
    item.append(swatch, make("span", (column.names ? column.names[kind] : shown(kind)) + " · " + shown(counts.get(kind))));
    return item;
  });
  return { items, rest: kinds.length > MOST_KINDS ? "and " + shown(kinds.length - MOST_KINDS) + " more; colours repeat" : "" };
}

// Range and mean of the numbers of a scale, with their unit.
export function summaryOf(scale) {
  const { column, values } = scale, unit = column.unit ? " " + column.unit : "";
  let sum = 0, count = 0;
  for (let i = 0; i < values.length; i++) if (Number.isFinite(values[i])) { sum += values[i]; count++; }
  return count === 0 ? "no values" :
    shown(scale.lowest) + " to " + shown(scale.highest) + unit + ", mean " + shown(Number((sum / count).toPrecision(5))) + unit +
    (column.note ? " (" + column.note + ")" : "");
}
