/** Pictures: chosen, pasted or dropped, and laid on the view or on the surface. */

import { report } from "../editor/editor";
import { placedSteps, placement } from "../paint/placement";
import { wrapping } from "../paint/view-surface";
import { camera } from "../state/store";
import { FileButton } from "../ui/parts";
import { OneSided } from "../ui/symmetry";
import { OnSurface, placing } from "./placing";
import { Limits, Methods, PaintModes } from "./settings";
import type { ToolSpec } from "./tool";

/** Of the view's width and height that a picture takes at first, at most. */
const FIRST_SIZE = 0.5;

/** Endings of pictures' files, which say nothing in the name of a layer. */
const ENDING = /\.(avif|bmp|gif|jpe?g|png|tiff?|webp)$/i;

/** Lay a picture on the middle of the view; false (with a toast) where it is none. `name`: of its file. */
export async function placePicture(file: Blob, name: string): Promise<boolean> {
  const view = camera.value;
  if (!view) return false;
  try {
    const image = await createImageBitmap(file);
    const scale = Math.min(1, (FIRST_SIZE * view.width) / image.width, (FIRST_SIZE * view.height) / image.height);
    const [x, y] = [view.width / 2, view.height / 2];
    placedSteps.forget(); // those of another one
    placement.value = { kind: "picture", image, name: name.replace(ENDING, "") || name, x, y, scale, angle: 0 };
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
