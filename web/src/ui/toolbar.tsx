/** The tools at the left. */

import { discardPlacement } from "../paint/placement";
import { color, readOnly, tool, type Tool } from "../state/store";
import { setColor } from "../paint/point-tools";
import type { IconName } from "./icons";
import { Button } from "./parts";

/** In the order of their keys: V for the camera, 1 to 9, 0. */
export const TOOLS: readonly (readonly [Tool, string, string, IconName])[] = [
  ["orbit", "Turn the view", "V", "orbit"],
  ["brush", "Brush", "1", "brush"],
  ["erase", "Eraser: back to the original", "2", "erase"],
  ["fill", "Fill", "3", "fill"],
  ["line", "Line", "4", "line"],
  ["text", "Text", "5", "text"],
  ["stamp", "Picture stamp", "6", "stamp"],
  ["clone", "Clone", "7", "clone"],
  ["heal", "Heal", "8", "heal"],
  ["pick", "Eyedropper, as seen", "9", "pick"],
  ["select", "Select an area to paint in", "0", "select"],
];

export function chooseTool(next: Tool): void {
  if (tool.value !== next) void discardPlacement();
  tool.value = next;
}

export function Toolbar() {
  return (
    <nav class="toolbar" aria-label="Tools">
      {TOOLS.map(([key, label, keys, icon]) => (
        <Button
          key={key}
          icon={icon}
          label={label}
          keys={keys}
          pressed={tool.value === key}
          disabled={readOnly.value && !["orbit", "pick", "select"].includes(key)}
          onClick={() => chooseTool(key)}
        />
      ))}
      <label class="swatch" title="Colour">
        <input
          type="color"
          aria-label="Colour"
          value={color.value}
          onInput={(event) => (color.value = event.currentTarget.value)}
          onChange={(event) => setColor(event.currentTarget.value)}
        />
      </label>
    </nav>
  );
}
