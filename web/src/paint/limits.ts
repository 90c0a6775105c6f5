/** Limits of what one view may paint, as the server takes them. */

import { type PaintLimits, RANGES } from "../messages";

export const [, MAX_ANGLE_DEGREES] = RANGES.PaintLimits.angle_limit;
export const [, MAX_DEPTH_EDGE_PX] = RANGES.PaintLimits.depth_edge_limit;

/** Whole numbers in their ranges, which sliders and typed numbers may leave. */
export function limitsToSend(limits: { angle: number; depthEdge: number }): PaintLimits {
  const within = (value: number, max: number) => Math.max(0, Math.min(max, Math.round(value)));
  return {
    angle_limit: within(limits.angle, MAX_ANGLE_DEGREES),
    depth_edge_limit: within(limits.depthEdge, MAX_DEPTH_EDGE_PX),
  };
}
