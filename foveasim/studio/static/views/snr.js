// Signal-to-noise ratio against exposure of a photosite of each filter.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "exposure", nameY: "SNR", label: "Signal-to-noise ratio", log: "x" });
