/** Every tool, as the toolbar shows them from above, and taking one up. */

import { discardPlacement } from "../paint/lay-placement";
import { tab } from "../state/store";
import { brush } from "./brush";
import { bucket } from "./bucket";
import { clone } from "./clone";
import { eraser } from "./eraser";
import { eyedropper } from "./eyedropper";
import { heal } from "./heal";
import { line } from "./line";
import { orbit } from "./orbit";
import { select } from "./select";
import { stamp } from "./stamp";
import { textTool } from "./text";
import { tool, type Tool, type ToolSpec } from "./tool";

export const TOOLS: Record<Tool, ToolSpec> = {
  orbit,
  brush,
  erase: eraser,
  fill: bucket,
  line,
  text: textTool,
  stamp,
  clone,
  heal,
  pick: eyedropper,
  select,
};
export const ALL_TOOLS: readonly ToolSpec[] = Object.values(TOOLS);

/** The tool in hand. */
export const inHand = (): ToolSpec => TOOLS[tool.value];

/** Take a tool up; what was being placed with another one goes. */
export function chooseTool(next: ToolSpec): void {
  if (tool.value !== next.name) {
    void discardPlacement();
    if (next.tab) tab.value = next.tab;
  }
  tool.value = next.name;
}

/** Paint the mask of a layer from now on: with the tool in hand, where it can. */
export function takeMaskTool(): void {
  if (!inHand().paintsMasks) tool.value = brush.name;
}
