/** Turning the view: the pen is left to the camera. */

import type { ToolSpec } from "./tool";

export const orbit: ToolSpec = {
  name: "orbit",
  icon: "orbit",
  commands: [{ id: "tool.orbit", label: "Turn the view", keys: ["H", "V"] }],
  cursor: () => "hand",
  Settings: () => (
    <span class="hint">
      Drag to turn about the point under the cursor, Shift-drag to slide, wheel to zoom, double click to look at a point
    </span>
  ),
  gesture: null,
  onlyLooks: true,
};
