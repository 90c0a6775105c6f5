/** Takes away the chosen layer's paint; with Shift, and where no paint is chosen, everything down to the original. */

import { editor } from "../editor/editor";
import type { Pixels } from "../paint/flood";
import { picture } from "../paint/patch";
import { chosenEraser, chosenMask, chosenPaintLayer } from "../paint/stroke-target";
import { brushNeedsSurface } from "../paint/view-surface";
import { maskShows } from "../state/store";
import { freehand, maskStroke } from "./freehand";
import { BrushBar, MaskHint, Methods } from "./settings";
import type { ToolSpec } from "./tool";

const gesture = freehand((pen) => {
  const masked = chosenMask();
  if (masked) return maskStroke(!maskShows.value, masked);
  const chosen = pen.shift ? null : chosenPaintLayer();
  if (chosen?.kind === "merged") return maskStroke(false, chosen); // all that it is made of goes there
  const more = chosenEraser();
  const stroke = chosen
    ? editor.strokes.begin("erase", "Erase")
    : editor.strokes.begin("erase", "Erase to original", { target: more ? { layer: more.id } : {} });
  if (!stroke) return null;
  let original: Pixels | null = null;
  stroke.setSource(picture(() => original ?? stroke.base));
  editor.pixels.original(chosen?.id ?? null).then(
    (pixels) => {
      original = pixels;
      stroke.paint();
    },
    () => {}, // the toast was shown; erasing works without its picture
  );
  return stroke;
});

export const eraser: ToolSpec = {
  name: "erase",
  icon: "erase",
  commands: [{ id: "tool.erase", label: "Eraser", keys: ["E"] }],
  cursor: () => "ring",
  Settings: () => (
    <>
      <BrushBar />
      <MaskHint shows={!maskShows.value} />
      {!chosenMask() && <span class="hint">This layer's paint; Shift: back to the original</span>}
      <Methods />
    </>
  ),
  gesture,
  needsSurface: brushNeedsSurface,
  paintsMasks: true,
};
