/** Colours of painted pixels: how a brush colour meets what was there. Display sRGB, 0..255 per channel. */

import type { PaintMode } from "../state/store";

export type Rgb = [number, number, number];

/** Luma of W3C "Compositing and Blending Level 1", section 10, as image editors use it for non-separable modes. */
export const luma = (r: number, g: number, b: number): number => 0.3 * r + 0.59 * g + 0.11 * b;

/** `color` with the luma of `base`, brought back into 0..255 without changing that luma. */
export function withLuma(color: Rgb, base: Rgb): Rgb {
  const target = luma(...base);
  const by = target - luma(...color);
  const moved = color.map((c) => c + by);
  const low = Math.min(...moved);
  const high = Math.max(...moved);
  return moved.map((c) => {
    if (low < 0) return target + ((c - target) * target) / (target - low);
    if (high > 255) return target + ((c - target) * (255 - target)) / (high - target);
    return c;
  }) as Rgb;
}

/** What the pixel shall be where the stroke covers it fully. */
export function blend(mode: PaintMode, color: Rgb, base: Rgb): Rgb {
  if (mode === "color") return withLuma(color, base);
  if (mode === "darken") return [Math.min(color[0], base[0]), Math.min(color[1], base[1]), Math.min(color[2], base[2])];
  if (mode === "lighten")
    return [Math.max(color[0], base[0]), Math.max(color[1], base[1]), Math.max(color[2], base[2])];
  return color;
}

/** Largest difference of the channels, 0..1: how far two pixels are apart for fill and select by colour. */
export function distance(pixels: Uint8ClampedArray, a: number, b: number): number {
  return (
    Math.max(
      Math.abs(pixels[a] - pixels[b]),
      Math.abs(pixels[a + 1] - pixels[b + 1]),
      Math.abs(pixels[a + 2] - pixels[b + 2]),
    ) / 255
  );
}
