/** Coverage of a stroke: round tips, dabs along a path, accumulation. Pure; a mask is one float 0..1 per pixel. */

export interface Rect {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface Mask {
  width: number;
  height: number;
  data: Float32Array;
}

export interface Tip {
  /** Radius in pixels, > 0. */
  radius: number;
  /** 0: fades from the middle; 1: a hard edge, one pixel soft. */
  hardness: number;
  /** Part of the remaining way to full cover that one dab goes, 0..1. */
  flow: number;
}

export interface Point {
  x: number;
  y: number;
  /** 0..1; a mouse has 0.5. */
  pressure: number;
}

export const emptyMask = (width: number, height: number): Mask => ({
  width,
  height,
  data: new Float32Array(width * height),
});
export const NOTHING: Rect = { x: 0, y: 0, width: 0, height: 0 };

/** Cover of a tip at `distance` pixels from its middle. */
export function falloff(distance: number, { radius, hardness }: Tip): number {
  const solid = radius * hardness;
  const edge = Math.max(radius - solid, 1); // never sharper than a pixel
  const t = (distance - (radius - edge)) / edge;
  if (t <= 0) return 1;
  if (t >= 1) return 0;
  return 1 - t * t * (3 - 2 * t);
}

/** Add one dab to the mask: c += (1 - c) * flow * falloff. Pixel centres lie at +0.5. Returns the pixels that it reached. */
export function dab(mask: Mask, x: number, y: number, tip: Tip): Rect {
  const reach = Math.max(tip.radius, 1);
  const rect = clip(
    {
      x: Math.floor(x - reach),
      y: Math.floor(y - reach),
      width: Math.ceil(2 * reach) + 2,
      height: Math.ceil(2 * reach) + 2,
    },
    mask,
  );
  for (let j = rect.y; j < rect.y + rect.height; j++) {
    for (let i = rect.x; i < rect.x + rect.width; i++) {
      const cover = tip.flow * falloff(Math.hypot(i + 0.5 - x, j + 0.5 - y), tip);
      if (cover > 0) {
        const at = j * mask.width + i;
        mask.data[at] += (1 - mask.data[at]) * cover;
      }
    }
  }
  return rect;
}

/** Share of the radius between two dabs. */
const SPACING = 0.2;

/**
 * Dabs from `from` (excluded) to `to`, evenly spaced, the pressure interpolated. `left`: how far the path had gone since
 * the last dab. Returns the pixels reached and the new `left`.
 */
export function segment(
  mask: Mask,
  from: Point,
  to: Point,
  tip: (pressure: number) => Tip,
  left: number,
): { rect: Rect; left: number } {
  const length = Math.hypot(to.x - from.x, to.y - from.y);
  let rect = NOTHING;
  let at = -left;
  for (;;) {
    const here = Math.max(0, Math.min(1, length > 0 ? at / length : 0));
    const pressure = from.pressure + (to.pressure - from.pressure) * here;
    const step = Math.max(0.5, tip(pressure).radius * SPACING);
    if (at + step > length) return { rect, left: length - at };
    at += step;
    const t = at / length;
    const p = from.pressure + (to.pressure - from.pressure) * t;
    rect = union(rect, dab(mask, from.x + (to.x - from.x) * t, from.y + (to.y - from.y) * t, tip(p)));
  }
}

export function union(a: Rect, b: Rect): Rect {
  if (a.width <= 0 || a.height <= 0) return b;
  if (b.width <= 0 || b.height <= 0) return a;
  const x = Math.min(a.x, b.x);
  const y = Math.min(a.y, b.y);
  return {
    x,
    y,
    width: Math.max(a.x + a.width, b.x + b.width) - x,
    height: Math.max(a.y + a.height, b.y + b.height) - y,
  };
}

export function clip(rect: Rect, size: { width: number; height: number }): Rect {
  const x = Math.max(0, rect.x);
  const y = Math.max(0, rect.y);
  const width = Math.min(size.width, rect.x + rect.width) - x;
  const height = Math.min(size.height, rect.y + rect.height) - y;
  return width > 0 && height > 0 ? { x, y, width, height } : NOTHING;
}
