/** Pictures that lie on the surface: where their corners are, and how they look there until the server has laid them. Pure. */

import { add, cross, dot, scale, sub, unit, type CameraJson, type Vec3 } from "../view/camera";
import type { Pixels } from "./flood";
import type { Rect } from "./raster";
import type { SurfaceView } from "./surface-blocks";

/** A picture's middle on the surface, world units. */
export interface Anchor {
  point: Vec3;
  /** Unit, outwards. */
  normal: Vec3;
  /** Unit tangent: the picture's up. */
  up: Vec3;
  /** World units per pixel of the picture. */
  unit: number;
  /** Where it was put: the server looks for the surface under this pixel of this view, whichever one is seen now. */
  camera: CameraJson;
  x: number;
  y: number;
}

/** Which place of a picture the middle of each block of a view shows. */
export interface DecalMap {
  block: number;
  columns: number;
  rows: number;
  /** [rows, columns, 2] world units right and up of the picture's middle; NaN where it shows none. */
  places: Float32Array;
}

/** Sine of the angle between a surface and the object's up from which pictures stand upright on it: the server's rule. */
const MIN_LEVEL_SINE = 0.26;

const rotated = (camera: CameraJson, v: Vec3): Vec3 =>
  [0, 1, 2].map((k) => dot(camera.world_to_camera[k].slice(0, 3) as Vec3, v)) as Vec3;

/** A world point in the camera's axes. */
export const toView = (camera: CameraJson, point: Vec3): Vec3 =>
  add(rotated(camera, point), camera.world_to_camera.slice(0, 3).map((row) => row[3]) as Vec3);

/** A direction in the camera's axes as one of the world. */
const toWorld = (camera: CameraJson, v: Vec3): Vec3 =>
  [0, 1, 2].reduce((sum: Vec3, k) => add(sum, scale(camera.world_to_camera[k].slice(0, 3) as Vec3, v[k])), [0, 0, 0]);

const pixelOf = ({ fx, fy, cx, cy }: CameraJson, [x, y, z]: Vec3): [number, number] => [
  cx + (fx * x) / z,
  cy + (fy * y) / z,
];

/** The object's up (level), or on what lies flat the view's, laid on a surface: the rule of the server's decals. */
function levelUp(camera: CameraJson, normal: Vec3, level: Vec3 | null): Vec3 {
  const row = (k: number): Vec3 => camera.world_to_camera[k].slice(0, 3) as Vec3;
  const flat = (v: Vec3): Vec3 => sub(v, scale(normal, dot(v, normal)));
  const upright = level && flat(unit(level));
  if (upright && Math.hypot(...upright) >= MIN_LEVEL_SINE) return unit(upright);
  const up = flat(scale(row(1), -1));
  return unit(Math.hypot(...up) < 0.05 ? flat(row(2)) : up);
}

/** Up of a picture that is turned by `angle` (radians, clockwise as seen from outside) against what is level. */
export function upAt(camera: CameraJson, normal: Vec3, angle: number, level: Vec3 | null): Vec3 {
  const up = levelUp(camera, normal, level);
  return add(scale(up, Math.cos(angle)), scale(cross(up, normal), Math.sin(angle)));
}

/** The angle of `upAt` that gives an anchor's up on a view. */
export function angleOf(camera: CameraJson, { normal, up }: Anchor, level: Vec3 | null): number {
  const upright = levelUp(camera, normal, level);
  return Math.atan2(dot(up, cross(upright, normal)), dot(up, upright));
}

/**
 * The anchor under a pixel; null where the view sees no surface there. around: world units, over which the surface's
 * direction is averaged: a picture does not follow every wrinkle.
 */
export function anchorAt(
  view: SurfaceView,
  x: number,
  y: number,
  angle: number,
  size: number,
  level: Vec3 | null,
  around = 0,
): Anchor | null {
  const at = view.at(x, y);
  if (!at) return null;
  const { camera, block, columns, rows } = view;
  let mean = at.normal;
  const reach = Math.min(Math.ceil((around * camera.fx) / at.point[2] / block), 24);
  const [u, v] = [Math.floor(x / block), Math.floor(y / block)];
  for (let j = Math.max(0, v - reach); j <= Math.min(rows - 1, v + reach); j++)
    for (let i = Math.max(0, u - reach); i <= Math.min(columns - 1, u + reach); i++) {
      const there = view.blockAt(j * columns + i);
      if (!there || dot(there.normal, at.normal) < 0.3) continue;
      const away = Math.hypot(...sub(there.point, at.point));
      if (away < around) mean = add(mean, scale(there.normal, 1 - away / around));
    }
  const translation = camera.world_to_camera.slice(0, 3).map((row) => row[3]) as Vec3;
  const normal = unit(toWorld(camera, mean));
  const point = toWorld(camera, sub(at.point, translation));
  return { point, normal, up: upAt(camera, normal, angle, level), unit: size, camera, x, y };
}

/** Pixel of the anchor on a view; depth <= 0: behind it. */
export function anchorPixel(camera: CameraJson, { point }: Anchor): { x: number; y: number; depth: number } {
  const local = toView(camera, point);
  const [x, y] = pixelOf(camera, local);
  return { x, y, depth: local[2] };
}

/**
 * Corners (left upper, right upper, right lower, left lower) of a picture of width x height pixels on its tangent plane,
 * and a knob `beyond` view pixels above it.
 */
export function decalHandles(
  camera: CameraJson,
  anchor: Anchor,
  width: number,
  height: number,
  beyond: number,
): { corners: [number, number][]; knob: [number, number] } {
  const right = cross(anchor.up, anchor.normal);
  const at = (u: number, v: number): [number, number] =>
    pixelOf(camera, toView(camera, add(anchor.point, add(scale(right, u), scale(anchor.up, v)))));
  const [w, h] = [(width * anchor.unit) / 2, (height * anchor.unit) / 2];
  const depth = toView(camera, anchor.point)[2];
  return {
    corners: [at(-w, h), at(w, h), at(w, -h), at(-w, -h)],
    knob: at(0, h + (beyond * depth) / camera.fy),
  };
}

/** The picture as a flat card on the tangent plane: how it is shown while it moves. width, height: world units. */
export function cardMap(
  camera: CameraJson,
  { point, normal, up }: Anchor,
  [width, height]: [number, number],
  block: number,
): DecalMap {
  const [columns, rows] = [Math.ceil(camera.width / block), Math.ceil(camera.height / block)];
  const places = new Float32Array(columns * rows * 2).fill(NaN);
  const middle = toView(camera, point);
  const [out, above] = [rotated(camera, normal), rotated(camera, up)];
  const right = cross(above, out);
  const height0 = dot(middle, out);
  for (let k = 0; k < columns * rows && height0 < 0; k++) {
    const [x, y] = [((k % columns) + 0.5) * block, (Math.floor(k / columns) + 0.5) * block];
    const ray: Vec3 = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1];
    const depth = height0 / dot(ray, out);
    if (!(depth > 0)) continue;
    const away = sub(scale(ray, depth), middle);
    const [u, v] = [dot(away, right), dot(away, above)];
    if (Math.abs(u) > 0.6 * width || Math.abs(v) > 0.6 * height) continue;
    places.set([u, v], 2 * k);
  }
  return { block, columns, rows, places };
}

/** Part of the view that may show the picture. */
export function decalBounds(map: DecalMap, camera: CameraJson, halfWidth: number, halfHeight: number): Rect | null {
  const { block, columns, rows, places } = map;
  let [left, top, right, bottom] = [Infinity, Infinity, -1, -1];
  for (let k = 0; k < columns * rows; k++) {
    if (!(Math.abs(places[2 * k]) <= halfWidth && Math.abs(places[2 * k + 1]) <= halfHeight)) continue;
    const [i, j] = [k % columns, Math.floor(k / columns)];
    [left, right] = [Math.min(left, i), Math.max(right, i)];
    [top, bottom] = [Math.min(top, j), Math.max(bottom, j)];
  }
  if (right < 0) return null;
  const [x, y] = [Math.max(0, (left - 1) * block), Math.max(0, (top - 1) * block)];
  const width = Math.min(camera.width, (right + 2) * block) - x;
  return { x, y, width, height: Math.min(camera.height, (bottom + 2) * block) - y };
}

/**
 * RGBA of a part of the view with the picture on its surface. picture: its pixels; size: of it on the surface, world
 * units.
 */
export function drawDecal(
  map: DecalMap,
  picture: Pixels,
  [width, height]: [number, number],
  part: Rect,
): Uint8ClampedArray<ArrayBuffer> {
  const out = new Uint8ClampedArray(part.width * part.height * 4);
  const { block, columns, rows, places } = map;
  for (let y = 0; y < part.height; y++) {
    const v = (part.y + y + 0.5) / block - 0.5;
    const iv = Math.floor(v);
    for (let x = 0; x < part.width; x++) {
      const u = (part.x + x + 0.5) / block - 0.5;
      const iu = Math.floor(u);
      let [total, across, above] = [0, 0, 0];
      for (let corner = 0; corner < 4; corner++) {
        const [i, j] = [iu + (corner & 1), iv + (corner >> 1)];
        if (i < 0 || j < 0 || i >= columns || j >= rows) continue;
        const at = 2 * (j * columns + i);
        if (!(places[at] === places[at])) continue; // NaN
        const weight = (1 - Math.abs(u - i)) * (1 - Math.abs(v - j));
        total += weight;
        across += weight * places[at];
        above += weight * places[at + 1];
      }
      if (total < 0.25) continue;
      const px = Math.floor((across / total / width + 0.5) * picture.width);
      const py = Math.floor((0.5 - above / total / height) * picture.height);
      if (px < 0 || py < 0 || px >= picture.width || py >= picture.height) continue;
      const from = (py * picture.width + px) * 4;
      const to = (y * part.width + x) * 4;
      for (let c = 0; c < 4; c++) out[to + c] = picture.data[from + c];
    }
  }
  return out;
}
