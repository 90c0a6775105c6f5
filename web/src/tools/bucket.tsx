/** The paint bucket: one click paints what has the colour of the pixel under it. */

import { editor, report } from "../editor/editor";
import { colorSource, grainOf } from "../paint/brush";
import { shadingApplies } from "../paint/brush-settings";
import { likeColor, soften } from "../paint/flood";
import { brush, fill } from "../state/store";
import { KeepShading } from "../ui/brush-size";
import { Check, Percent } from "../ui/parts";
import { SymmetryButton } from "../ui/symmetry";
import { Limits, Methods, PaintModes, RecentColors, Spreading } from "./settings";
import { nothing, type Pen, type ToolSpec } from "./tool";

async function fillAt(pen: Pen): Promise<void> {
  const { tolerance, contiguous } = fill.value;
  const pixels = await editor.pixels.now();
  const mask = soften(likeColor(pixels, Math.floor(pen.x), Math.floor(pen.y), tolerance, contiguous), 1);
  const stroke = editor.strokes.begin("paint", "Bucket", { spreads: true });
  if (!stroke) return;
  stroke.setSource(colorSource(stroke));
  stroke.setGrain(grainOf());
  stroke.mask.data.set(mask.data);
  stroke.touch({ x: 0, y: 0, width: mask.width, height: mask.height });
  await editor.strokes.end(stroke);
}

function Settings() {
  const f = fill.value;
  return (
    <>
      <Percent label="Tolerance" value={f.tolerance} onInput={(v) => (fill.value = { ...f, tolerance: v })} />
      <Percent
        label="Opacity"
        value={brush.value.opacity}
        min={0.01}
        onInput={(v) => (brush.value = { ...brush.value, opacity: v })}
      />
      <Check
        label="Connected only"
        value={f.contiguous}
        onChange={(contiguous) => (fill.value = { ...f, contiguous })}
      />
      {shadingApplies.value && <KeepShading />}
      <SymmetryButton />
      <PaintModes />
      <RecentColors />
      <Methods />
      <Limits />
      <Spreading />
    </>
  );
}

export const bucket: ToolSpec = {
  name: "fill",
  icon: "fill",
  commands: [{ id: "tool.fill", label: "Paint bucket", keys: ["G"] }],
  cursor: () => "cross",
  Settings,
  gesture: { down: (pen) => void fillAt(pen).catch(report), move: nothing, up: nothing, cancel: nothing },
  limited: true,
};
