/** The clone stamp with relief: a click copies Gaussians from the source to the surface under the pen, as a layer. */

import { signal } from "@preact/signals";

import { camera, readOnly, selectedLayer, toast } from "../state/store";
import { run } from "../editor/editor";
import type { CameraJson } from "../view/camera";
import { cursorFrame } from "../paint/brush";
import { meanRadius } from "../paint/dabs";
import type { Pen, ToolGesture } from "./tool";

/** Whether the clone tool copies geometry, not colours alone. */
export const relief = signal(false);
/** Where from: a pixel of a view, which stays when the camera moves; null: not chosen yet. */
const reliefFrom = signal<{ view: CameraJson; x: number; y: number } | null>(null);

/** Remember what Alt and a click, or the next click, choose as the source. */
export function chooseRelief(pen: Pen): void {
  if (camera.value) reliefFrom.value = { view: camera.value, x: pen.x, y: pen.y };
}

async function stamp(pen: Pen): Promise<void> {
  const [from, now] = [reliefFrom.value, camera.value];
  if (!now || readOnly.value) return;
  if (!from) return toast("info", "Choose where to copy from first.", "Hold Alt and click on the asset.");
  const fields = { source_camera: from.view, source_x: from.x, source_y: from.y, camera: now, x: pen.x, y: pen.y };
  const radius = Math.max(meanRadius(cursorFrame(pen.x, pen.y)), 1);
  const answer = await run("clone.relief", { ...fields, radius }, "Clone with relief");
  if (answer) selectedLayer.value = answer.layer.id;
}

/** The clone tool: as it was, or with relief. */
export function withRelief(gesture: ToolGesture, choosing: () => boolean): ToolGesture {
  let stamping = false;
  return {
    inAnotherView: gesture.inAnotherView,
    down(pen) {
      const chooses = pen.alt || choosing();
      if (chooses) chooseRelief(pen);
      stamping = relief.value && !chooses;
      if (stamping) void stamp(pen);
      else gesture.down(pen);
    },
    move: (pen) => stamping || gesture.move(pen),
    up: (pen) => (stamping ? void (stamping = false) : gesture.up(pen)),
    cancel: () => (stamping ? void (stamping = false) : gesture.cancel()),
  };
}
