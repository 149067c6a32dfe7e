// Noise budget: bars of the sources.

import { shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";
import { barRows } from "../charts.js";

export function create(root) {
  const bars = make("ul", undefined, "bars"), note = make("p", "", "quiet");
  bars.id = "noise";
  note.id = "noise-note";
  root.append(bars, note);
  return {
    use({ about: { sources, unit } }, before) {
      const total = Math.hypot(...sources.map((source) => source.values));
      bars.replaceChildren(...barRows(sources, before?.about.sources, unit));
      note.textContent = sources.length
        ? "Median over the photosites, " + unit + "; root sum of squares " + shown(Number(total.toPrecision(4))) + " " + unit + "."
        : "No noise.";
    },
  };
}
