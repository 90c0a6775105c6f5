/**
 * Healing. With a source it shows the copy while drawing and mends its colours at the end, when the border of the region is
 * known. Without one the region is shown light while it is drawn, and mended from its surroundings.
 */

import { editor } from "../editor/editor";
import { markMending, mend } from "../paint/mending";
import { chosenMask } from "../paint/stroke-target";
import { brushNeedsSurface } from "../paint/view-surface";
import { maskShows } from "../state/store";
import { OneSided } from "../ui/symmetry";
import { choosingFirst, copySource, copyingStroke, SourceButton } from "./copy-source";
import { freehand } from "./freehand";
import { BrushBar, Limits, MaskHint, Methods } from "./settings";
import type { ToolSpec } from "./tool";

const gesture = choosingFirst(
  freehand(
    (pen) => {
      if (copySource.value) return copyingStroke(pen, "Heal", true);
      const stroke = editor.strokes.begin("clone", "Heal", { oneSided: true });
      if (stroke) markMending(stroke);
      return stroke;
    },
    (stroke) => mend(stroke, copySource.value?.offset ?? null),
    true,
  ),
);

export const heal: ToolSpec = {
  name: "heal",
  icon: "heal",
  commands: [{ id: "tool.heal", label: "Heal", keys: ["J"] }],
  cursor: () => "ring",
  Settings: () => (
    <>
      <BrushBar mirrors={false} />
      <SourceButton />
      <MaskHint shows={maskShows.value} />
      {!chosenMask() && <OneSided why="healing stays on this side, whose tone and texture it takes" />}
      <Methods />
      <Limits />
    </>
  ),
  gesture,
  altClick: gesture.down,
  copies: true,
  limited: true,
  needsSurface: brushNeedsSurface,
};
