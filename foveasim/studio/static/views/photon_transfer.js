// Noise against signal of a photosite.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "mean signal", nameY: "noise", label: "Photon transfer", log: "xy" });
