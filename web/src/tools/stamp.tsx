/** Pictures: chosen, pasted or dropped, and laid on the view or on the surface. */

import { report } from "../editor/editor";
import { placement } from "../paint/placement";
import { wrapping } from "../paint/view-surface";
import { camera } from "../state/store";
import { FileButton } from "../ui/parts";
import { OneSided } from "../ui/symmetry";
import { OnSurface, placing } from "./placing";
import { Limits, Methods, PaintModes } from "./settings";
import type { ToolSpec } from "./tool";

/** Of the view's width and height that a picture takes at first, at most. */
const FIRST_SIZE = 0.5;

/** Lay a picture on the middle of the view; false (with a toast) where it is none. */
export async function placePicture(file: Blob, name: string): Promise<boolean> {
  const view = camera.value;
  if (!view) return false;
  try {
    const image = await createImageBitmap(file);
    const scale = Math.min(1, (FIRST_SIZE * view.width) / image.width, (FIRST_SIZE * view.height) / image.height);
    placement.value = { kind: "picture", image, name, x: view.width / 2, y: view.height / 2, scale, angle: 0 };
    return true;
  } catch {
    report(new Error(`${name} is not a picture that this browser reads.`));
    return false;
  }
}

function Settings() {
  return (
    <>
      <FileButton
        label="Choose a picture"
        icon="open"
        accept="image/png,image/jpeg,image/webp,image/avif"
        onFiles={([file]) => file && void placePicture(file, file.name)}
      />
      <OnSurface />
      {!placement.value && <span class="hint">or paste one</span>}
      <OneSided why="pictures are placed on this side only" />
      {!placement.value?.anchor && <PaintModes />}
      <Methods />
      <Limits />
    </>
  );
}

export const stamp: ToolSpec = {
  name: "stamp",
  icon: "stamp",
  commands: [{ id: "tool.stamp", label: "Picture stamp", keys: ["P"] }],
  cursor: () => "none",
  Settings,
  gesture: placing(),
  limited: true,
  takesPictures: true,
  needsSurface: () => wrapping.value.on,
};
