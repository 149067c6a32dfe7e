// Noise budget: bars of the sources.

import { make } from "/web/page_parts.js";
import { barRows } from "../charts.js";
import { quantity } from "../numbers.js";

export function create(root) {
  const bars = make("ul", undefined, { className: "bars", id: "noise" });
  const note = make("p", "", { className: "quiet", id: "noise-note" }), warning = make("p", "", "warning");
  root.append(bars, note, warning);
  return {
    use({ about: { sources, unit, saturation, is_coarse: isCoarse, read_e: read } }, before) {
      const total = Math.hypot(...sources.map((source) => source.values));
      bars.replaceChildren(...barRows(sources, before?.about.sources, unit));
      note.textContent = sources.length
        ? "Medians over the photosites; root sum of squares " + quantity(total, unit, 3) + saturation + "."
        : "No noise.";
      warning.hidden = !isCoarse;
      warning.textContent = "Quantisation exceeds the read noise of " + quantity(read, unit, 3)
        + ": more bits, or a smaller range of the ADC (capacitance, voltage), make its steps finer.";
    },
  };
}
