/** Where clone and heal read from: chosen with Alt and a click, or by the next click after a button. */

import { effect, signal } from "@preact/signals";

import { editor } from "../editor/editor";
import { shifted } from "../paint/patch";
import type { Stroke } from "../paint/stroke";
import { camera, toast } from "../state/store";
import { Button } from "../ui/parts";
import { rewindowed, type CameraJson } from "../view/camera";
import type { Pen, ToolGesture } from "./tool";

/** In view pixels, and the stroke's offset once it began; null: not chosen. */
export const copySource = signal<{ x: number; y: number; offset: [number, number] | null } | null>(null);
/** The next click chooses the source: for those without an Alt key. */
export const choosingSource = signal(false);

function followWindow(): void {
  let before: CameraJson | null = null;
  effect(() => {
    // on another view it is nowhere; where only the window changed it stays on its place of the picture
    const now = camera.value;
    const same = before && now && rewindowed(before, now);
    before = now;
    const from = copySource.peek();
    if (!from) return;
    if (!same) return void (copySource.value = null);
    const [x, y] = same.at(from.x, from.y);
    const offset: [number, number] | null = from.offset && [from.offset[0] * same.scale, from.offset[1] * same.scale];
    copySource.value = { x, y, offset };
  });
}
followWindow();

/** A stroke that copies from the source, moved by as much as the pen is away from it. */
export function copyingStroke(pen: Pen, name: string, oneSided = false): Stroke | null {
  const from = copySource.value;
  if (!from) {
    toast("info", "Choose where to copy from first.", "Hold Alt and click on the asset, or press Set the source.");
    return null;
  }
  const offset: [number, number] = from.offset ?? [pen.x - from.x, pen.y - from.y];
  copySource.value = { ...from, offset };
  const stroke = editor.strokes.begin("clone", name, { oneSided });
  stroke?.setSource(shifted(offset[0], offset[1], () => stroke.base));
  return stroke;
}

/** The gesture, but Alt and a click choose the source instead. */
export function choosingFirst(gesture: ToolGesture): ToolGesture {
  return {
    ...gesture,
    down(pen) {
      if (pen.alt || choosingSource.value) copySource.value = { x: pen.x, y: pen.y, offset: null };
      else gesture.down(pen);
      choosingSource.value = false;
    },
  };
}

export function SourceButton() {
  return (
    <Button
      label="The next click sets where to copy from"
      keys="Alt-click"
      icon="pick"
      text={copySource.value ? "Another source" : "Set the source"}
      pressed={choosingSource.value}
      onClick={() => (choosingSource.value = !choosingSource.value)}
    />
  );
}
