/** Cameras as the server speaks of them (OpenCV axes, row-major world_to_camera), and the orbit that moves one. */

/** splatpainter.cameras.Camera as JSON. */
export interface CameraJson {
  version: 1;
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  world_to_camera: number[][];
  background: number[];
  asset_sha256?: string | null;
}

export type Vec3 = [number, number, number];

/** Where one looks from, without a picture size. Axes in world space: right, down, forward (orthonormal). */
export interface Pose {
  eye: Vec3;
  right: Vec3;
  down: Vec3;
  forward: Vec3;
  /** The point that orbiting goes around lies this far ahead. */
  distance: number;
  /** Vertical field of view, degrees. */
  fov: number;
}

export const add = (a: Vec3, b: Vec3): Vec3 => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a: Vec3, b: Vec3): Vec3 => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a: Vec3, k: number): Vec3 => [a[0] * k, a[1] * k, a[2] * k];
export const dot = (a: Vec3, b: Vec3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a: Vec3, b: Vec3): Vec3 => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const unit = (a: Vec3): Vec3 => scale(a, 1 / (Math.hypot(...a) || 1));

export const target = (pose: Pose): Vec3 => add(pose.eye, scale(pose.forward, pose.distance));

/** A pose at `eye` facing `at`; `up` points up in the picture. */
export function lookAt(eye: Vec3, at: Vec3, up: Vec3, fov: number): Pose {
  const forward = unit(sub(at, eye));
  let side = cross(forward, up);
  if (Math.hypot(...side) < 1e-6) side = cross(forward, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 0, 1]);
  const right = unit(side);
  return { eye, right, down: cross(forward, right), forward, distance: Math.hypot(...sub(at, eye)), fov };
}

/** The camera that sees a pose in a picture of width x height pixels. */
export function toCamera(pose: Pose, width: number, height: number, background: number[]): CameraJson {
  const focal = height / (2 * Math.tan((pose.fov * Math.PI) / 360));
  const rows = [pose.right, pose.down, pose.forward].map((axis) => [...axis, -dot(axis, pose.eye)]);
  return {
    version: 1,
    width,
    height,
    fx: focal,
    fy: focal,
    cx: width / 2,
    cy: height / 2,
    world_to_camera: [...rows, [0, 0, 0, 1]],
    background,
  };
}

/** The pose of a camera; what orbiting goes around is the point of its axis nearest to `around`. */
export function fromCamera(camera: CameraJson, around: Vec3): Pose {
  const [r, d, f] = camera.world_to_camera;
  const axis = (row: number[]): Vec3 => [row[0], row[1], row[2]];
  const [right, down, forward] = [axis(r), axis(d), axis(f)];
  const eye = add(add(scale(right, -r[3]), scale(down, -d[3])), scale(forward, -f[3]));
  const ahead = dot(sub(around, eye), forward);
  const size = Math.hypot(...sub(around, eye)) || 1;
  const fov = (Math.atan(camera.height / (2 * camera.fy)) * 360) / Math.PI;
  return { eye, right, down, forward, distance: ahead > 0.05 * size ? ahead : size, fov };
}

/** `v` turned by `angle` radians around the unit axis `k` (Rodrigues). */
export function turn(v: Vec3, k: Vec3, angle: number): Vec3 {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return add(add(scale(v, c), scale(cross(k, v), s)), scale(k, dot(k, v) * (1 - c)));
}

/** Turn around the target: `yaw` around the world's up, `pitch` around the picture's x axis (radians), short of the poles. */
export function orbit(pose: Pose, yaw: number, pitch: number, up: Vec3): Pose {
  const about = target(pose);
  const height = Math.asin(Math.max(-1, Math.min(1, -dot(pose.forward, up))));
  const limit = (89.5 * Math.PI) / 180;
  const next = Math.max(-limit, Math.min(limit, height + pitch));
  const tilt = Math.abs(height) > limit && Math.abs(next) >= limit ? 0 : next - height;
  const move = (v: Vec3): Vec3 => turn(turn(v, pose.right, -tilt), unit(up), yaw);
  const forward = unit(move(pose.forward));
  const raw = move(pose.right);
  const right = unit(sub(raw, scale(forward, dot(raw, forward))));
  return { ...pose, forward, right, down: cross(forward, right), eye: sub(about, scale(forward, pose.distance)) };
}

/** Slide in the picture plane so that the target moves by (dx, dy) pixels of a picture `height` pixels high. */
export function pan(pose: Pose, dx: number, dy: number, height: number): Pose {
  const perPixel = (2 * pose.distance * Math.tan((pose.fov * Math.PI) / 360)) / height;
  return { ...pose, eye: add(pose.eye, add(scale(pose.right, -dx * perPixel), scale(pose.down, -dy * perPixel))) };
}

/** Come closer (factor < 1) or go away, keeping the target. */
export function dolly(pose: Pose, factor: number, nearest: number): Pose {
  const distance = Math.max(nearest, pose.distance * factor);
  return { ...pose, eye: sub(target(pose), scale(pose.forward, distance)), distance };
}

/** Look the same way at a sphere that then fills the picture. */
export function frame(pose: Pose, center: Vec3, radius: number, aspect: number): Pose {
  const half = (pose.fov * Math.PI) / 360;
  const narrow = Math.min(half, Math.atan(Math.tan(half) * aspect));
  const distance = (radius / Math.sin(narrow)) * 1.05;
  return { ...pose, eye: sub(center, scale(pose.forward, distance)), distance };
}

/**
 * Pixels of a view that fills width x height pixels of the page (CSS) with `factor` of its own in each direction, or
 * fewer where that would be more than `most`; density: how many there are then.
 */
export function viewSize(
  width: number,
  height: number,
  factor: number,
  most: number,
): { width: number; height: number; density: number } {
  const density = Math.min(factor, Math.sqrt(most / Math.max(1, width * height)));
  const side = density < factor ? Math.floor : Math.round;
  return { width: Math.max(16, side(width * density)), height: Math.max(16, side(height * density)), density };
}

/** The pose for a window of another shape (width / height): what fitted into the old one fits into the new one. */
export function reshaped(pose: Pose, before: number, after: number): Pose {
  const factor = Math.min(1, before) / Math.min(1, after);
  return factor === 1 ? pose : dolly(pose, factor, 0);
}

/** Another field of view with the target as large as before. */
export function zoomLens(pose: Pose, fov: number): Pose {
  const factor = Math.tan((pose.fov * Math.PI) / 360) / Math.tan((fov * Math.PI) / 360);
  return { ...dolly(pose, factor, 0), fov };
}

/** A world point's pixel [x, y] and its depth; depth <= 0 is behind the camera. */
export function project(camera: CameraJson, point: Vec3): [number, number, number] {
  const [x, y, z] = camera.world_to_camera
    .slice(0, 3)
    .map((row) => row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);
  return [camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy, z];
}

export function sameView(a: CameraJson, b: CameraJson): boolean {
  const numbers = (c: CameraJson) => [
    c.width,
    c.height,
    c.fx,
    c.fy,
    c.cx,
    c.cy,
    ...c.background,
    ...c.world_to_camera.flat(),
  ];
  const other = numbers(b);
  return numbers(a).every((value, k) => value === other[k]);
}

/** Whether two pictures show the same, be it with other pixels and another background. */
export function sameViewpoint(a: CameraJson, b: CameraJson): boolean {
  const intrinsics = (c: CameraJson) => [c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height];
  const extrinsics = (c: CameraJson) => c.world_to_camera.flat();
  const close = (one: number[], two: number[], tolerance: number) =>
    one.every((v, k) => Math.abs(v - two[k]) <= tolerance);
  const scale = Math.max(1, ...extrinsics(a).map(Math.abs));
  return close(intrinsics(a), intrinsics(b), 2e-3) && close(extrinsics(a), extrinsics(b), 1e-5 * scale);
}

/** Where pixels of one picture lie in another one from the same eye, of another window; null: the eye is elsewhere. */
export function rewindowed(
  from: CameraJson,
  to: CameraJson,
): { scale: number; at: (x: number, y: number) => [number, number] } | null {
  if (!from.world_to_camera.flat().every((v, k) => v === to.world_to_camera.flat()[k])) return null;
  const scale = to.fx / from.fx;
  return { scale, at: (x, y) => [to.cx + (x - from.cx) * scale, to.cy + (y - from.cy) * scale] };
}

/** Turn around any point, so that it stays where it is in the picture's axes: orbit about what was clicked. */
export function orbitAbout(pose: Pose, pivot: Vec3, yaw: number, pitch: number, up: Vec3): Pose {
  const turned = orbit(pose, yaw, pitch, up);
  const local = (p: Pose, v: Vec3): Vec3 => [dot(v, p.right), dot(v, p.down), dot(v, p.forward)];
  const [x, y, z] = local(pose, sub(pivot, pose.eye));
  const offset = add(add(scale(turned.right, x), scale(turned.down, y)), scale(turned.forward, z));
  return { ...turned, eye: sub(pivot, offset), distance: z > 0 ? z : pose.distance };
}

/** Look around from where one stands (radians, as of `orbit`). */
export function look(pose: Pose, yaw: number, pitch: number, up: Vec3): Pose {
  return { ...orbitAbout(pose, pose.eye, yaw, pitch, up), distance: pose.distance };
}

/** Come closer (factor < 1) to a point or go away from it; it stays at its pixel. */
export function zoomTo(pose: Pose, point: Vec3, factor: number, nearest: number): Pose {
  const away = sub(pose.eye, point);
  const before = Math.hypot(...away);
  if (before === 0) return pose;
  const after = Math.max(Math.min(nearest, before), before * factor);
  const eye = add(point, scale(away, after / before));
  const depth = dot(sub(point, eye), pose.forward);
  return { ...pose, eye, distance: depth > 0 ? depth : pose.distance };
}

/** Step by [right, down, forward] world units. */
export function step(pose: Pose, by: Vec3): Pose {
  const move = add(add(scale(pose.right, by[0]), scale(pose.down, by[1])), scale(pose.forward, by[2]));
  return { ...pose, eye: add(pose.eye, move) };
}

/** Unit direction of the ray through a point of the picture: x, y as shares -1..1 of half its width and height. */
export function rayOf(pose: Pose, x: number, y: number, aspect: number): Vec3 {
  const half = Math.tan((pose.fov * Math.PI) / 360);
  return unit(add(pose.forward, add(scale(pose.right, x * half * aspect), scale(pose.down, y * half))));
}

/** The target seen along `forward` (unit), from as far away; where that is along `up`, `ahead` points up. */
export function lookAlong(pose: Pose, forward: Vec3, up: Vec3, ahead: Vec3): Pose {
  const eye = sub(target(pose), scale(forward, pose.distance));
  const above = Math.abs(dot(forward, up)) > 0.999 ? scale(ahead, dot(forward, up) > 0 ? -1 : 1) : up;
  return { ...lookAt(eye, target(pose), above, pose.fov), distance: pose.distance };
}

/** A point in the middle, seen from the same side and `distance` away. */
export function focusOn(pose: Pose, point: Vec3, distance: number): Pose {
  return { ...pose, eye: sub(point, scale(pose.forward, distance)), distance };
}

/** The pose at share t (0..1) of the way from one to another: a turn around one axis, the target on a straight line. */
export function between(a: Pose, b: Pose, t: number): Pose {
  const [axis, angle] = rotationBetween(a, b);
  const move = (v: Vec3): Vec3 => turn(v, axis, angle * t);
  const forward = unit(move(a.forward));
  const raw = move(a.right);
  const right = unit(sub(raw, scale(forward, dot(raw, forward))));
  const distance = a.distance ** (1 - t) * b.distance ** t;
  const at = add(scale(target(a), 1 - t), scale(target(b), t));
  const fov = a.fov + (b.fov - a.fov) * t;
  return { eye: sub(at, scale(forward, distance)), right, down: cross(forward, right), forward, distance, fov };
}

/** Axis and angle (radians) of the turn that brings the axes of one pose onto another's. */
function rotationBetween(a: Pose, b: Pose): [Vec3, number] {
  const from = [a.right, a.down, a.forward];
  const to = [b.right, b.down, b.forward];
  const m = (i: number, j: number) => to[0][i] * from[0][j] + to[1][i] * from[1][j] + to[2][i] * from[2][j];
  const cosine = Math.max(-1, Math.min(1, (m(0, 0) + m(1, 1) + m(2, 2) - 1) / 2));
  const skew: Vec3 = [m(2, 1) - m(1, 2), m(0, 2) - m(2, 0), m(1, 0) - m(0, 1)];
  if (Math.hypot(...skew) > 1e-6) return [unit(skew), Math.acos(cosine)];
  if (cosine > 0) return [[0, 0, 1], 0];
  // half a turn: the axis is the column of M + 1 that is longest
  const columns = [0, 1, 2].map((j) => [0, 1, 2].map((i) => m(i, j) + (i === j ? 1 : 0)) as Vec3);
  columns.sort((p, q) => Math.hypot(...q) - Math.hypot(...p));
  return [unit(columns[0]), Math.PI];
}
