// Noise budget: bars of the sources.

import { quantity, shown } from "/web/colours.js";
import { make } from "/web/page_parts.js";
import { barRows } from "../charts.js";

export function create(root) {
  const bars = make("ul", undefined, "bars"), note = make("p", "", "quiet"), warning = make("p", "", "warning");
  bars.id = "noise";
  note.id = "noise-note";
  root.append(bars, note, warning);
  return {
    use({ about: { sources, unit, saturation, is_coarse: isCoarse, read_e: read } }, before) {
      const total = Math.hypot(...sources.map((source) => source.values));
      bars.replaceChildren(...barRows(sources, before?.about.sources, unit));
      note.textContent = sources.length
        ? "Median over the photosites, " + unit + "; root sum of squares " + shown(Number(total.toPrecision(4))) + " " + unit
          + saturation + "." : "No noise.";
      warning.hidden = !isCoarse;
      warning.textContent = "Quantisation exceeds the read noise of " + quantity(Number(read.toPrecision(3)), unit)
        + ": more bits, or a smaller range of the ADC (capacitance, voltage), make its steps finer.";
    },
  };
}
