/** Free transform: what a layer painted on one view is lifted off again, to be moved, scaled and turned, and painted anew. */

import { blobUrl, pixelsOf } from "../net/blobs";
import type { LayerInfo } from "../messages";
import { camera, readOnly, selectedLayer, state, toast, tool } from "../state/store";
import { go, run } from "../state/studio";
import { fromCamera, sameViewpoint, type CameraJson, type Vec3 } from "../view/camera";
import { changePlaced, editedLayer, placement } from "./placement";

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
  const gesture = `transform ${layer.id} ${Date.now()}`;
  tool.value = "stamp";
  if (layer.visible) await run("layer.set", { layer: layer.id, visible: false, gesture }, layer.name);
  editedLayer.value = { layer: layer.id, name: layer.name, gesture, strokes: (layer.strokes ?? 0) > 0 };
  placement.value = {
    kind: "stamp",
    image,
    name: layer.name,
    x: view.width / 2 + (box.x + box.width / 2 - width / 2) * scale,
    y: view.height / 2 + (box.y + box.height / 2 - height / 2) * scale,
    scale,
    angle: 0,
    flat: true,
  };
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
