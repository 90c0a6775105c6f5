/** A plane of symmetry: mirrored points, its outline around the asset, and what turning it does. Pure. */

import { add, cross, dot, scale, sub, turn, unit, type Vec3 } from "../view/camera";

/** Points x with normal x = offset; the normal is unit, world axes. */
export interface Plane {
  normal: Vec3;
  offset: number;
}

export const mirrored = ({ normal, offset }: Plane, point: Vec3): Vec3 =>
  sub(point, scale(normal, 2 * (dot(normal, point) - offset)));

/** The plane through a point. */
export const planeAt = (normal: Vec3, point: Vec3): Plane => {
  const n = unit(normal);
  return { normal: n, offset: dot(n, point) };
};

/**
 * A plane moved along its normal (world units) and turned about the point of it that is nearest to `center`: by `angle`
 * around `up` and by `lean` around the line in it that is level (degrees).
 */
export function adjusted(plane: Plane, center: Vec3, up: Vec3, shift: number, angle: number, lean: number): Plane {
  const nearest = add(center, scale(plane.normal, plane.offset - dot(plane.normal, center)));
  let normal = turn(plane.normal, up, (angle * Math.PI) / 180);
  const level = cross(up, normal);
  if (Math.hypot(...level) > 1e-6) normal = turn(normal, unit(level), (lean * Math.PI) / 180);
  return planeAt(normal, add(nearest, scale(normal, shift)));
}

/** A circle in the plane around the asset: points of it in order. */
export function outlineOf(plane: Plane, center: Vec3, radius: number, count = 72): Vec3[] {
  const middle = add(center, scale(plane.normal, plane.offset - dot(plane.normal, center)));
  const side: Vec3 = Math.abs(plane.normal[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0];
  const right = unit(cross(plane.normal, side));
  const ahead = cross(right, plane.normal);
  return Array.from({ length: count }, (_, k) => {
    const angle = (2 * Math.PI * k) / count;
    return add(middle, add(scale(right, radius * Math.cos(angle)), scale(ahead, radius * Math.sin(angle))));
  });
}
