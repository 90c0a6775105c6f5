/**
 * Healing: the source's detail on the target's colours. The difference target - source is known around the painted
 * region and interpolated inside as smoothly as possible (Laplace's equation; Perez et al., "Poisson Image Editing",
 * SIGGRAPH 2003; Georgiev 2005 for this form), then added to the source. Pure.
 */

import type { Pixels } from "./flood";
import { clip, type Mask, type Rect } from "./raster";

const SWEEPS = 200;
/** Of successive over-relaxation; near the best for regions of some hundred pixels. */
const OVER = 1.9;

/**
 * Colours for `rect` (grown by one pixel, returned with it): `target` where the mask is 0, healed source where it is not.
 * `source(x, y)`: index of the source pixel in target's data.
 */
export function heal(
  target: Pixels,
  mask: Mask,
  rect: Rect,
  source: (x: number, y: number) => number,
): { rect: Rect; data: Uint8ClampedArray<ArrayBuffer> } {
  const area = clip({ x: rect.x - 1, y: rect.y - 1, width: rect.width + 2, height: rect.height + 2 }, target);
  const { width: w, height: h } = area;
  const inside = new Uint8Array(w * h);
  const at = (x: number, y: number) => ((area.y + y) * target.width + area.x + x) * 4;
  for (let y = 0; y < h; y++) for (let x = 0; x < w; x++) inside[y * w + x] = mask.data[at(x, y) >> 2] > 0 ? 1 : 0;
  const out = new Uint8ClampedArray(w * h * 4).fill(255);
  for (let c = 0; c < 3; c++) {
    const base = new Float32Array(w * h);
    const gap = new Float32Array(w * h);
    for (let y = 0; y < h; y++) {
      for (let x = 0; x < w; x++) {
        base[y * w + x] = target.data[source(area.x + x, area.y + y) + c];
        gap[y * w + x] = inside[y * w + x] ? 0 : target.data[at(x, y) + c] - base[y * w + x];
      }
    }
    membrane(gap, inside, w, h);
    for (let k = 0; k < w * h; k++) out[k * 4 + c] = base[k] + gap[k];
  }
  return { rect: area, data: out };
}

/** Fill the inside of `values` so that every pixel is the mean of its neighbours (those that exist). In place. */
export function membrane(values: Float32Array, inside: Uint8Array, width: number, height: number): void {
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    for (let color = 0; color < 2; color++) {
      for (let y = 0; y < height; y++) {
        for (let x = (y + color) & 1; x < width; x += 2) {
          const k = y * width + x;
          if (!inside[k]) continue;
          let sum = 0;
          let count = 0;
          if (x > 0) ((sum += values[k - 1]), count++);
          if (x < width - 1) ((sum += values[k + 1]), count++);
          if (y > 0) ((sum += values[k - width]), count++);
          if (y < height - 1) ((sum += values[k + width]), count++);
          values[k] += OVER * (sum / count - values[k]);
        }
      }
    }
  }
}
