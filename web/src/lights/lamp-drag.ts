/** Lamps in the view: where they and what they reach are on the screen, and where a drag takes them. Pure. */

import { add, cross, dot, scale, sub, unit, type CameraJson, type Vec3 } from "../view/camera";
import { AIMED, type LampLight } from "./lights";

/** Pixels of a drag along the view that double, or halve, the distance. */
const DOUBLING_PX = 120;
/** Corners by which a circle is drawn. */
const CORNERS = 24;

const rowOf = (now: CameraJson, k: number): Vec3 => now.world_to_camera[k].slice(0, 3) as Vec3;

/** Where the eye of a view is. */
export function eyeOf(now: CameraJson): Vec3 {
  const back = [0, 1, 2].map((k) => scale(rowOf(now, k), -now.world_to_camera[k][3]));
  return add(add(back[0], back[1]), back[2]);
}

/** A point after a drag across the view, by pixels of the camera, at its own distance. */
export function draggedAcross(now: CameraJson, point: Vec3, dx: number, dy: number): Vec3 {
  const depth = dot(rowOf(now, 2), sub(point, eyeOf(now)));
  const by = add(scale(rowOf(now, 0), (dx * depth) / now.fx), scale(rowOf(now, 1), (dy * depth) / now.fy));
  return add(point, by);
}

/** A point after a drag along its line of sight: upwards is away. `dy`: pixels of the screen. */
export function draggedAlong(now: CameraJson, point: Vec3, dy: number): Vec3 {
  const eye = eyeOf(now);
  return add(eye, scale(sub(point, eye), 2 ** (-dy / DOUBLING_PX)));
}

/** Outlines of a lamp's area, in the world: a rectangle, a disk, a sphere as three circles; a spot's cone to its target. */
export function outlines(lamp: LampLight): Vec3[][] {
  const [at, to] = [lamp.position as Vec3, lamp.target as Vec3];
  const axis = AIMED.includes(lamp.kind) ? unit(sub(to, at)) : ([0, 0, 1] as Vec3);
  const side = sideOf(axis);
  const other = cross(axis, side);
  const [first = 0, second = 0] = lamp.sizes;
  if (lamp.kind === "rect") {
    const corner = (x: number, y: number) => add(at, add(scale(side, (x * first) / 2), scale(other, (y * second) / 2)));
    return [[corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1), corner(-1, -1)]];
  }
  if (lamp.kind === "disk") return [circle(at, side, other, first)];
  if (lamp.kind === "sphere") {
    const axes: Vec3[] = [
      [1, 0, 0],
      [0, 1, 0],
      [0, 0, 1],
    ];
    return axes.map((one, k) => circle(at, one, axes[(k + 1) % 3], first));
  }
  if (lamp.kind === "spot") {
    const length = Math.hypot(...sub(to, at));
    const rim = circle(to, side, other, length * Math.tan((first / 2) * (Math.PI / 180)));
    return [rim, ...[0, 6, 12, 18].map((k) => [at, rim[k]])];
  }
  return [];
}

/** Across a unit axis, as `across` of lights/lamps.py has it, along which a rectangle's width lies. */
function sideOf(axis: Vec3): Vec3 {
  const sizes = axis.map(Math.abs);
  const basis: Vec3 = [0, 0, 0];
  basis[sizes.indexOf(Math.min(...sizes))] = 1;
  return unit(cross(axis, basis));
}

function circle(center: Vec3, u: Vec3, v: Vec3, radius: number): Vec3[] {
  return Array.from({ length: CORNERS + 1 }, (_, k) => {
    const angle = (2 * Math.PI * k) / CORNERS;
    return add(center, add(scale(u, radius * Math.cos(angle)), scale(v, radius * Math.sin(angle))));
  });
}
