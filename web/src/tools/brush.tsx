/** The brush; on the mask of a layer, it hides or shows that. */

import { editor } from "../editor/editor";
import { colorSource } from "../paint/brush";
import { shadingApplies } from "../paint/brush-settings";
import { chosenMask } from "../paint/stroke-target";
import { brushNeedsSurface } from "../paint/view-surface";
import { color, maskShows, paintMode, setColor } from "../state/store";
import { freehand, maskStroke } from "./freehand";
import { BrushBar, Limits, MaskHint, Methods, PaintModes, RecentColors, Spreading } from "./settings";
import type { ToolSpec } from "./tool";

/** What a stroke is called in the history. */
const STROKE_NAMES = { normal: "Brush", color: "Colour", darken: "Darken", lighten: "Lighten" } as const;

const gesture = freehand(() => {
  const masked = chosenMask();
  if (masked) return maskStroke(maskShows.value, masked);
  const stroke = editor.strokes.begin("paint", STROKE_NAMES[paintMode.value], { spreads: true });
  if (!stroke) return null;
  stroke.setSource(colorSource(stroke));
  setColor(color.value); // one of the latest now
  return stroke;
});

export const brush: ToolSpec = {
  name: "brush",
  icon: "brush",
  commands: [{ id: "tool.brush", label: "Brush", keys: ["B"] }],
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
  gesture,
  limited: true,
  needsSurface: brushNeedsSurface,
  paintsMasks: true,
};
