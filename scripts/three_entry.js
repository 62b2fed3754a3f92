// What the page takes of three.js: scripts/vendor_three.sh bundles it for
// univoxel/output/web/vendor/.
export {
  BufferAttribute, Color, DataTexture, DataUtils, EquirectangularReflectionMapping, Euler, HalfFloatType,
  LinearFilter, LinearMipmapLinearFilter, LinearSRGBColorSpace, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  NoToneMapping, PerspectiveCamera, PMREMGenerator, RGBAFormat, Scene, ShaderMaterial, Sphere, SRGBColorSpace,
  Vector3, Vector4, WebGLRenderer, REVISION,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
