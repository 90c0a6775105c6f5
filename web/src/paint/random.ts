/** Numbers that look random and are the same every time: of a seed, a position in a sequence and a purpose. Pure. */

/** 0..1 (1 excluded). An integer hash after "Hash Functions for GPU Rendering" (Jarzynski, Olano 2020), pcg3d. */
export function random(seed: number, index: number, channel = 0): number {
  let x = (Math.imul(seed | 0, 1664525) + 1013904223) | 0;
  let y = (Math.imul(index | 0, 1664525) + 1013904223) | 0;
  let z = (Math.imul(channel | 0, 1664525) + 1013904223) | 0;
  for (let round = 0; round < 2; round++) {
    x = (x + Math.imul(y, z)) | 0;
    y = (y + Math.imul(z, x)) | 0;
    z = (z + Math.imul(x, y)) | 0;
    if (round === 0) [x, y, z] = [x ^ (x >>> 16), y ^ (y >>> 16), z ^ (z >>> 16)];
  }
  return (x >>> 0) / 4294967296;
}

/** -1..1. */
export const spread = (seed: number, index: number, channel = 0): number => 2 * random(seed, index, channel) - 1;
