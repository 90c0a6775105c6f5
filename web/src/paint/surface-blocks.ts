/** The surface that a view sees, on blocks of pixels (the server measures it): depth and normal at any pixel. Pure. */

import { add, cross, dot, scale, sub, unit, type CameraJson, type Vec3 } from "../view/camera";
import type { Frame } from "./dabs";

/** A point of the surface, camera axes (x right, y down, z forward). */
export interface SurfacePoint {
  point: Vec3;
  /** Unit, towards the camera. */
  normal: Vec3;
}

/** Blocks whose depths differ by more than this share of them belong to two surfaces. */
const SAME_SURFACE = 0.05;
/** Cosine between normal and line of sight to which a dab is foreshortened at most. */
const MIN_FACING = 0.25;

export class SurfaceView {
  /** data: [rows, columns, 4] depth (0: no surface) and normal of each block's middle. block: its pixels. */
  constructor(
    readonly camera: CameraJson,
    readonly block: number,
    readonly columns: number,
    readonly rows: number,
    private readonly data: Float32Array,
  ) {}

  /** Direction with z = 1 of the ray through a pixel. */
  ray(x: number, y: number): Vec3 {
    const { fx, fy, cx, cy } = this.camera;
    return [(x - cx) / fx, (y - cy) / fy, 1];
  }

  /** The surface in the middle of a block, by its number; null where there is none. */
  blockAt(k: number): SurfacePoint | null {
    const depth = this.data[4 * k];
    if (!(depth > 0)) return null;
    const [i, j] = [k % this.columns, Math.floor(k / this.columns)];
    const point = scale(this.ray((i + 0.5) * this.block, (j + 0.5) * this.block), depth);
    return { point, normal: [this.data[4 * k + 1], this.data[4 * k + 2], this.data[4 * k + 3]] };
  }

  /** The surface at a pixel; null where there is none. */
  at(x: number, y: number): SurfacePoint | null {
    const [u, v] = [x / this.block - 0.5, y / this.block - 0.5];
    const [iu, iv] = [Math.floor(u), Math.floor(v)];
    const ray = this.ray(x, y);
    let nearest = 0;
    let most = 0;
    const corners: { weight: number; middle: number; depth: number; normal: Vec3 }[] = [];
    for (const [dx, dy] of [
      [0, 0],
      [1, 0],
      [0, 1],
      [1, 1],
    ]) {
      const [i, j] = [iu + dx, iv + dy];
      if (i < 0 || j < 0 || i >= this.columns || j >= this.rows) continue;
      const k = (j * this.columns + i) * 4;
      const middle = this.data[k];
      if (!(middle > 0)) continue;
      const weight = (1 - Math.abs(u - i)) * (1 - Math.abs(v - j)) + 1e-6;
      const normal: Vec3 = [this.data[k + 1], this.data[k + 2], this.data[k + 3]];
      const center = scale(this.ray((i + 0.5) * this.block, (j + 0.5) * this.block), middle);
      const facing = dot(normal, ray);
      // the block's plane, unless it is seen from its edge
      const depth = facing < -0.05 ? dot(normal, center) / facing : middle;
      corners.push({ weight, middle, depth, normal });
      if (weight > most) [most, nearest] = [weight, middle];
    }
    if (!corners.length) return null;
    let [total, depth, normal]: [number, number, Vec3] = [0, 0, [0, 0, 0]];
    for (const corner of corners) {
      if (Math.abs(corner.middle - nearest) > SAME_SURFACE * nearest) continue;
      total += corner.weight;
      depth += corner.weight * corner.depth;
      normal = add(normal, scale(corner.normal, corner.weight));
    }
    return { point: scale(ray, depth / total), normal: unit(normal) };
  }
}

/** Axes on the tangent plane: `right` lies along the view's x axis, `down` along its y axis, as far as the plane lets them. */
export function tangentAxes(normal: Vec3): { right: Vec3; down: Vec3 } {
  const x: Vec3 = Math.abs(normal[0]) < 0.95 ? [1, 0, 0] : [0, 0, 1];
  const right = unit(sub(x, scale(normal, dot(x, normal))));
  return { right, down: cross(right, normal) }; // clockwise as seen from outside
}

/** A disc of a radius (world units) on the surface, as the view sees it. */
export function frameOnSurface(camera: CameraJson, { point, normal }: SurfacePoint, radius: number): Frame {
  const towards = unit(scale(point, -1));
  const facing = dot(normal, towards);
  let plane = normal;
  if (facing < MIN_FACING) {
    // seen from its edge a dab would be a line: lean it towards the view
    const side = unit(sub(normal, scale(towards, facing)));
    plane = add(scale(towards, MIN_FACING), scale(side, Math.sqrt(1 - MIN_FACING ** 2)));
  }
  const { right, down } = tangentAxes(plane);
  const [x, y, z] = point;
  const pixels = (v: Vec3): [number, number] => [
    (camera.fx / z) * (v[0] - (x / z) * v[2]) * radius,
    (camera.fy / z) * (v[1] - (y / z) * v[2]) * radius,
  ];
  const [u, v] = [pixels(right), pixels(down)];
  return [u[0], v[0], u[1], v[1]];
}

/** The same disc facing the view. */
export const facingFrame = (camera: CameraJson, depth: number, radius: number): Frame => [
  (camera.fx / depth) * radius,
  0,
  0,
  (camera.fy / depth) * radius,
];
