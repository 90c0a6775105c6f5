/**
 * Layers that are placed once more: a text or a picture as it was, and by free transform what was painted on one view, to be
 * moved, scaled and turned.
 */

import { blobUrl, pixelsOf } from "../net/blobs";
import type { LayerInfo } from "../messages";
import { go } from "../editor/camera-moves";
import { run } from "../editor/editor";
import { brush, camera, color, paintMode, readOnly, selectedLayer, state, text, toast } from "../state/store";
import { fromCamera, sameViewpoint, type CameraJson, type Vec3 } from "../view/camera";
import { discardPlacement } from "../paint/lay-placement";
import { editedLayer, heldGesture, placement, type Placement } from "../paint/placement";
import { textImage } from "../paint/text-image";
import { wrapping } from "../paint/view-surface";
import { stamp } from "./stamp";
import { textTool } from "./text";
import { tool } from "./tool";

/** Lay the chosen layer's paint on its view with handles; Enter makes it a sticker in place of the old paint. */
export async function transformLayer(): Promise<void> {
  const now = state.value;
  const layer = now?.layers.find((one) => one.id === selectedLayer.value);
  if (!now || readOnly.value || placement.value) return;
  if (!layer) return toast("info", "Choose a layer to transform.");
  if (layer.placed) return changePlaced(layer);
  const reason = whyNot(layer);
  if (reason) return toast("info", `${layer.name} cannot be transformed: ${reason}.`);
  const last = layer.views[layer.views.length - 1];
  const { width, height } = last.camera;
  go(fromCamera(last.camera as CameraJson, now.asset.center as Vec3));
  const picture = await pixelsOf(blobUrl(last.picture!), width, height);
  const cover = new Uint8ClampedArray(width * height);
  for (const { mask } of layer.views) {
    const { data } = await pixelsOf(blobUrl(mask!), width, height);
    for (let k = 0; k < cover.length; k++) cover[k] = Math.max(cover[k], data[k * 4]);
  }
  const box = boundsOf(cover, width, height);
  if (!box) return;
  const image = document.createElement("canvas");
  [image.width, image.height] = [box.width, box.height];
  const pixels = new ImageData(box.width, box.height);
  for (let y = 0; y < box.height; y++)
    for (let x = 0; x < box.width; x++) {
      const from = (box.y + y) * width + box.x + x;
      const to = (y * box.width + x) * 4;
      for (let c = 0; c < 3; c++) pixels.data[to + c] = picture.data[from * 4 + c];
      pixels.data[to + 3] = cover[from];
    }
  image.getContext("2d")!.putImageData(pixels, 0, 0);
  const view = camera.value!;
  const scale = view.height / height;
  const gesture = heldGesture(layer.id);
  tool.value = stamp.name;
  if (layer.visible) await run("layer.set", { layer: layer.id, visible: false, gesture }, layer.name);
  editedLayer.value = {
    layer: layer.id,
    project: now.project.id,
    name: layer.name,
    gesture,
    strokes: (layer.strokes ?? 0) > 0,
  };
  placement.value = {
    kind: "picture",
    image,
    name: layer.name,
    x: view.width / 2 + (box.x + box.width / 2 - width / 2) * scale,
    y: view.height / 2 + (box.y + box.height / 2 - height / 2) * scale,
    scale,
    angle: 0,
    flat: true,
  };
}

/** Lay the text or the sticker of a layer on its view again, to be changed. */
export async function changePlaced(layer: LayerInfo): Promise<void> {
  const placed = layer.placed;
  const [view] = layer.views;
  if (!placed || !view) return;
  if (placement.value) await discardPlacement();
  const seen = (placed.view ?? view.camera) as CameraJson;
  go(fromCamera(seen, state.value!.asset.center as Vec3));
  wrapping.value = { on: typeof placed.unit === "number", limit: placed.wrap ?? 180 };
  brush.value = { ...brush.value, opacity: placed.opacity };
  paintMode.value = placed.mode;
  const spec = placed.kind === "text" ? textTool : stamp;
  let image: Placement["image"];
  if (placed.kind === "text") {
    const { text: written, font, size, bold, italic } = placed;
    text.value = { text: written, font, size, bold, italic };
    color.value = placed.color;
    image = textImage();
  } else {
    const pixels = await fetch(blobUrl(placed.image!));
    image = await createImageBitmap(await pixels.blob());
  }
  tool.value = spec.name;
  selectedLayer.value = layer.id;
  const gesture = heldGesture(layer.id);
  editedLayer.value = { layer: layer.id, project: state.value!.project.id, name: layer.name, gesture };
  const [x, y] = [placed.x, placed.y].map((v, k) => {
    const [at, now] = [seen, camera.value!];
    return k === 0 ? now.cx + ((v - at.cx) * now.fx) / at.fx : now.cy + ((v - at.cy) * now.fy) / at.fy;
  });
  const scale = (placed.scale * camera.value!.fx) / seen.fx;
  const unit = placed.unit ?? undefined;
  const kind = placed.kind === "text" ? "text" : "picture";
  placement.value = { kind, image, name: layer.name, x, y, scale, angle: placed.angle, unit };
  await run("layer.set", { layer: layer.id, visible: false, gesture }, layer.name);
}

function whyNot(layer: LayerInfo): string {
  if (!["paint", "picture", "clone"].includes(layer.kind) || layer.mode !== "local") return "it is not painted";
  const [first, ...more] = layer.views;
  if (!first) return "nothing is painted in it";
  if ((layer.strokes ?? 0) > 1) return "it holds several strokes";
  const elsewhere = more.some(({ camera }) => !sameViewpoint(camera as CameraJson, first.camera as CameraJson));
  if (elsewhere) return "it was painted from several views";
  return layer.views.every(({ picture, mask }) => picture && mask) ? "" : "it has no mask";
}

/** Rectangle of the pixels that are set. */
function boundsOf(data: Uint8ClampedArray, width: number, height: number) {
  let [left, top, right, bottom] = [width, height, -1, -1];
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++)
      if (data[y * width + x] > 0) {
        [left, right] = [Math.min(left, x), Math.max(right, x)];
        [top, bottom] = [Math.min(top, y), Math.max(bottom, y)];
      }
  return right < 0 ? null : { x: left, y: top, width: right - left + 1, height: bottom - top + 1 };
}
