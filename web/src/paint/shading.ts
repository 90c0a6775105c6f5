/** Paint that keeps the light, shade and fine relief of what it covers. Pure. */

import { luma, withLuma, type Rgb } from "./colors";
import type { Pixels } from "./flood";

/** Radius of the neighbourhood whose mean a pixel's shading is told from, as a share of the view's longer side. */
export const NEIGHBOURHOOD = 1 / 14;
/** Channels that are as near to the background's, of 255, belong to no asset. */
const BACKGROUND_DISTANCE = 2;

/** [W * H] mean luma (0..255) of the asset around each pixel. background: colour that does not count, 0..255. */
export function localMean({ data, width, height }: Pixels, background: Rgb, radius: number): Float32Array {
  const count = new Float64Array((width + 1) * (height + 1));
  const total = new Float64Array((width + 1) * (height + 1));
  for (let y = 0; y < height; y++) {
    let [n, sum] = [0, 0];
    for (let x = 0; x < width; x++) {
      const at = (y * width + x) * 4;
      const [r, g, b] = [data[at], data[at + 1], data[at + 2]];
      const apart = Math.max(Math.abs(r - background[0]), Math.abs(g - background[1]), Math.abs(b - background[2]));
      if (apart > BACKGROUND_DISTANCE) {
        n++;
        sum += luma(r, g, b);
      }
      const to = (y + 1) * (width + 1) + x + 1;
      count[to] = count[to - width - 1] + n;
      total[to] = total[to - width - 1] + sum;
    }
  }
  const out = new Float32Array(width * height);
  for (let y = 0; y < height; y++) {
    const [top, low] = [Math.max(0, y - radius) * (width + 1), Math.min(height, y + radius + 1) * (width + 1)];
    for (let x = 0; x < width; x++) {
      const [left, right] = [Math.max(0, x - radius), Math.min(width, x + radius + 1)];
      const n = count[low + right] - count[low + left] - count[top + right] + count[top + left];
      const sum = total[low + right] - total[low + left] - total[top + right] + total[top + left];
      const at = (y * width + x) * 4;
      out[y * width + x] = n > 0 ? sum / n : luma(data[at], data[at + 1], data[at + 2]);
    }
  }
  return out;
}

/**
 * `color` with the shading of `base`: as much lighter or darker as `base` is than its neighbourhood (`mean`, luma).
 * Colours darker than the neighbourhood take a part of it, so that black stays black. keep: 0..1, of that difference.
 */
export function shaded(color: Rgb, base: Rgb, mean: number, keep: number): Rgb {
  if (keep <= 0) return color;
  const lightness = luma(...color);
  const part = Math.min(1, lightness / Math.max(mean, 1));
  const target = Math.max(0, Math.min(255, lightness + keep * part * (luma(...base) - mean)));
  if (target < lightness) return color.map((c) => (c * target) / lightness) as Rgb; // in the shade its hue stays
  return withLuma(color, [target, target, target]);
}
