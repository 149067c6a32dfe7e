// The page of solids: parts in three dimensions, and the photosite under the mouse.

const about = JSON.parse(document.getElementById("about").textContent);
const $ = (id) => document.getElementById(id);
const state = { hovered: -1, parts: [], pointer: null, isAsked: false, loaded: false };
// Which site is lit up, for the shaders of all parts.
const hovered = { value: -1 };

function make(tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
}

const inkOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// -- the photosite ------------------------------------------------------------------------------------------------------------

function textOf(column, site) {
  if (column.of) return shown(column.of === "size" ? Math.sqrt(state.area[site]) : state.area[site]) + " " + column.unit;
  if (!column.values) return "…";
  const value = column.values[site];
  if (column.names) return column.names[value];
  return column.unit ? shown(value) + " " + column.unit : shown(value);
}

let speaking = 0;

function tellSite() {
  const site = state.hovered, columns = about.columns.filter((column) => !column.is_repeat);
  $("site").classList.toggle("empty", site < 0);
  $("site-heading").textContent = site < 0 ? "Photosite" : "Photosite " + site.toLocaleString("en-US") + (state.part ? " (" + state.part + ")" : "");
  $("values").replaceChildren(...columns.flatMap((column) => [make("dt", column.label), make("dd", site < 0 ? "–" : textOf(column, site))]));
  clearTimeout(speaking);
  if (site >= 0) {
    speaking = setTimeout(() => {
      $("live").textContent = "Photosite " + site + ": " + columns.map((column) => column.label + " " + textOf(column, site)).join(", ");
    }, 300);
  }
}

// The site of the nearest surface under a place of the window, and its part.
function pick(px, py) {
  const box = $("solid").getBoundingClientRect(), caster = new THREE.Raycaster();
  caster.firstHitOnly = true;
  const place = new THREE.Vector2((2 * (px - box.left)) / box.width - 1, 1 - (2 * (py - box.top)) / box.height);
  state.camera.updateMatrixWorld();
  caster.setFromCamera(place, state.camera);
  const [hit] = caster.intersectObjects(state.parts.filter((part) => part.visible), false);
  if (!hit) return { site: -1, part: null };
  return { site: Math.round(hit.object.geometry.getAttribute("_photosite").getX(hit.face.a)), part: hit.object.name };
}

function hover() {
  const found = state.pointer ? pick(...state.pointer) : { site: -1, part: null };
  if (found.site === state.hovered && found.part === state.part) return;
  state.hovered = found.site;
  state.part = found.part;
  hovered.value = found.site;
  tellSite();
}

// -- drawing ---------------------------------------------------------------------------------------------------------------------

function ask() {
  if (state.isAsked) return;
  state.isAsked = true;
  requestAnimationFrame(() => {
    state.isAsked = false;
    hover();
    draw();
  });
}

function draw() {
  state.scene.background.set(inkOf("--map"));
  state.renderer.render(state.scene, state.camera);
}

function resize() {
  const { clientWidth: width, clientHeight: height } = $("map");
  state.renderer.setSize(width, height, false);
  state.camera.aspect = width / Math.max(1, height);
  state.camera.updateProjectionMatrix();
  ask();
}

// Looks at all of it from a direction.
function look(direction) {
  const { camera, controls, extent, middle } = state;
  const width = Math.max(extent.x, extent.y), distance = (0.52 * width) / Math.tan((camera.fov * Math.PI) / 360) / Math.min(1, camera.aspect);
  camera.position.copy(middle).addScaledVector(direction.normalize(), distance);
  camera.near = distance / 1000;
  camera.far = distance * 50;
  camera.updateProjectionMatrix();
  controls.target.copy(middle);
  controls.update();
  ask();
}

const lookAside = () => look(new THREE.Vector3(0.35, -0.9, 0.75));
const lookDown = () => look(new THREE.Vector3(0, -0.001, 1));

function approach(factor) {
  const { camera, controls } = state;
  camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
  controls.update();
  ask();
}

function turn(aside, up) {
  const { camera, controls } = state, offset = camera.position.clone().sub(controls.target);
  const azimuth = Math.atan2(offset.y, offset.x) + aside, flat = Math.hypot(offset.x, offset.y);
  const rise = clamp(Math.atan2(offset.z, flat) + up, -1.5, 1.57), far = offset.length();
  offset.set(Math.cos(azimuth) * Math.cos(rise), Math.sin(azimuth) * Math.cos(rise), Math.sin(rise)).multiplyScalar(far);
  camera.position.copy(controls.target).add(offset);
  controls.update();
  ask();
}

// -- opening ------------------------------------------------------------------------------------------------------------------------

// A part as it is shown: its bytes of colour are encoded for screens, which glTF takes for light; the hovered site is lit up.
function prepared(part) {
  const { geometry } = part, told = geometry.getAttribute("color"), light = new Float32Array(3 * told.count), colour = new THREE.Color();
  for (let i = 0; i < told.count; i++) {
    colour.setRGB(told.getX(i), told.getY(i), told.getZ(i), THREE.SRGBColorSpace).toArray(light, 3 * i);
  }
  geometry.setAttribute("color", new THREE.BufferAttribute(light, 3));
  // Parts of equal corners share them in the file, and the tree puts them into an order of its own.
  geometry.setIndex(geometry.index.clone());
  geometry.boundsTree = new THREE.MeshBVH(geometry);
  part.raycast = THREE.acceleratedRaycast;
  part.material = new THREE.MeshLambertMaterial({ vertexColors: true, flatShading: true, side: 2 });
  part.material.onBeforeCompile = (shader) => {
    shader.uniforms.hovered = hovered;
    shader.vertexShader = "attribute float _photosite;\nvarying float vSite;\n" + shader.vertexShader.replace("#include <begin_vertex>", "#include <begin_vertex>\nvSite = _photosite;");
    shader.fragmentShader = "uniform float hovered;\nvarying float vSite;\n" + shader.fragmentShader.replace("#include <color_fragment>", "#include <color_fragment>\nif (abs(vSite - hovered) < 0.5) diffuseColor.rgb = mix(diffuseColor.rgb, vec3(1.0, 0.85, 0.2), 0.7);");
  };
  return part;
}

function partItem(part) {
  const item = make("li"), label = make("label"), box = make("input");
  box.type = "checkbox";
  box.checked = true;
  box.addEventListener("change", () => { part.visible = box.checked; ask(); });
  label.append(box, make("span", part.name + " · " + shown(part.geometry.index.count / 3) + " triangles"));
  item.append(label);
  return item;
}

function listen() {
  const canvas = $("solid");
  canvas.addEventListener("pointermove", (event) => { state.pointer = event.buttons ? null : [event.clientX, event.clientY]; ask(); });
  canvas.addEventListener("pointerleave", () => { state.pointer = null; ask(); });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!turns) return;
    turn(...turns);
    event.preventDefault();
  });
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "+" || event.key === "=") approach(1 / 1.3);
    else if (event.key === "-" || event.key === "_") approach(1.3);
    else if (event.key === "0") lookAside();
    else if (event.key === "t" || event.key === "T") lookDown();
  });
  $("nearer").addEventListener("click", () => approach(1 / 1.5));
  $("farther").addEventListener("click", () => approach(1.5));
  $("fit").addEventListener("click", lookAside);
  $("above").addEventListener("click", lookDown);
  $("height").addEventListener("input", () => {
    const factor = 2 ** Number($("height").value);
    $("height-told").textContent = "× " + Number(factor.toPrecision(2));
    state.whole.scale.z = factor;
    state.whole.updateMatrixWorld(true);
    ask();
  });
  $("theme").addEventListener("click", () => {
    const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    try { localStorage.setItem("foveasim-theme", theme); } catch { /* kept for this page alone */ }
    ask();
  });
  $("save").addEventListener("click", () => {
    draw();
    $("solid").toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = about.name.replace(/[^\p{L}\p{N}_-]+/gu, "_").slice(0, 60) + ".png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 5000);
    });
  });
  state.controls.addEventListener("change", ask);
  new ResizeObserver(resize).observe($("map"));
}

async function open() {
  let theme = null;
  try { theme = localStorage.getItem("foveasim-theme"); } catch { /* not kept */ }
  document.documentElement.dataset.theme = theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  $("notes").textContent = about.notes.join(" · ");
  const renderer = findRenderer();
  if (!renderer) {
    $("opening").textContent = "This browser has no WebGL2, which three dimensions need.";
    return;
  }
  const file = await unpack("glb", about.arrays.glb);
  const { scene: parts } = await new THREE.GLTFLoader().parseAsync(file.buffer, "");
  state.area = await unpack("area_um2", about.arrays.area_um2);
  state.renderer = new THREE.WebGLRenderer({ canvas: $("solid"), antialias: !renderer.isSlow, powerPreference: "high-performance" });
  state.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  state.scene = new THREE.Scene();
  state.scene.background = new THREE.Color();
  state.whole = new THREE.Group();
  state.scene.add(state.whole);
  parts.updateMatrixWorld(true);
  parts.traverse((part) => { if (part.isMesh) state.parts.push(prepared(part)); });
  state.whole.add(...state.parts);
  state.camera = new THREE.PerspectiveCamera(35, 1, 1, 1000);
  state.camera.up.set(0, 0, 1);
  const sun = new THREE.DirectionalLight(0xffffff, 1.9);
  sun.position.set(-0.5, -0.6, 1);
  state.scene.add(new THREE.HemisphereLight(0xffffff, 0x9aa4b4, 1.7), sun);
  const low = new THREE.Vector3(Infinity, Infinity, Infinity), high = low.clone().negate();
  for (const { geometry } of state.parts) {
    geometry.computeBoundingBox();
    low.min(geometry.boundingBox.min);
    high.max(geometry.boundingBox.max);
  }
  state.extent = high.clone().sub(low);
  state.middle = low.clone().add(high).multiplyScalar(0.5);
  state.controls = new THREE.OrbitControls(state.camera, $("solid"));
  $("parts").append(...state.parts.map(partItem));
  resize();
  lookAside();
  listen();
  tellSite();
  draw();
  $("opening").hidden = true;
}

async function openRest() {
  for (const column of about.columns) {
    if (column.array && !column.is_repeat) column.values = await unpack(column.array, about.arrays[column.array]);
  }
  state.loaded = true;
  tellSite();
}

window.foveasim = {
  nSites: about.n_sites,
  ready: null,
  complete: null,
  readyMs: NaN,
  pick,
  lookDown,
  draw,
  get hovered() { return state.hovered; },
  get parts() { return state.parts.map((part) => part.name); },
  // CSS pixels of the window where a place on the sensor, in µm, is seen.
  toWindow: (x, y, z) => {
    state.camera.updateMatrixWorld();
    const place = new THREE.Vector3(x, y, z * state.whole.scale.z).project(state.camera), box = $("solid").getBoundingClientRect();
    return [box.left + 0.5 * (place.x + 1) * box.width, box.top + 0.5 * (1 - place.y) * box.height];
  },
};
window.foveasim.ready = open().then(() => { window.foveasim.readyMs = performance.now(); });
window.foveasim.complete = window.foveasim.ready.then(() => state.renderer && openRest());
window.foveasim.ready.catch((error) => { $("opening").textContent = "The solids cannot be shown (" + error.message + ")."; });
window.foveasim.complete.catch(() => {});
