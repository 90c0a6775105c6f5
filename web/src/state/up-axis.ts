/** Which way of the asset is up on the screen: the six axes by name. */

import type { AssetUp } from "../messages";

export type Axis = AssetUp["up"];

export const AXES: readonly Axis[] = ["-y", "+y", "-z", "+z", "-x", "+x"];
export const OPPOSITE: Record<Axis, Axis> = { "-y": "+y", "+y": "-y", "-z": "+z", "+z": "-z", "-x": "+x", "+x": "-x" };

/** The name of a unit vector along one of the axes; null for any other. */
export function axisName(up: readonly number[] | undefined): Axis | null {
  const at = up?.findIndex((value) => value !== 0) ?? -1;
  return up && at >= 0 ? (`${up[at]! < 0 ? "-" : "+"}${"xyz"[at]}` as Axis) : null;
}
