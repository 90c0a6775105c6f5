/** Whether strokes are mirrored, and in which plane: the one that the server finds, or one of the axes, adjusted. */

import { computed, signal } from "@preact/signals";

import type { Symmetry } from "../messages";
import { paintMode, state } from "../state/store";
import { add, project, scale, sub, type CameraJson, type Vec3 } from "../view/camera";
import { keptShading } from "./brush-settings";
import { adjusted, mirrored, planeAt, type Plane } from "./mirror";
import { surfaceOf } from "./view-surface";

export type PlaneChoice = "found" | "x" | "y" | "z";

export const symmetry = signal<{ on: boolean; plane: PlaneChoice; shift: number; angle: number; lean: number }>({
  on: false,
  plane: "found",
  shift: 0,
  angle: 0,
  lean: 0,
});
/** The asset's plane, of one session. */
export const assetPlane = signal<{ session: string; plane: Plane; agreement: number } | null>(null);

const AXES: Record<Exclude<PlaneChoice, "found">, Vec3> = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };

/** The plane in which strokes are mirrored; null: they are not. */
export const mirrorPlane = computed<Plane | null>(() => {
  const { on, plane, shift, angle, lean } = symmetry.value;
  const now = state.value;
  if (!on || !now) return null;
  const { center, radius, up } = now.asset;
  const measured = assetPlane.value?.session === now.session ? assetPlane.value.plane : null;
  const start = plane === "found" ? measured : planeAt(AXES[plane], center as Vec3);
  return start && adjusted(start, center as Vec3, up as Vec3, shift * radius, angle, lean);
});

/** What a stroke that begins now is told about it. */
export function mirrorOfStroke(kind: "paint" | "clone" | "erase" | "mask"): Symmetry | null {
  const plane = mirrorPlane.value;
  if (!plane || kind === "mask") return null;
  const keep = kind === "paint" ? (paintMode.value === "color" ? 1 : keptShading.value) : 0;
  return { normal: plane.normal, offset: plane.offset, keep };
}

/** Where the mirrored brush is on the view, and whether something stands before it; null: nowhere. */
export function mirroredPixel(
  view: CameraJson,
  x: number,
  y: number,
): { x: number; y: number; hidden: boolean } | null {
  const plane = mirrorPlane.value;
  const surface = surfaceOf(view);
  const at = plane && surface?.at(x, y);
  if (!plane || !surface || !at) return null;
  const rows = view.world_to_camera.slice(0, 3);
  const local = sub(at.point, rows.map((row) => row[3]) as Vec3);
  const world = rows.reduce((sum: Vec3, row, k) => add(sum, scale(row.slice(0, 3) as Vec3, local[k])), [0, 0, 0]);
  const [u, v, depth] = project(view, mirrored(plane, world));
  if (!(depth > 0)) return null;
  const there = surface.at(u, v);
  const margin = 0.03 * at.point[2];
  return { x: u, y: v, hidden: !there || there.point[2] < depth - margin };
}
