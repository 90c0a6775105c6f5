/** The colour as seen: the view's pixel under the pen. */

import { editor, report } from "../editor/editor";
import { hex, setColor } from "../state/store";
import { nothing, type Pen, type ToolSpec } from "./tool";

/** Take the colour under the pen. */
export function pickColor(pen: Pen): void {
  void pick(pen).catch(report);
}

async function pick(pen: Pen): Promise<void> {
  const { data, width, height } = await editor.pixels.now();
  const [x, y] = [Math.floor(pen.x), Math.floor(pen.y)];
  if (x < 0 || y < 0 || x >= width || y >= height) return;
  const at = (y * width + x) * 4;
  setColor(hex([data[at] / 255, data[at + 1] / 255, data[at + 2] / 255]));
}

export const eyedropper: ToolSpec = {
  name: "pick",
  icon: "pick",
  commands: [{ id: "tool.pick", label: "Eyedropper, as seen", keys: ["I"] }],
  cursor: () => "cross",
  Settings: () => <span class="hint">Click: pick the colour as it is seen</span>,
  gesture: { down: pickColor, move: pickColor, up: nothing, cancel: nothing },
  onlyLooks: true,
};
