/**
 * Healing: tone from the border of the painted region, texture from the source. Tone is continued from the border into
 * the region as smoothly as possible (Laplace's equation, as in Perez et al., "Poisson Image Editing", SIGGRAPH 2003);
 * texture is the source without what is left of it when it is blurred, and weaker where the target is darker than the
 * source: as it is, it would go below black there, and leave blotches. Blurred and not continued from the source's border:
 * folds and shadows of the source are no texture. Pure.
 */

import type { Pixels } from "./flood";
import { clip, type Mask, type Rect } from "./raster";

/** Pixels around the region that are looked at, and half the width over which its border is averaged: grain stays out. */
const RING = 2;
/** Added to tones of 0..255 before they are divided: what is nearly black has little texture. */
const FLOOR = 10;
/** What is wider than this share of the region's shorter side is tone, within these pixels. */
const TEXTURE_SHARE = 0.2;
const MIN_TEXTURE_PX = 3;
const MAX_TEXTURE_PX = 24;
/** Texture is at most so much brighter and darker than its tone, as a share of that. */
const MAX_BRIGHTER = 0.8;
const MAX_DARKER = 0.5;
/** And its channels differ from its brightness by at most this share of that: grain in one channel makes no colours. */
const TINT_SHARE = 0.25;
/** Of each level of the pyramid; the coarsest ones make the rest of the way. */
const SWEEPS = 60;
/** Of successive over-relaxation. */
const OVER = 1.8;
/** Width or height of a region that is not halved again. */
const COARSEST = 6;

/**
 * Colours for `rect` (grown, returned with it): `target` where the mask is 0, healed source where it is not.
 * `source(x, y)`: index of the source pixel in target's data, negative: none, so no texture. `isEmpty(at)`: whether the pixel at that index shows nothing
 * of the asset: it has neither tone nor texture.
 */
export function heal(
  target: Pixels,
  mask: Mask,
  rect: Rect,
  source: (x: number, y: number) => number,
  isEmpty: (at: number) => boolean = () => false,
): { rect: Rect; data: Uint8ClampedArray<ArrayBuffer> } {
  const grown = { x: rect.x - RING, y: rect.y - RING, width: rect.width + 2 * RING, height: rect.height + 2 * RING };
  const area = clip(grown, target);
  const { width: w, height: h } = area;
  const size = w * h;
  const from = new Int32Array(size);
  const to = new Int32Array(size);
  const inside = new Uint8Array(size);
  for (let k = 0; k < size; k++) {
    const [x, y] = [area.x + (k % w), area.y + Math.floor(k / w)];
    to[k] = (y * target.width + x) * 4;
    from[k] = source(x, y);
    inside[k] = mask.data[to[k] >> 2] > 0 ? 1 : 0;
  }
  const tones = [0, 1, 2].map((c) => tone(target, to, c, inside, isEmpty, w, h));
  const reach = Math.round(
    Math.max(MIN_TEXTURE_PX, Math.min(MAX_TEXTURE_PX, TEXTURE_SHARE * Math.min(rect.width, rect.height))),
  );
  const covered = Float32Array.from(from, (at) => (at < 0 || isEmpty(at) ? 0 : 1));
  const weights = blurred(covered, w, h, reach);
  const bases = [0, 1, 2].map((c) => {
    const sums = blurred(
      Float32Array.from(from, (at, k) => (covered[k] ? target.data[at + c] : 0)),
      w,
      h,
      reach,
    );
    return sums.map((sum, k) => sum / Math.max(weights[k], 1e-6));
  });
  const out = new Uint8ClampedArray(size * 4).fill(255);
  for (let k = 0; k < size; k++) {
    const textured = covered[k] > 0;
    const detail = textured ? luminance((c) => target.data[from[k] + c] - bases[c][k]) : 0;
    const base = luminance((c) => bases[c][k]);
    for (let c = 0; c < 3; c++) {
      const tone = tones[c];
      if (!inside[k] || (tone === null && !textured)) out[k * 4 + c] = target.data[to[k] + c];
      else if (tone === null) out[k * 4 + c] = target.data[from[k] + c];
      else {
        const here = luminance((channel) => tones[channel]![k]);
        const gain = Math.min(1, (here + FLOOR) / (base + FLOOR));
        const tint = textured ? target.data[from[k] + c] - bases[c][k] - detail : 0;
        const shade = limited(gain * detail, here * MAX_DARKER, (here + FLOOR) * MAX_BRIGHTER);
        out[k * 4 + c] = tone[k] + shade + limited(gain * tint, here * TINT_SHARE, here * TINT_SHARE);
      }
    }
  }
  return { rect: area, data: out };
}

const luminance = (channel: (c: number) => number): number =>
  0.2126 * channel(0) + 0.7152 * channel(1) + 0.0722 * channel(2);
const limited = (value: number, below: number, above: number): number => Math.max(-below, Math.min(above, value));

/** A blur of about a Gaussian with standard deviation `reach`: three box filters one after the other. */
function blurred(values: Float32Array, w: number, h: number, reach: number): Float32Array {
  let out = values;
  for (let pass = 0; pass < 3; pass++) out = boxed(boxed(out, w, h, 1, w, reach), h, w, w, 1, reach);
  return out;
}

/** Means over 2 reach + 1 pixels along lines of `length` pixels with stride `along`; `lines` of them, `across` apart. */
function boxed(
  values: Float32Array,
  length: number,
  lines: number,
  along: number,
  across: number,
  reach: number,
): Float32Array {
  const out = new Float32Array(values.length);
  for (let line = 0; line < lines; line++) {
    const start = line * across;
    let sum = 0;
    for (let k = 0; k < Math.min(reach, length); k++) sum += values[start + k * along];
    for (let k = 0; k < length; k++) {
      if (k + reach < length) sum += values[start + (k + reach) * along];
      if (k - reach - 1 >= 0) sum -= values[start + (k - reach - 1) * along];
      const count = Math.min(length - 1, k + reach) - Math.max(0, k - reach) + 1;
      out[start + k * along] = sum / count;
    }
  }
  return out;
}

/**
 * One channel of the picture `at` pixels, continued smoothly into `inside` from its averaged border; null where the border
 * shows nothing.
 */
function tone(
  picture: Pixels,
  at: Int32Array,
  c: number,
  inside: Uint8Array,
  isEmpty: (at: number) => boolean,
  w: number,
  h: number,
): Float32Array | null {
  const values = new Float32Array(w * h);
  const free = new Uint8Array(w * h);
  let [sum, count] = [0, 0];
  for (let y = 0; y < h; y++)
    for (let x = 0; x < w; x++) {
      const k = y * w + x;
      const mean = inside[k] ? null : around(picture, at, c, inside, isEmpty, x, y, w, h);
      free[k] = mean === null ? 1 : 0;
      values[k] = mean ?? 0;
      if (mean !== null) ((sum += mean), count++);
    }
  if (count === 0) return null;
  for (let k = 0; k < w * h; k++) if (free[k]) values[k] = sum / count;
  membrane(values, free, w, h);
  return values;
}

/** Mean of the pixels outside the region and of the asset near (x, y); null: there is none. */
function around(
  picture: Pixels,
  at: Int32Array,
  c: number,
  inside: Uint8Array,
  isEmpty: (at: number) => boolean,
  x: number,
  y: number,
  w: number,
  h: number,
): number | null {
  let [sum, count] = [0, 0];
  for (let v = Math.max(0, y - RING); v <= Math.min(h - 1, y + RING); v++)
    for (let u = Math.max(0, x - RING); u <= Math.min(w - 1, x + RING); u++) {
      const k = v * w + u;
      if (!inside[k] && !isEmpty(at[k])) ((sum += picture.data[at[k] + c]), count++);
    }
  return count ? sum / count : null;
}

/**
 * Fill the inside of `values` so that every pixel is the mean of its neighbours (those that exist). In place: coarse levels
 * first, so that wide regions get there too.
 */
export function membrane(values: Float32Array, inside: Uint8Array, width: number, height: number): void {
  if (Math.min(width, height) > COARSEST) {
    const [w, h] = [(width + 1) >> 1, (height + 1) >> 1];
    const coarse = new Float32Array(w * h);
    const within = new Uint8Array(w * h);
    for (let y = 0; y < h; y++)
      for (let x = 0; x < w; x++) {
        let [fixed, fixedCount, loose, looseCount] = [0, 0, 0, 0];
        for (let v = 2 * y; v < Math.min(2 * y + 2, height); v++)
          for (let u = 2 * x; u < Math.min(2 * x + 2, width); u++) {
            const k = v * width + u;
            if (inside[k]) ((loose += values[k]), looseCount++);
            else ((fixed += values[k]), fixedCount++);
          }
        within[y * w + x] = fixedCount ? 0 : 1;
        coarse[y * w + x] = fixedCount ? fixed / fixedCount : loose / looseCount;
      }
    membrane(coarse, within, w, h);
    for (let k = 0; k < values.length; k++)
      if (inside[k]) values[k] = coarse[(Math.floor(k / width) >> 1) * w + ((k % width) >> 1)];
  }
  relax(values, inside, width, height);
}

function relax(values: Float32Array, inside: Uint8Array, width: number, height: number): void {
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
