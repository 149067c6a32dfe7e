// Histogram and statistics of the values that the map shows.

import { statistics } from "/web/measure.js";
import { around, make } from "/web/page_parts.js";
import { addFiles } from "../chart_files.js";
import { percent } from "../problems.js";
import { Histogram } from "../charts.js";
import { quantity } from "../numbers.js";

// Returns statistics of the values of a pane by name, as texts.
function statisticsOf({ column, sites }) {
  if (column.names) return { n: quantity(sites.n) };
  const sorted = column.values.slice().sort(), figure = (v) => (Number.isNaN(v) ? "–" : quantity(v, column.unit));
  // NaN is last.
  const found = statistics(sorted, sorted.keys()), first = sorted.findIndex((v) => v > -Infinity);
  const median = found.n ? sorted[first + (found.n >> 1)] : NaN;
  return {
    n: quantity(found.n), mean: figure(found.mean), median: figure(median), std: figure(found.std), min: figure(found.min),
    max: figure(found.max),
  };
}

export function create(root, { page, panes, setRange }) {
  const frame = make("div", undefined, { className: "chart", id: "histogram" }), chart = new Histogram(frame, setRange);
  const list = make("dl", undefined, { className: "figures", id: "statistics" });
  root.append(frame, list);
  addFiles(root, "Histogram", () => chart);
  const draw = () => {
    const { scale, column } = panes.b, site = page.pinned >= 0 ? page.pinned : page.hovered;
    if (scale) chart.draw(page.range, site >= 0 ? column.values[site] : NaN);
  };
  return {
    draw,
    onSite: draw,
    onValues() {
      const { a, b } = panes;
      if (!b.scale) return;
      const { n_sites: n, saturated_fraction: fraction } = page.state?.summary || {}, figures = statisticsOf(b);
      const isSignal = b.column.is_signal || ["code", "picture"].includes(b.column.key);
      if (isSignal && fraction) figures.saturated = percent(fraction);
      if (isSignal && n && figures.n !== quantity(n)) figures.n += " of " + quantity(n);
      list.replaceChildren(...Object.entries(figures).map(([name, value]) => around("div", {}, make("dt", name), make("dd", value))));
      // The page draws it with the mark of the photosite.
      chart.use(b.scale, page.frozen && a.scale?.column.key === b.column.key ? a.scale : null);
    },
  };
}
