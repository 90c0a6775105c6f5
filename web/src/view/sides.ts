/** The sides of an asset: its front is where the first view looks from, its top is up on the screen. Pure. */

import type { AssetInfo } from "../messages";
import { cross, dot, scale, sub, unit, type Vec3 } from "./camera";

export type Side = "front" | "back" | "left" | "right" | "top" | "bottom";

/**
 * How to look from a side: `forward` and `up` in the world, and `ahead`, which is up on the screen where one looks along
 * `up`. A vector in place of a name is the direction in which the eye stands.
 */
export function axesOf(
  { up: above, home }: Pick<AssetInfo, "up" | "home">,
  side: Side | Vec3,
): { forward: Vec3; up: Vec3; ahead: Vec3 } {
  const up = unit(above as Vec3);
  const facing = home.world_to_camera[2].slice(0, 3) as Vec3;
  const ahead = unit(sub(facing, scale(up, dot(facing, up))));
  const right = cross(ahead, up);
  const eyes: Record<Side, Vec3> = {
    front: scale(ahead, -1),
    back: ahead,
    right,
    left: scale(right, -1),
    top: up,
    bottom: scale(up, -1),
  };
  const eye = typeof side === "string" ? eyes[side] : unit(side);
  return { forward: scale(eye, -1), up, ahead };
}
