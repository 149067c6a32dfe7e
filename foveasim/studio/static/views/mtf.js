// Modulation transfer of the lens and of three photosites.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "spatial frequency", nameY: "MTF", label: "Modulation transfer" });
