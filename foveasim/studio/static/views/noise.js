// Noise budget: bars of the sources.

import { make } from "/web/page_parts.js";
import { barRows } from "../charts.js";
import { quantity } from "../numbers.js";

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
        ? "Medians over the photosites; root sum of squares " + quantity(total, unit, 3) + "."
        : "No noise.";
    },
  };
}
