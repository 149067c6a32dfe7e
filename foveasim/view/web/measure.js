// Measurements on the map: lengths by a ruler, and statistics of the sites in a rectangle.

import { shown } from "./colours.js";
import { titleOf } from "./legend.js";
import { around, downloadText, make } from "./page_parts.js";

// Length and direction of a line between two points in µm.
export function lengthText([x0, y0], [x1, y1]) {
  const dx = x1 - x0, dy = y1 - y0, length = Math.hypot(dx, dy), digits = (v) => String(Number(v.toPrecision(4)));
  const text = length >= 1000 ? digits(length / 1000) + " mm" : length < 0.1 && length > 0 ? digits(1000 * length) + " nm"
    : digits(length) + " µm";
  return { length, text, detail: "Δx " + digits(dx) + ", Δy " + digits(dy) + " µm, " + digits((Math.atan2(dy, dx) * 180) / Math.PI) + "°" };
}

// Indices of the sites whose centres lie in a rectangle, in ascending order.
export function sitesIn(sites, [[x0, y0], [x1, y1]]) {
  const [left, right] = [Math.min(x0, x1), Math.max(x0, x1)], [low, high] = [Math.min(y0, y1), Math.max(y0, y1)], found = [];
  for (let site = 0; site < sites.n; site++) {
    const at = 4 * site, { box } = sites;
    if (box[at] > right || box[at + 2] < left || box[at + 1] > high || box[at + 3] < low) continue;
    const [x, y] = sites.centre(site);
    if (x >= left && x <= right && y >= low && y <= high) found.push(site);
  }
  return found;
}

// Number of finite values, their mean, sample standard deviation, smallest and largest value.
export function statistics(values, chosen) {
  let n = 0, mean = 0, squares = 0, min = Infinity, max = -Infinity;
  for (const site of chosen) {
    const value = values[site];
    if (!Number.isFinite(value)) continue;
    // Welford's update, which does not cancel.
    const before = value - mean;
    mean += before / ++n;
    squares += before * (value - mean);
    min = Math.min(min, value);
    max = Math.max(max, value);
  }
  return { n, mean: n ? mean : NaN, std: n > 1 ? Math.sqrt(squares / (n - 1)) : NaN, min: n ? min : NaN, max: n ? max : NaN };
}

const COLUMNS = ["n", "mean", "std", "min", "max"];
const figure = (value) => (Number.isNaN(value) ? "–" : shown(Number(value.toPrecision(4))));

// Rows of a table: one line with the name of each column, one with its statistics or categories.
export function statisticsRows(columns, chosen) {
  const rows = [around("tr", {}, ...COLUMNS.map((name) => make("th", name, { scope: "col" })))], colSpan = COLUMNS.length;
  for (const column of columns) {
    if (column.is_repeat || !column.values) continue;
    const line = make("tr");
    if (column.names) {
      const counts = new Map();
      for (const site of chosen) counts.set(column.values[site], (counts.get(column.values[site]) || 0) + 1);
      const kinds = [...counts].sort((a, b) => b[1] - a[1]);
      const all = kinds.slice(0, 6).map(([kind, n]) => column.names[kind] + " " + shown(n)).join(", ");
      line.append(make("td", all + (kinds.length > 6 ? ", …" : ""), { colSpan }));
    } else {
      const found = statistics(column.values, chosen);
      line.append(...COLUMNS.map((key) => make("td", key === "n" ? shown(found.n) : figure(found[key]))));
    }
    rows.push(around("tr", {}, make("th", titleOf(column), { colSpan })), line);
  }
  return rows;
}

// Comma-separated values as in RFC 4180: one row per site, numbers with all digits. Strings that a spreadsheet would take for
// a formula begin with an apostrophe.
export function tableOf(sites, columns, chosen) {
  const listed = columns.filter((column) => !column.is_repeat && column.values);
  const quote = (text) => (/[",\r\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text);
  const word = (text) => quote(/^[=+\-@\t\r]/.test(text) ? "'" + text : text);
  const value = (column, site) => (column.names ? word(column.names[column.values[site]]) : Number.isNaN(column.values[site]) ? ""
    : String(column.values[site]));
  const lines = [["site", "x_um", "y_um", ...listed.map((column) => word(column.key))]];
  for (const site of chosen) lines.push([site, ...sites.centre(site), ...listed.map((column) => value(column, site))]);
  return lines.map((line) => line.join(",") + "\r\n").join("");
}

export function downloadTable(sites, columns, chosen, name) {
  downloadText(tableOf(sites, columns, chosen), name + " sites", "csv", "text/csv");
}
