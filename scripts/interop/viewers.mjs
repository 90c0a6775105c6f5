/** What viewers for the web make of a file, in a page: viewers.html?program=NAME&file=NAME. Leaves in window.answer the
 *  numbers as they stand in the viewer's world (arrays, or an error), and draws one frame, the camera 3 units in front. */

const query = new URLSearchParams(location.search);
const [program, file] = [query.get("program"), query.get("file")];
const url = `/files/${file}`;
const bytes = async () => (await fetch(url)).arrayBuffer();
const view = document.getElementById("view");
const flat = (value) => Array.from(value, (x) => Number(x));
const EYE = [0.9, 0.7, 3];
const frames = async (count) => {
  for (let k = 0; k < count; k++) await new Promise((done) => setTimeout(done, 60));
};

/** Columns that are filled row by row. */
function columns() {
  const out = { positions: [], scales: [], quats: [], opacities: [], colors: [] };
  return out;
}

async function three() {
  const THREE = await import("three/webgpu");
  const loaders = { spz: "SPZLoader", ply: "GaussianSplatPLYLoader", splat: "SPLATLoader", ksplat: "KSPLATLoader" };
  const ending = file.split(".").pop();
  let geometry, group;
  const { GaussianSplat } = await import("three/addons/objects/GaussianSplat.js");
  if (ending === "glb") {
    const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
    const { GLTFGaussianSplatLoaderExtension } = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
    const loader = new GLTFLoader();
    loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    group = (await loader.parseAsync(await bytes(), "")).scene;
    group.traverse((one) => (geometry ??= one.splatGeometry));
  } else {
    if (!loaders[ending]) throw new Error("is not a format of it");
    const module = await import(`three/addons/loaders/${loaders[ending]}.js`);
    geometry = await new module[loaders[ending]]().parse(await bytes());
    group = new GaussianSplat(geometry);
  }
  const { position, covariance, color } = geometry.attributes;
  const rgba = flat(color.array);
  const answer = {
    positions: flat(position.array),
    covariances: flat(covariance.array),
    colors: rgba.filter((_, k) => k % 4 < 3).map((level) => level / 255),
    opacities: rgba.filter((_, k) => k % 4 === 3).map((level) => level / 255),
  };
  const draw = async () => {
    const renderer = new THREE.WebGPURenderer({ antialias: false });
    renderer.setSize(200, 200);
    view.append(renderer.domElement);
    await renderer.init();
    const scene = new THREE.Scene();
    scene.background = new THREE.Color(0x222222);
    scene.add(group);
    const camera = new THREE.PerspectiveCamera(40, 1, 0.1, 100);
    camera.position.set(...EYE);
    camera.lookAt(0, 0, 0);
    renderer.setAnimationLoop(() => renderer.render(scene, camera));
    await frames(20);
  };
  return { answer, draw };
}

async function spark() {
  const THREE = await import("three");
  const { SplatMesh, SparkRenderer } = await import("@sparkjsdev/spark");
  const mesh = new SplatMesh({ fileBytes: new Uint8Array(await bytes()), fileName: file });
  await mesh.initialized;
  const answer = columns();
  mesh.forEachSplat((_, center, scales, quaternion, opacity, color) => {
    answer.positions.push(...center.toArray());
    answer.scales.push(...scales.toArray());
    answer.quats.push(quaternion.w, quaternion.x, quaternion.y, quaternion.z);
    answer.opacities.push(opacity);
    answer.colors.push(color.r, color.g, color.b);
  });
  if (answer.positions.length === 0) throw new Error("no splats");
  const draw = async () => {
    const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
    renderer.setSize(200, 200);
    view.append(renderer.domElement);
    const scene = new THREE.Scene();
    scene.background = new THREE.Color(0x222222);
    scene.add(new SparkRenderer({ renderer }), mesh);
    const camera = new THREE.PerspectiveCamera(40, 1, 0.1, 100);
    camera.position.set(...EYE);
    camera.lookAt(0, 0, 0);
    renderer.setAnimationLoop(() => renderer.render(scene, camera));
    await frames(25);
  };
  return { answer, draw };
}

async function gaussianSplats3d() {
  const THREE = await import("three");
  const G = await import("@mkkellogg/gaussian-splats-3d");
  const formats = { ply: G.SceneFormat.Ply, splat: G.SceneFormat.Splat, ksplat: G.SceneFormat.KSplat, spz: G.SceneFormat.Spz };
  const format = formats[file.split(".").pop()];
  if (format === undefined) throw new Error("is not a format of it");
  const viewer = new G.Viewer({
    rootElement: view,
    cameraUp: [0, 1, 0],
    initialCameraPosition: EYE,
    initialCameraLookAt: [0, 0, 0],
    sharedMemoryForWorkers: false,
    gpuAcceleratedSort: false,
    sphericalHarmonicsDegree: 2,
    sceneRevealMode: G.SceneRevealMode.Instant,
  });
  await viewer.addSplatScene(url, { format, showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 0 });
  const mesh = viewer.getSplatMesh();
  const answer = columns();
  const [center, scale, turn, color] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Quaternion(), new THREE.Vector4()];
  for (let k = 0; k < mesh.getSplatCount(); k++) {
    mesh.getSplatCenter(k, center, true);
    mesh.getSplatScaleAndRotation(k, scale, turn, false); // with the scene's transform it is no exact inverse
    mesh.getSplatColor(k, color);
    answer.positions.push(...center.toArray());
    answer.scales.push(...scale.toArray());
    answer.quats.push(turn.w, turn.x, turn.y, turn.z);
    answer.colors.push(color.x / 255, color.y / 255, color.z / 255);
    answer.opacities.push(color.w / 255);
  }
  const draw = async () => {
    viewer.start();
    await frames(25);
  };
  return { answer, draw };
}

async function babylon() {
  const { Engine } = await import("@babylonjs/core/Engines/engine.js");
  const { Scene } = await import("@babylonjs/core/scene.js");
  const { ArcRotateCamera } = await import("@babylonjs/core/Cameras/arcRotateCamera.js");
  const { Vector3 } = await import("@babylonjs/core/Maths/math.vector.js");
  const { Color4 } = await import("@babylonjs/core/Maths/math.color.js");
  const { ImportMeshAsync } = await import("@babylonjs/core/Loading/sceneLoader.js");
  await import("@babylonjs/loaders/SPLAT/index.js");
  await import("@babylonjs/loaders/glTF/index.js");
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [200, 200];
  view.append(canvas);
  const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.clearColor = new Color4(0.13, 0.13, 0.13, 1);
  const camera = new ArcRotateCamera("camera", 0, 0, 3, Vector3.Zero(), scene);
  camera.setPosition(new Vector3(EYE[0], EYE[1], -EYE[2])); // left-handed: z into the screen
  camera.fov = (40 * Math.PI) / 180;
  camera.minZ = 0.1;
  const splat = {
    keepInRam: true,
    // from the packages, as the viewer would from a server of its own
    deflateURL: "/node_modules/fflate/umd/index.js",
    spzLibraryUrl: "/node_modules/@adobe/spz/dist/spz.js",
  };
  const { meshes } = await ImportMeshAsync(url, scene, { pluginOptions: { splat } });
  const mesh = meshes.find((one) => one.getClassName() === "GaussianSplattingMesh");
  if (!mesh) throw new Error("no splats");
  for (let k = 0; k < 50 && !mesh.splatsData && !mesh._splatPositions; k++) await frames(1);
  const world = mesh.computeWorldMatrix(true);
  const draw = async () => {
    engine.runRenderLoop(() => scene.render());
    await frames(30);
  };
  if (!mesh.splatsData) {
    if (!mesh._splatPositions) throw new Error("loads, and keeps no numbers to read");
    const positions = [];
    const count = mesh._vertexCount ?? mesh.splatCount; // behind them the texture is filled up
    for (let k = 0; k + 3 < mesh._splatPositions.length && positions.length < 3 * count; k += 4)
      positions.push(...Vector3.TransformCoordinates(Vector3.FromArray(mesh._splatPositions, k), world).asArray());
    return { answer: { positions }, draw };
  }
  const data = new DataView(mesh.splatsData);
  const answer = { positions: [], colors: [], opacities: [], world: Array.from(world.asArray()) };
  for (let at = 0; at + 32 <= data.byteLength; at += 32) {
    const local = new Vector3(data.getFloat32(at, true), data.getFloat32(at + 4, true), data.getFloat32(at + 8, true));
    answer.positions.push(...Vector3.TransformCoordinates(local, world).asArray());
    for (let k = 0; k < 3; k++) answer.colors.push(data.getUint8(at + 24 + k) / 255);
    answer.opacities.push(data.getUint8(at + 27) / 255);
  }
  return { answer, draw };
}

async function supersplat() {
  if (!/\.(ply|sog)$/.test(file)) throw new Error("is not a format of it");
  const { createViewer } = await import("@playcanvas/supersplat-viewer/viewer");
  const initial = { position: EYE, target: [0, 0, 0], fov: 40 };
  const effects = Object.fromEntries(
    ["sharpness", "bloom", "grading", "vignette", "fringing"].map((name) => [name, { enabled: false }]),
  );
  const settings = {
    version: 2,
    tonemapping: "none",
    highPrecisionRendering: false,
    background: { color: [0.13, 0.13, 0.13] },
    postEffectSettings: effects,
    animTracks: [],
    cameras: [{ initial }],
    annotations: [],
    startMode: "default",
  };
  const viewer = await createViewer({ container: view, settings, contentUrl: url, renderer: "webgl", ui: false, nofx: true });
  for (let k = 0; k < 200 && !viewer.state.loaded; k++) await frames(1);
  const [component] = viewer.app.root.findComponents("gsplat");
  const resource = component.resource ?? component.asset.resource ?? viewer.app.assets.get(component.asset).resource;
  const world = component.entity.getWorldTransform();
  const centers = Array.from(resource.centers ?? resource.gsplatData.getCenters());
  const positions = [];
  const { Vec3 } = await import("playcanvas");
  for (let k = 0; k + 2 < centers.length; k += 3)
    positions.push(...world.transformPoint(new Vec3(centers[k], centers[k + 1], centers[k + 2])).toArray());
  const answer = { positions };
  const data = resource.gsplatData;
  const columnsOf = (names) => names.map((name) => data?.getProp?.(name));
  const [alpha] = columnsOf(["opacity"]);
  const dc = columnsOf(["f_dc_0", "f_dc_1", "f_dc_2"]);
  if (alpha) answer.opacities = Array.from(alpha, (value) => 1 / (1 + Math.exp(-value)));
  if (dc.every(Boolean)) answer.base = Array.from(dc[0], (_, k) => dc.map((one) => one[k])).flat();
  return { answer, draw: () => frames(30) };
}

// What fails in a worker or behind an event reaches no promise of ours.
const giveUp = (reason) => {
  window.answer ??= { error: String(reason?.message ?? reason).slice(0, 160) };
  window.done = true;
};
window.addEventListener("error", (event) => giveUp(event.error ?? event.message));
window.addEventListener("unhandledrejection", (event) => giveUp(event.reason));
const programs = { three, spark, "gaussian-splats-3d": gaussianSplats3d, babylon, supersplat };
try {
  const { answer, draw } = await programs[program]();
  window.answer = answer;
  try {
    await draw();
  } catch (error) {
    window.notDrawn = String(error?.message ?? error);
  }
} catch (error) {
  window.answer = { error: String(error?.message ?? error).slice(0, 160) };
}
window.done = true;
