/** A rectangle of a stroke as pixels: colours and straight alpha, and the same laid over the view. Pure. */

import type { PaintMode } from "../state/store";
import { blend, type Rgb } from "./colors";
import type { Pixels } from "./flood";
import type { Mask, Rect } from "./raster";

/** Colour of the stroke at pixel (x, y), 0..255, into out. */
export type Source = (x: number, y: number, out: Rgb) => void;

/** One colour; what it does to the picture below depends on the mode. Without the picture it is painted as it is. */
export function solid(color: Rgb, mode: PaintMode, base: () => Pixels | null): Source {
  return (x, y, out) => {
    const pixels = mode === "normal" ? null : base();
    let result = color;
    if (pixels) {
      const at = (y * pixels.width + x) * 4;
      result = blend(mode, color, [pixels.data[at], pixels.data[at + 1], pixels.data[at + 2]]);
    }
    [out[0], out[1], out[2]] = result;
  };
}

/** The view itself, moved by (dx, dy) pixels; beyond its border the border. Grey while the view is not there yet. */
export function shifted(dx: number, dy: number, base: () => Pixels | null): Source {
  return (x, y, out) => {
    const pixels = base();
    if (!pixels) return void out.fill(128);
    const at = (limit(y - dy, pixels.height) * pixels.width + limit(x - dx, pixels.width)) * 4;
    [out[0], out[1], out[2]] = [pixels.data[at], pixels.data[at + 1], pixels.data[at + 2]];
  };
}

/** A picture of the view's size (a stamp, text, the original). */
export function picture(pixels: () => Pixels | null): Source {
  return shifted(0, 0, pixels);
}

export const limit = (value: number, size: number): number => Math.max(0, Math.min(size - 1, Math.round(value)));

/** How much of a stroke's paint a texture lets through at a pixel, 0..1. */
export type Grain = (x: number, y: number) => number;

/** Alpha of a pixel: cover times opacity, inside the selection. */
const alphaAt = (mask: Mask, selection: Mask | null, opacity: number, at: number): number =>
  mask.data[at] * opacity * (selection ? selection.data[at] : 1);

/** RGBA of the rectangle, straight alpha: what the server is sent. */
export function compose(
  rect: Rect,
  mask: Mask,
  selection: Mask | null,
  opacity: number,
  source: Source,
  grain: Grain | null = null,
): Uint8ClampedArray<ArrayBuffer> {
  const out = new Uint8ClampedArray(rect.width * rect.height * 4);
  const rgb: Rgb = [0, 0, 0];
  let to = 0;
  for (let y = rect.y; y < rect.y + rect.height; y++) {
    for (let x = rect.x; x < rect.x + rect.width; x++, to += 4) {
      let alpha = alphaAt(mask, selection, opacity, y * mask.width + x);
      if (alpha > 0 && grain) alpha *= grain(x, y);
      if (alpha <= 0) continue;
      source(x, y, rgb);
      [out[to], out[to + 1], out[to + 2]] = rgb;
      out[to + 3] = Math.max(1, alpha * 255);
    }
  }
  return out;
}

/** The same over `base`, opaque where anything is painted: hides what a preview does below. */
export function over(rect: Rect, patch: Uint8ClampedArray, base: Pixels): Uint8ClampedArray<ArrayBuffer> {
  const out = new Uint8ClampedArray(patch);
  for (let k = 0, y = rect.y; y < rect.y + rect.height; y++) {
    for (let x = rect.x; x < rect.x + rect.width; x++, k += 4) {
      const alpha = out[k + 3] / 255;
      if (alpha === 0) continue;
      const at = (y * base.width + x) * 4;
      for (let c = 0; c < 3; c++) out[k + c] = out[k + c] * alpha + base.data[at + c] * (1 - alpha);
      out[k + 3] = 255;
    }
  }
  return out;
}

/** Base64 of bytes. */
export function base64(bytes: Uint8ClampedArray): string {
  let text = "";
  for (let k = 0; k < bytes.length; k += 0x8000) text += String.fromCharCode(...bytes.subarray(k, k + 0x8000));
  return btoa(text);
}
