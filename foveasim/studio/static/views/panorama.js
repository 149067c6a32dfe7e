// Panorama, darker outside the field of the sensor.

import { context2d } from "/web/gl.js";
import { make } from "/web/page_parts.js";

export function create(root) {
  const canvas = make("canvas", undefined, { id: "panorama-picture", role: "img", ariaLabel: "Panorama with the field of the sensor" });
  const note = make("p", "", { className: "quiet", id: "panorama-note" });
  canvas.style.width = "100%";
  root.append(note);
  return {
    use({ about: { width, height, note: text }, arrays: { rgba } }) {
      note.textContent = text;
      if (!width) { canvas.remove(); return; }
      note.before(canvas);
      Object.assign(canvas, { width, height });
      const pixels = new Uint8ClampedArray(rgba.buffer, rgba.byteOffset, rgba.length);
      context2d(canvas).putImageData(new ImageData(pixels, width, height), 0, 0);
    },
  };
}
