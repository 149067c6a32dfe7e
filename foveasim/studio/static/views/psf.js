// Sections of the point spread function of the lens at photosites.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "distance", nameY: "PSF", label: "Point spread" });
