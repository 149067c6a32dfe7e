// Decodes arrays of the page: base64 of gzip of bytes sorted by significance.

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array,
  uint32: Uint32Array, int32: Int32Array, float32: Float32Array, float64: Float64Array,
};

/** @param {string} text */
function bytesOfBase64(text) {
  // Of newer browsers only.
  const { fromBase64 } = /** @type {{ fromBase64?: (text: string) => Uint8Array<ArrayBuffer> }} */ (/** @type {unknown} */ (Uint8Array));
  if (fromBase64) return fromBase64.call(Uint8Array, text);
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

const decoded = new Map();

// Returns a promise of an array of the page by its name; it is decoded once, and its element removed.
/** @type {(name: string, about: ArrayAbout) => Promise<Numbers>} */
export function unpack(name, about) {
  if (!decoded.has(name)) decoded.set(name, decode(name, about));
  return decoded.get(name);
}

/** @type {(name: string, about: ArrayAbout) => Promise<Numbers>} */
async function decode(name, about) {
  const element = document.getElementById("data-" + name);
  if (!element) throw new Error("the page has no array " + name);
  const zipped = bytesOfBase64(element.textContent.trim());
  element.remove();
  const stream = new Blob([zipped]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const Type = TYPES[about.type], n = about.size, width = Type.BYTES_PER_ELEMENT;
  if (planes.length !== n * width) throw new Error("array " + name + " is truncated");
  if (width === 1) return new Type(planes.buffer);
  const bytes = new Uint8Array(n * width);
  for (let plane = 0; plane < width; plane++) {
    const from = plane * n;
    for (let i = 0, to = plane; i < n; i++, to += width) bytes[to] = planes[from + i];
  }
  return new Type(bytes.buffer);
}

// Cumulative sums with a leading 0: counts to offsets.
/** @param {Numbers} counts */
export function offsetsOf(counts) {
  const offsets = new Uint32Array(counts.length + 1);
  for (let i = 0; i < counts.length; i++) offsets[i + 1] = offsets[i] + counts[i];
  return offsets;
}

// Decodes positions from back references: 0 is the next new position, n the n-th last of the distinct ones so far.
/** @param {Numbers} references */
export function positionsOf(references) {
  const position = new Uint32Array(references.length);
  for (let v = 0, seen = 0; v < position.length; v++) position[v] = references[v] === 0 ? seen++ : seen - references[v];
  return position;
}
