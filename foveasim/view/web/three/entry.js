// What of three.js and three-mesh-bvh the page of solids uses; bundled into three.min.js as versions.txt says.

export {
  BufferAttribute, Color, DirectionalLight, Group, HemisphereLight, Mesh, MeshLambertMaterial, PerspectiveCamera,
  Raycaster, Scene, SRGBColorSpace, Vector2, Vector3, WebGLRenderer,
} from "three";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { acceleratedRaycast, MeshBVH } from "three-mesh-bvh";
