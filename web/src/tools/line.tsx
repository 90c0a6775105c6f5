/** A straight line: drag from end to end; Shift keeps to multiples of 45 degrees. */

import { editor } from "../editor/editor";
import { brushFor, colorSource, grainOf } from "../paint/brush";
import { shadingApplies } from "../paint/brush-settings";
import { DabPath, type Brush } from "../paint/dabs";
import { union } from "../paint/raster";
import type { Stroke } from "../paint/stroke";
import { brushNeedsSurface } from "../paint/view-surface";
import { maskShows } from "../state/store";
import { BrushBar, Limits, MaskHint, Methods, PaintModes, RecentColors, Spreading } from "./settings";
import type { Pen, ToolGesture, ToolSpec } from "./tool";

const SHIFT_STEP_RADIANS = Math.PI / 4;

function straight(): ToolGesture {
  let drawn: { stroke: Stroke; start: Pen; brush: Brush } | null = null;
  return {
    inAnotherView: "ends",
    down(pen) {
      const stroke = editor.strokes.begin("paint", "Line", { spreads: true });
      if (!stroke) return;
      drawn = { stroke, start: pen, brush: { ...brushFor(pen.x, pen.y), pressureSize: false, pressureFlow: false } };
      stroke.setSource(colorSource(stroke));
      stroke.setGrain(grainOf());
    },
    move(pen) {
      if (!drawn) return;
      const { stroke, start, brush } = drawn;
      let [dx, dy] = [pen.x - start.x, pen.y - start.y];
      if (pen.shift) {
        const angle = Math.round(Math.atan2(dy, dx) / SHIFT_STEP_RADIANS) * SHIFT_STEP_RADIANS;
        const length = Math.hypot(dx, dy);
        [dx, dy] = [Math.cos(angle) * length, Math.sin(angle) * length];
      }
      stroke.reset();
      const path = new DabPath(stroke.mask, brush); // anew, with the same seed: jitter does not flicker
      const begun = path.down({ x: start.x, y: start.y, pressure: 1 });
      const more = path.move({ x: start.x + dx, y: start.y + dy, pressure: 1 });
      stroke.touch(union(union(begun, more), path.up()));
    },
    up() {
      if (drawn) void editor.strokes.end(drawn.stroke);
      drawn = null;
    },
    cancel() {
      if (drawn) void editor.strokes.cancel(drawn.stroke);
      drawn = null;
    },
  };
}

export const line: ToolSpec = {
  name: "line",
  icon: "line",
  commands: [{ id: "tool.line", label: "Line", keys: ["U"] }],
  cursor: () => "ring",
  Settings: () => (
    <>
      <BrushBar shading={shadingApplies.value} />
      <MaskHint shows={maskShows.value} />
      <PaintModes />
      <RecentColors />
      <Methods />
      <Limits />
      <Spreading />
    </>
  ),
  gesture: straight(),
  limited: true,
  needsSurface: brushNeedsSurface,
};
