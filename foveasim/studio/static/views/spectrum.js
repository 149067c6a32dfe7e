// Spectral response of the filters.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "wavelength", nameY: "response", label: "Spectral response" });
