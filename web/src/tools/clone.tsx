/** The clone stamp: colours from another place of the view, or with relief, Gaussians from there. */

import { chosenMask } from "../paint/stroke-target";
import { brushNeedsSurface } from "../paint/view-surface";
import { maskShows } from "../state/store";
import { Check } from "../ui/parts";
import { OneSided } from "../ui/symmetry";
import { choosingFirst, choosingSource, copyingStroke, SourceButton } from "./copy-source";
import { freehand } from "./freehand";
import { relief, withRelief } from "./relief";
import { BrushBar, Limits, MaskHint, Methods } from "./settings";
import type { ToolSpec } from "./tool";

const gesture = withRelief(
  choosingFirst(freehand((pen) => copyingStroke(pen, "Clone"), undefined, true)),
  () => choosingSource.value,
);

export const clone: ToolSpec = {
  name: "clone",
  icon: "clone",
  commands: [{ id: "tool.clone", label: "Clone", keys: ["S"] }],
  cursor: () => "ring",
  Settings: () => (
    <>
      <BrushBar />
      <SourceButton />
      <Check label="With relief" value={relief.value} onChange={(on) => (relief.value = on)} />
      <MaskHint shows={maskShows.value} />
      {!chosenMask() && relief.value && <OneSided why="relief is copied to this side only" />}
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
