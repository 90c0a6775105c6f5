/** Masks as pictures, for sending and for showing. */

import type { Mask } from "./raster";

/** White where the mask is 1. */
export function maskPng(mask: Mask): Promise<Blob> {
  const canvas = new OffscreenCanvas(mask.width, mask.height);
  const image = new ImageData(mask.width, mask.height);
  for (let k = 0; k < mask.data.length; k++) {
    image.data.fill(mask.data[k] * 255, k * 4, k * 4 + 3);
    image.data[k * 4 + 3] = 255;
  }
  canvas.getContext("2d")!.putImageData(image, 0, 0);
  return canvas.convertToBlob({ type: "image/png" });
}
