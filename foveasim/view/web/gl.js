// WebGL 2: detection of the renderer, programs from their sources, and the size of a canvas in pixels.

// More pixels than this per CSS pixel cost time without a visible effect.
const MAX_PIXEL_RATIO = 2;

// Detects the WebGL2 renderer: null for none, else whether it is the processor, where anti-aliasing is too slow.
export function findRenderer() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return null;
  const details = gl.getExtension("WEBGL_debug_renderer_info");
  const name = details ? gl.getParameter(details.UNMASKED_RENDERER_WEBGL) : "";
  const lose = gl.getExtension("WEBGL_lose_context");
  if (lose) lose.loseContext();
  return { isSlow: /swiftshader|llvmpipe|software|basic render/i.test(name) };
}

export const pixelRatio = () => Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);

// Sets the pixels of a canvas to a size in CSS pixels; returns whether this changed anything.
export function fitCanvas(canvas, width, height) {
  const ratio = pixelRatio(), w = Math.max(1, Math.round(width * ratio)), h = Math.max(1, Math.round(height * ratio));
  if (canvas.width === w && canvas.height === h) return false;
  canvas.width = w;
  canvas.height = h;
  return true;
}

// The 2D context of a canvas.
/** @param {HTMLCanvasElement} canvas @param {CanvasRenderingContext2DSettings} [options] */
export function context2d(canvas, options) {
  const context = canvas.getContext("2d", options);
  if (!context) throw new Error("the browser has no memory for a canvas");
  return context;
}

// Calls back when the size of an element changes, or the device pixel ratio of its window.
export function watchSize(element, onChange) {
  new ResizeObserver(onChange).observe(element);
  const watchRatio = () => {
    matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener("change", () => {
      watchRatio();
      onChange();
    }, { once: true });
  };
  watchRatio();
}

// Returns a linked program and the locations of its uniforms by name; its attributes are numbered in this order.
export function buildProgram(gl, vertexSource, fragmentSource, attributes = []) {
  const program = gl.createProgram();
  attributes.forEach((name, i) => gl.bindAttribLocation(program, i, name));
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error([gl.getProgramInfoLog(program), ...logs].filter(Boolean).join(" "));
  }
  const at = {}, n = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < n; i++) {
    const { name } = gl.getActiveUniform(program, i);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

// Sets an integer attribute by its number, for the bound vertex array; returns its buffer.
export function bindIntegers(gl, location, data, size, type) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribIPointer(location, size, type, 0, 0);
  return buffer;
}

// Texture with one colour per site, in rows, which shaders read with texelFetch.
export const TEXTURE_WIDTH = 2048;

export const textureSize = (n) => TEXTURE_WIDTH * Math.max(1, Math.ceil(n / TEXTURE_WIDTH));

export function createLookup(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

// Sets colours as bytes r, g, b, a, in the bound texture.
export function sendLookup(gl, bytes) {
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, TEXTURE_WIDTH, bytes.length / 4 / TEXTURE_WIDTH, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
}
