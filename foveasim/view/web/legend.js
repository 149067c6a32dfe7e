// Legend of a colour scale: its colours with round values, or the categories with their counts; pictures with a legend.

import { brief, clamp, shown, unitText } from "./colours.js";
import { context2d } from "./gl.js";
import { around, inkOf, make } from "./page_parts.js";

// More categories than this are not listed.
const MOST_KINDS = 40;
// The foot of a picture, in CSS pixels: margin, heights of its rows, width of a colour ramp, size of a swatch.
const MARGIN = 14, TALL_ROW = 46, LOW_ROW = 22, RAMP = 220, SWATCH = 12;
const FONT = "13px system-ui, sans-serif";

export const titleOf = (column) => (column.unit ? column.label + " / " + unitText(column.unit) : column.label);

// Draws the colours of a scale, one row per filter on a mosaic.
export function drawRamp(context, scale, width, height) {
  const rows = scale.tables.length, strip = make("canvas", undefined, { width: 256, height: rows });
  const stripContext = context2d(strip, { willReadFrequently: true }), image = stripContext.createImageData(256, rows);
  scale.tables.forEach((shades, row) => shades.forEach((shade, i) => image.data.set([...shade, 255], 4 * (256 * row + i))));
  stripContext.putImageData(image, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(strip, 0, 0, width, height);
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

// Categories of a scale with their colours and counts, and a note if they are not all.
export function kindsOf(scale) {
  const { column, values } = scale, counts = new Map();
  for (let i = 0; i < values.length; i++) counts.set(values[i], (counts.get(values[i]) || 0) + 1);
  const kinds = [...counts.keys()].sort((a, b) => a - b);
  const items = kinds.slice(0, MOST_KINDS).map((kind) => ({
    colours: ["rgb(" + scale.kindColour(kind) + ")"],
    text: (column.names ? column.names[kind] : shown(kind)) + " · " + shown(counts.get(kind)),
  }));
  return { items, rest: kinds.length > MOST_KINDS ? "and " + shown(kinds.length - MOST_KINDS) + " more; colours repeat" : "" };
}

// List item of a text after squares of colours.
export function swatchItem({ colours, text }) { return around("li", {}, ...swatchesOf(colours), make("span", text)); }

// Squares of colours.
export function swatchesOf(colours) {
  return colours.map((colour) => {
    const swatch = make("i");
    swatch.style.background = colour;
    return swatch;
  });
}

// Range and mean of the numbers of a scale, with their unit.
export function summaryOf(scale) {
  const { column, values } = scale, unit = column.unit ? " " + unitText(column.unit) : "";
  let sum = 0, count = 0;
  for (let i = 0; i < values.length; i++) if (Number.isFinite(values[i])) { sum += values[i]; count++; }
  return count === 0 ? "no values" :
    shown(scale.lowest) + " to " + shown(scale.highest) + unit + ", mean " + shown(Number((sum / count).toPrecision(5))) + unit +
    (column.note ? " (" + column.note + ")" : "");
}

// Returns a picture of views side by side, each of layers on top of each other, above a foot with the scale bar
// { text, width }, the titles and colours of scales, and items { colours, text }. Lengths are CSS pixels.
export function pictureOf(views, { width, height, bar, scales, items }) {
  const picture = document.createElement("canvas"), context = context2d(picture), ratio = views[0][0].height / height;
  context.font = FONT;
  const boxes = footOf(context, width - 2 * MARGIN, bar, scales, items);
  let x = MARGIN, y = height, row = 0;
  for (const box of boxes) {
    if (x > MARGIN && x + box.width > width - MARGIN) {
      x = MARGIN;
      y += row;
      row = 0;
    }
    Object.assign(box, { x, y });
    x += box.width + (box.tall === TALL_ROW ? 40 : 16);
    row = Math.max(row, box.tall);
  }
  picture.width = views.reduce((sum, [base]) => sum + base.width, 0);
  picture.height = Math.round((y + row + (row === LOW_ROW ? 6 : 0)) * ratio);
  context.fillStyle = inkOf("--raised");
  context.fillRect(0, 0, picture.width, picture.height);
  let left = 0;
  for (const layers of views) {
    for (const layer of layers) context.drawImage(layer, left, 0, layers[0].width, layers[0].height);
    left += layers[0].width;
  }
  context.font = FONT;
  for (const box of boxes) {
    context.setTransform(ratio, 0, 0, ratio, ratio * box.x, ratio * box.y);
    context.fillStyle = inkOf("--text");
    box.draw();
  }
  return picture;
}

// Boxes of the foot of a picture that is at most so wide: width, height, and a function that draws the box at the origin.
function footOf(context, most, bar, scales, items) {
  const widthOf = (text) => context.measureText(text).width;
  const boxes = [{
    width: Math.max(bar.width, widthOf(bar.text)), tall: TALL_ROW,
    draw: () => { context.fillText(bar.text, 0, 18); context.fillRect(0, 26, bar.width, 3); },
  }];
  const add = ({ colours, text }) => {
    const before = (SWATCH + 2) * colours.length + (colours.length ? 4 : 0);
    boxes.push({
      width: before + widthOf(text), tall: LOW_ROW,
      draw: () => {
        context.fillText(text, before, 18);
        colours.forEach((colour, k) => { context.fillStyle = colour; context.fillRect((SWATCH + 2) * k, 7, SWATCH, SWATCH); });
      },
    });
  };
  for (const scale of scales) {
    if (scale.column.kind === "kinds") {
      const kinds = kindsOf(scale);
      [{ colours: [], text: titleOf(scale.column) }, ...kinds.items,
        ...(kinds.rest ? [{ colours: [], text: kinds.rest }] : [])].forEach(add);
      continue;
    }
    const ends = brief(scale.from) + " to " + brief(scale.to) + (scale.isLog ? ", log" : "");
    const ramp = Math.max(40, Math.min(RAMP, most - 10 - widthOf(ends)));
    boxes.push({
      width: Math.max(widthOf(titleOf(scale.column)), ramp + 10 + widthOf(ends)), tall: TALL_ROW,
      draw: () => {
        context.fillText(titleOf(scale.column), 0, 18);
        context.fillText(ends, ramp + 10, 36);
        context.translate(0, 26);
        drawRamp(context, scale, ramp, 10);
      },
    });
  }
  items.forEach(add);
  return boxes;
}
