// Surfaces in three dimensions by WebGL2: an image that is drawn when the view changes, and ids of sites for picking.

import { TEXTURE_WIDTH, bindIntegers, buildProgram, createLookup, fitCanvas, sendLookup, textureSize } from "./gl.js";

const ATTRIBUTES = ["position", "site"];
const VERTEX_SHADER = `#version 300 es
precision highp float;
in ivec3 position;
in uint site;
uniform ivec3 centre;
uniform vec3 rest;
uniform vec3 unit;
uniform mat4 toClip;
uniform float tallest;
uniform highp sampler2D colours;
uniform highp sampler2D heights;
out vec3 at;
flat out vec3 colour;
flat out uint owner;
void main() {
  ivec2 entry = ivec2(int(site) % ${TEXTURE_WIDTH}, int(site) / ${TEXTURE_WIDTH});
  // Integers subtract exactly, so that surfaces are sharp at any zoom.
  vec3 steps = vec3(position - centre);
  // With a height per site, z is 0 at the bottom and 1 at the top.
  if (tallest > 0.0) steps.z = float(position.z) * tallest * texelFetch(heights, entry, 0).r - float(centre.z);
  at = (steps - rest) * unit;
  gl_Position = toClip * vec4(at, 1.0);
  colour = texelFetch(colours, entry, 0).rgb;
  owner = site;
}`;
const SRGB = `
vec3 toLinear(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
vec3 toScreen(vec3 c) { return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }`;
// Ambient and directional light: a face toward the light source has its full colour, and none is brighter.
const IMAGE_SHADER = `#version 300 es
precision highp float;
in vec3 at;
flat in vec3 colour;
flat in uint owner;
uniform uint pinned;
uniform vec4 cut;
out vec4 pixel;
const vec3 SUN = vec3(-0.331, -0.397, 0.856);
const vec3 FLOOR = vec3(0.32, 0.37, 0.46);
const vec3 MARK = vec3(0.02, 0.25, 1.0);
${SRGB}
void main() {
  // The plane of a triangle from its neighbours on the screen: it faces the eye, independent of its winding.
  vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
  if (dot(cut.xyz, at) > cut.w) discard;
  // Back faces are visible through a cut only: lit as the plane of the cut, they look like its surface.
  if (!gl_FrontFacing && cut.xyz != vec3(0.0)) normal = cut.xyz;
  vec3 light = 0.42 * mix(FLOOR, vec3(1.0), 0.5 * normal.z + 0.5) + 0.60 * max(dot(normal, SUN), 0.0);
  vec3 own = toLinear(colour);
  if (pinned != 0u && owner == pinned) own = mix(own, MARK, 0.7);
  pixel = vec4(toScreen(own * min(light, 1.0)), min(light.g, 1.0));
}`;
// Site + 1, 0 for none; part + 1, and the depth in the upper bits.
const ID_SHADER = `#version 300 es
precision highp float;
precision highp int;
in vec3 at;
flat in uint owner;
uniform uint part;
uniform vec4 cut;
out uvec2 id;
void main() {
  if (dot(cut.xyz, at) > cut.w) discard;
  id = uvec2(owner, part | (uint(gl_FragCoord.z * 16777215.0) << 8));
}`;
const SCREEN_SHADER = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1, gl_VertexID == 2) * 4.0 - 1.0, 0.0, 1.0); }`;
// The image, with the hovered site highlighted according to the ids.
const COMPOSE_SHADER = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D image;
uniform highp usampler2D ids;
uniform uint hovered;
out vec4 pixel;
const vec3 MARK = vec3(1.0, 0.69, 0.03);
${SRGB}
void main() {
  ivec2 position = ivec2(gl_FragCoord.xy);
  vec4 seen = texelFetch(image, position, 0);
  if (hovered != 0u && texelFetch(ids, position, 0).r == hovered) seen.rgb = toScreen(mix(toLinear(seen.rgb), MARK * seen.a, 0.7));
  pixel = vec4(seen.rgb, 1.0);
}`;
// Samples per pixel on fast graphics cards.
const SAMPLES = 4;
const MAX_PARTS = 254;
// Distance of the plane of a cut from its position, as a fraction of the extent along its axis.
const CUT_INSET = 1e-4;
/** @type {{ width: number, height: number, buffers: WebGLRenderbuffer[], textures: WebGLTexture[], frames: WebGLFramebuffer[] }} */
const NO_TARGETS = { width: 0, height: 0, buffers: [], textures: [], frames: [] };

export class SolidView {
  // Given by load().
  /** @type {ReturnType<typeof buildProgram>} */ image;
  /** @type {ReturnType<typeof buildProgram>} */ id;
  /** @type {ReturnType<typeof buildProgram>} */ screen;
  targets = NO_TARGETS;

  // Takes the canvas, Bodies, an Orbit around them, the number of sites, and findRenderer().
  constructor(canvas, bodies, orbit, nSites, renderer) {
    this.canvas = canvas;
    this.orbit = orbit;
    this.wantedSamples = renderer.isSlow ? 0 : SAMPLES;
    this._take(bodies, nSites);
    this.ground = [0, 0, 0];
    this.hovered = -1;
    this.pinned = -1;
    // Cut plane: the side of larger coordinates along an axis, or of smaller ones with the sign -1, is not drawn.
    this.cut = null;
    // Number of times that each was drawn.
    this.counts = { image: 0, ids: 0, screen: 0 };
    this.found = { site: -1, part: -1, depth: 1 };
    this.planes = new Float64Array(24);
    this.word = new Uint32Array(4);
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("WebGL2 was lost");
    this.load();
  }

  _take(bodies, nSites) {
    if (bodies.list.length > MAX_PARTS) throw new Error("more than " + MAX_PARTS + " parts");
    this.bodies = bodies;
    this.nSites = nSites;
    // Heights of the sites as fractions of the tallest, at index site + 1, for bodies with "tallest" lattice steps.
    this.heights = null;
    this.parts = bodies.list.map((body) => ({ name: body.name, nTriangles: body.nTriangles, isVisible: true, painted: null,
      cutShift: 0, body }));
  }

  // Shows other bodies; the GPU resources of those before are freed.
  use(bodies, nSites) {
    const { gl } = this;
    for (const part of this.parts) {
      gl.deleteVertexArray(part.vertices);
      for (const buffer of part.buffers) gl.deleteBuffer(buffer);
      gl.deleteTexture(part.colours);
    }
    gl.deleteTexture(this.heightTable);
    this._take(bodies, nSites);
    this._loadParts();
  }

  // Creates all GPU resources; again after the context was lost.
  load() {
    const { gl } = this;
    // The same attribute numbers, so that one vertex array serves both programs.
    this.image = buildProgram(gl, VERTEX_SHADER, IMAGE_SHADER, ATTRIBUTES);
    this.id = buildProgram(gl, VERTEX_SHADER, ID_SHADER, ATTRIBUTES);
    this.screen = buildProgram(gl, SCREEN_SHADER, COMPOSE_SHADER);
    this.nothing = gl.createVertexArray();
    this.targets = NO_TARGETS;
    this._loadParts();
  }

  _loadParts() {
    const { gl, bodies } = this;
    gl.activeTexture(gl.TEXTURE0);
    this.heightTable = createLookup(gl);
    this._sendHeights();
    for (const part of this.parts) {
      const { positions, sites, indices, tiles } = bodies.build(part.body);
      part.tiles = tiles;
      part.vertices = gl.createVertexArray();
      gl.bindVertexArray(part.vertices);
      part.buffers = [bindIntegers(gl, 0, positions, 3, gl.INT), bindIntegers(gl, 1, sites, 1, gl.UNSIGNED_INT), gl.createBuffer()];
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.buffers[2]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
      part.colours = createLookup(gl);
      sendLookup(gl, part.painted || this._ownColours(part));
    }
    gl.bindVertexArray(null);
    this.change();
  }

  // Buffers of the canvas's size: samples and depths, the image, ids and their depths.
  _resizeTargets() {
    const { gl, canvas: { width, height } } = this;
    for (const one of this.targets.buffers) gl.deleteRenderbuffer(one);
    for (const one of this.targets.textures) gl.deleteTexture(one);
    for (const one of this.targets.frames) gl.deleteFramebuffer(one);
    const kinds = gl.getInternalformatParameter(gl.RENDERBUFFER, gl.RGBA8, gl.SAMPLES) || [];
    const samples = Math.min(this.wantedSamples, kinds.length ? kinds[0] : 0);
    const buffer = (format, n) => {
      const made = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, made);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, n, format, width, height);
      return made;
    };
    const texture = (format) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      return made;
    };
    const buffers = [buffer(gl.RGBA8, samples), buffer(gl.DEPTH_COMPONENT24, samples), buffer(gl.DEPTH_COMPONENT24, 0)];
    const textures = [texture(gl.RGBA8), texture(gl.RG32UI)];
    const frame = (attach) => {
      const made = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, made);
      attach();
      return made;
    };
    const attachBuffer = (at, one) => gl.framebufferRenderbuffer(gl.FRAMEBUFFER, at, gl.RENDERBUFFER, one);
    const attachTexture = (one) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, one, 0);
    const frames = [
      frame(() => { attachBuffer(gl.COLOR_ATTACHMENT0, buffers[0]); attachBuffer(gl.DEPTH_ATTACHMENT, buffers[1]); }),
      frame(() => attachTexture(textures[0])),
      frame(() => { attachTexture(textures[1]); attachBuffer(gl.DEPTH_ATTACHMENT, buffers[2]); }),
    ];
    this.targets = { width, height, buffers, textures, frames };
  }

  // The view has changed: its image is drawn with the next frame, ids at the next pick.
  change() {
    this.isImageStale = this.areIdsStale = true;
  }

  // Only colours have changed: ids remain valid.
  changeColours() { this.isImageStale = true; }

  resize(width, height) {
    const isNew = fitCanvas(this.canvas, width, height);
    this.orbit.setSize(width, height);
    this.change();
    return isNew;
  }

  setGround(ground) { this.ground = ground; this.changeColours(); }
  setPinned(site) { this.pinned = site; this.changeColours(); }
  setVisible(part, isVisible) { part.isVisible = isVisible; this.change(); }
  // Cuts at a position in µm along an axis; null for no cut.
  setCut(cut) { this.cut = cut; this.change(); }

  // Changes the colours of a part: bytes r, g, b, a, at index site + 1; null for its own colours.
  setColours(part, bytes) {
    const { gl } = this;
    part.painted = bytes;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, part.colours);
    sendLookup(gl, bytes || this._ownColours(part));
    this.changeColours();
  }

  _ownColours(part) {
    const bytes = new Uint8Array(4 * textureSize(this.nSites + 1));
    this.bodies.paint(part.body, bytes);
    return bytes;
  }

  // Changes the heights of the sites: fractions of the tallest, at index site + 1.
  setHeights(heights) {
    const { gl } = this;
    this.heights = heights;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.heightTable);
    this._sendHeights();
    this.change();
  }

  _sendHeights() {
    const { gl } = this, table = this.heights || new Float32Array(TEXTURE_WIDTH);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, TEXTURE_WIDTH, table.length / TEXTURE_WIDTH, 0, gl.RED, gl.FLOAT, table);
  }

  setHeight(factor) { this.orbit.setHeight(factor); this.change(); }

  // Draws outdated buffers, and the screen.
  draw() {
    const { gl } = this;
    if (gl.isContextLost()) return;
    if (this.targets.width !== this.canvas.width || this.targets.height !== this.canvas.height) this._resizeTargets();
    if (this.isImageStale) this._drawImage();
    this.counts.screen++;
    const { program, at } = this.screen;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.useProgram(program);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.targets.textures[1]);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.targets.textures[0]);
    gl.uniform1i(at.image, 0);
    gl.uniform1i(at.ids, 1);
    gl.uniform1ui(at.hovered, this.areIdsStale ? 0 : this.hovered + 1);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  _drawImage() {
    const { gl, ground, targets: { frames, width, height } } = this;
    this.isImageStale = false;
    this.counts.image++;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frames[0]);
    gl.clearColor(ground[0] / 255, ground[1] / 255, ground[2] / 255, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.image.program);
    gl.uniform1ui(this.image.at.pinned, this.pinned + 1);
    this._drawParts(this.image);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frames[0]);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, frames[1]);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  _drawIds() {
    const { gl, word } = this;
    this.areIdsStale = false;
    this.counts.ids++;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.frames[2]);
    gl.clearBufferuiv(gl.COLOR, 0, word.fill(0));
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.id.program);
    this._drawParts(this.id);
  }

  // Draws all visible parts with the current program, without tiles out of view and back faces.
  _drawParts({ at }) {
    const { gl, orbit, bodies: { lattice, origin }, targets: { width, height } } = this, { target, distance } = orbit;
    const cx = (target[0] - origin[0]) / lattice, cy = (target[1] - origin[1]) / lattice;
    const cz = (target[2] / orbit.height - origin[2]) / lattice;
    const wx = Math.round(cx), wy = Math.round(cy), wz = Math.round(cz), unit = lattice / distance;
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.cullFace(gl.BACK);
    gl.uniform3i(at.centre, wx, wy, wz);
    gl.uniform3f(at.rest, cx - wx, cy - wy, cz - wz);
    gl.uniform3f(at.unit, unit, unit, unit * orbit.height);
    gl.uniformMatrix4fv(at.toClip, false, orbit.toClip);
    gl.uniform1f(at.tallest, this.bodies.tallest || 0);
    gl.uniform1i(at.colours, 0);
    gl.uniform1i(at.heights, 2);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.heightTable);
    this._findPlanes(cx, cy, cz, unit);
    // Back faces are visible through a cut only.
    if (this.cut) gl.disable(gl.CULL_FACE);
    else gl.enable(gl.CULL_FACE);
    gl.activeTexture(gl.TEXTURE0);
    for (let k = 0; k < this.parts.length; k++) {
      const part = this.parts[k], { tiles } = part;
      if (!part.isVisible) continue;
      if (at.part !== undefined) gl.uniform1ui(at.part, k + 1);
      gl.uniform4f(at.cut, ...this._cutPlane(part.cutShift));
      gl.bindTexture(gl.TEXTURE_2D, part.colours);
      gl.bindVertexArray(part.vertices);
      let from = -1, to = -1;
      for (let i = 0; i < tiles.length; i++) {
        const tile = tiles[i];
        if (!this._isInView(tile.box)) continue;
        if (tile.from !== to) {
          if (to > from) gl.drawElements(gl.TRIANGLES, to - from, gl.UNSIGNED_INT, 4 * from);
          from = tile.from;
        }
        to = tile.to;
      }
      if (to > from) gl.drawElements(gl.TRIANGLES, to - from, gl.UNSIGNED_INT, 4 * from);
    }
    gl.bindVertexArray(null);
  }

  // The cut relative to the target in units of its distance: a normal and a distance; a zero normal cuts nothing.
  // A shift in µm moves it for a part, which removes more of that part.
  _cutPlane(shift = 0) {
    const { cut, orbit: { target, distance, height } } = this, plane = [0, 0, 0, 1];
    if (cut) {
      plane[cut.axis] = cut.sign;
      // Slightly inside, so that walls exactly at the position are removed.
      const inset = CUT_INSET * (this.bodies.high[cut.axis] - this.bodies.low[cut.axis]) * (cut.axis === 2 ? height : 1);
      plane[3] = (-shift + cut.sign * (cut.position * (cut.axis === 2 ? height : 1) - target[cut.axis]) - inset) / distance;
    }
    return plane;
  }

  // The six planes of the view, for boxes on the lattice: a x + b y + c z + d is at least 0 inside each.
  _findPlanes(cx, cy, cz, unit) {
    const { planes, orbit: { toClip: m, height } } = this;
    for (let k = 0; k < 6; k++) {
      const row = k >> 1, sign = k & 1 ? -1 : 1, at = 4 * k;
      planes[at] = (m[3] + sign * m[row]) * unit;
      planes[at + 1] = (m[7] + sign * m[4 + row]) * unit;
      planes[at + 2] = (m[11] + sign * m[8 + row]) * unit * height;
      planes[at + 3] = m[15] + sign * m[12 + row] - planes[at] * cx - planes[at + 1] * cy - planes[at + 2] * cz;
    }
  }

  _isInView(box) {
    const { planes } = this;
    for (let at = 0; at < 24; at += 4) {
      const a = planes[at], b = planes[at + 1], c = planes[at + 2];
      if (a * box[a > 0 ? 3 : 0] + b * box[b > 0 ? 4 : 1] + c * box[c > 0 ? 5 : 2] + planes[at + 3] < 0) return false;
    }
    return true;
  }

  // Draws the ids if they are outdated, so that the hovered site is highlighted.
  updateIds() {
    const { gl, canvas } = this;
    if (gl.isContextLost() || !this.areIdsStale) return;
    if (this.targets.width !== canvas.width || this.targets.height !== canvas.height) this._resizeTargets();
    this._drawIds();
  }

  // Returns the visible site and part at a pixel, -1 for none, and the depth for Orbit.pointAt.
  pick(px, py) {
    const { gl, found, word, canvas, orbit } = this;
    found.site = found.part = -1;
    found.depth = 1;
    if (gl.isContextLost() || !(px >= 0 && py >= 0 && px < orbit.width && py < orbit.tall)) return found;
    this.updateIds();
    const x = Math.floor((px * canvas.width) / orbit.width), y = canvas.height - 1 - Math.floor((py * canvas.height) / orbit.tall);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.targets.frames[2]);
    gl.readPixels(x, y, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, word);
    const part = (word[1] & 255) - 1;
    if (part < 0) return found;
    found.site = word[0] - 1;
    found.part = part;
    found.depth = orbit.depthOf((word[1] >>> 8) / 16777215);
    return found;
  }
}
