/** Regions of like colour: flood fill and select by colour. Pure. */

import { distance } from "./colors";
import { emptyMask, type Mask } from "./raster";

export interface Pixels {
  width: number;
  height: number;
  /** RGBA, 8 bit. */
  data: Uint8ClampedArray;
}

/** Mask of the pixels whose colour is within `tolerance` (0..1, largest channel) of the one at (x, y); 1 inside. */
export function likeColor(pixels: Pixels, x: number, y: number, tolerance: number, contiguous: boolean): Mask {
  const { width, height, data } = pixels;
  const mask = emptyMask(width, height);
  if (x < 0 || y < 0 || x >= width || y >= height) return mask;
  const seed = (y * width + x) * 4;
  const like = (at: number) => distance(data, seed, at * 4) <= tolerance;
  if (!contiguous) {
    for (let at = 0; at < width * height; at++) if (like(at)) mask.data[at] = 1;
    return mask;
  }
  const stack = [y * width + x];
  while (stack.length) {
    // scanline fill: extend to both sides, then look for new starts above and below
    const start = stack.pop()!;
    if (mask.data[start]) continue;
    const row = Math.floor(start / width) * width;
    let left = start;
    let right = start;
    while (left > row && !mask.data[left - 1] && like(left - 1)) left--;
    while (right < row + width - 1 && !mask.data[right + 1] && like(right + 1)) right++;
    mask.data.fill(1, left, right + 1);
    for (const next of [row - width, row + width]) {
      if (next < 0 || next >= width * height) continue;
      let open = false;
      for (let at = left; at <= right; at++) {
        const other = next + at - row;
        const fits = !mask.data[other] && like(other);
        if (fits && !open) stack.push(other);
        open = fits;
      }
    }
  }
  return mask;
}

/** The mask blurred by two box passes of `radius` pixels (a soft edge); radius 0 returns it unchanged. */
export function soften(mask: Mask, radius: number): Mask {
  let out = mask;
  for (let pass = 0; pass < 2 && radius > 0; pass++) out = boxRows(transpose(boxRows(transpose(out), radius)), radius);
  return out;
}

function boxRows({ width, height, data }: Mask, radius: number): Mask {
  const out = emptyMask(width, height);
  for (let y = 0; y < height; y++) {
    const row = y * width;
    const at = (x: number) => data[row + Math.max(0, Math.min(width - 1, x))];
    let sum = 0;
    for (let x = -radius; x <= radius; x++) sum += at(x);
    for (let x = 0; x < width; x++) {
      out.data[row + x] = sum / (2 * radius + 1);
      sum += at(x + radius + 1) - at(x - radius);
    }
  }
  return out;
}

function transpose({ width, height, data }: Mask): Mask {
  const out = emptyMask(height, width);
  for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) out.data[x * height + y] = data[y * width + x];
  return out;
}
