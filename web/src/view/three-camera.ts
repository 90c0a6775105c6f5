/** A three.js camera that is exactly a camera of the server: no look-at, no aspect, the matrices themselves. */

import * as THREE from "three";

import type { CameraJson } from "./camera";

/** Write `view` into `camera`. near and far only bound what is drawn; depth is not stored. */
export function setThreeCamera(camera: THREE.PerspectiveCamera, view: CameraJson, near: number, far: number): void {
  const { width: w, height: h, fx, fy, cx, cy } = view;
  const m = view.world_to_camera;
  camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
  const [r, d, f] = m;
  camera.matrixWorldInverse.set(
    r[0],
    r[1],
    r[2],
    r[3],
    -d[0],
    -d[1],
    -d[2],
    -d[3],
    -f[0],
    -f[1],
    -f[2],
    -f[3],
    0,
    0,
    0,
    1,
  );
  camera.matrixWorld.copy(camera.matrixWorldInverse).invert();
  camera.near = near;
  camera.far = far;
  // prettier-ignore
  camera.projectionMatrix.set(
    (2 * fx) / w, 0, 1 - (2 * cx) / w, 0,
    0, (2 * fy) / h, (2 * cy) / h - 1, 0,
    0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
    0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}
