// Response to uniform light against image height.

import { curveView } from "../charts.js";

export const create = curveView({ nameX: "image height", nameY: "response", label: "Angular response" });
