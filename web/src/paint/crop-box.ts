/** The box along the world's axes in the view: a handle on each face, which moves it along its axis. */

import { camera, state } from "../state/store";
import { add, dot, project, scale, sub, unit, type CameraJson, type Vec3 } from "../view/camera";
import { nothing, type Pen, type ToolGesture } from "../tools/tool";
import { viewScale } from "./brush-settings";
import { cropBox } from "./selected";

export interface Box {
  low: Vec3;
  high: Vec3;
}

export interface BoxHandle {
  axis: 0 | 1 | 2;
  side: "low" | "high";
  /** View pixels. */
  x: number;
  y: number;
  /** The middle of its face, world units. */
  at: Vec3;
}

/** A handle is grabbed within so many pixels of the page. */
const GRAB_PX = 11;
/** Least width of the box, as a share of the asset's radius. */
const MIN_WIDTH_SHARE = 0.01;
/** How far the box may reach, in radii of the asset from its middle. */
const MAX_REACH = 1.5;

/** The handles that lie before the camera, farthest first. */
export function boxHandles(box: Box, view: CameraJson): BoxHandle[] {
  const middle = scale(add(box.low, box.high), 0.5);
  const seen: (BoxHandle & { depth: number })[] = [];
  for (const axis of [0, 1, 2] as const)
    for (const side of ["low", "high"] as const) {
      const at: Vec3 = [...middle];
      at[axis] = box[side][axis];
      const [x, y, depth] = project(view, at);
      if (depth > 0) seen.push({ axis, side, x, y, at, depth });
    }
  return seen.sort((a, b) => b.depth - a.depth);
}

/** The handle at a point of the view, the nearest of several; null: none. */
export function handleAt(box: Box, view: CameraJson, x: number, y: number): BoxHandle | null {
  const reach = (handle: BoxHandle) => Math.hypot(handle.x - x, handle.y - y);
  const near = boxHandles(box, view).filter((handle) => reach(handle) <= GRAB_PX * viewScale.value);
  return near.sort((a, b) => reach(a) - reach(b))[0] ?? null;
}

/** How far along `axis` (unit) from `from` the line comes nearest to what a pixel sees; null where it is seen end-on. */
export function alongAxis(view: CameraJson, from: Vec3, axis: Vec3, x: number, y: number): number | null {
  const rows = view.world_to_camera.slice(0, 3).map((row) => [row[0], row[1], row[2]] as Vec3);
  const offset = view.world_to_camera.slice(0, 3).map((row) => row[3]) as Vec3;
  const toWorld = (v: Vec3): Vec3 => add(add(scale(rows[0], v[0]), scale(rows[1], v[1])), scale(rows[2], v[2]));
  const eye = scale(toWorld(offset), -1);
  const ray = unit(toWorld([(x - view.cx) / view.fx, (y - view.cy) / view.fy, 1]));
  const away = sub(from, eye);
  const cosine = dot(axis, ray);
  const sine2 = 1 - cosine * cosine;
  return sine2 < 1e-4 ? null : (cosine * dot(ray, away) - dot(axis, away)) / sine2;
}

/** The box with one face moved; it keeps a width, and stays near the asset. */
export function withFace(box: Box, { axis, side }: Pick<BoxHandle, "axis" | "side">, to: number): Box {
  const { center, radius } = state.peek()?.asset ?? { center: box.low, radius: Infinity };
  const width = Number.isFinite(radius) ? radius * MIN_WIDTH_SHARE : 0;
  const [first, last] = [center[axis] - MAX_REACH * radius, center[axis] + MAX_REACH * radius];
  const inside = Math.max(first, Math.min(last, to));
  const next: Box = { low: [...box.low], high: [...box.high] };
  if (side === "low") next.low[axis] = Math.min(inside, box.high[axis] - width);
  else next.high[axis] = Math.max(inside, box.low[axis] + width);
  return next;
}

const axisOf = ({ axis }: BoxHandle): Vec3 => [0, 1, 2].map((k) => Number(k === axis)) as Vec3;

/** What takes the pen where it comes down on a handle; null: the tool does. */
export function boxGesture(pen: Pen): ToolGesture | null {
  const [before, view] = [cropBox.value, camera.value];
  const handle = before && view && handleAt(before, view, pen.x, pen.y);
  if (!before || !view || !handle) return null;
  const start = alongAxis(view, handle.at, axisOf(handle), pen.x, pen.y) ?? 0;
  return {
    inAnotherView: "goes on",
    down: nothing,
    move({ x, y }) {
      const now = camera.value && alongAxis(camera.value, handle.at, axisOf(handle), x, y);
      if (now !== null) cropBox.value = withFace(before, handle, handle.at[handle.axis] + now - start);
    },
    up: nothing,
    cancel: () => (cropBox.value = before),
  };
}
