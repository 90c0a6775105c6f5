/** Masks on one view that choose what is selected. Pure. */

import { clip, emptyMask, type Mask, type Rect } from "./raster";

export type Combine = "replace" | "add" | "subtract" | "intersect";

export function rectangle(width: number, height: number, rect: Rect): Mask {
  const mask = emptyMask(width, height);
  const r = clip(
    { x: Math.round(rect.x), y: Math.round(rect.y), width: Math.round(rect.width), height: Math.round(rect.height) },
    mask,
  );
  for (let y = r.y; y < r.y + r.height; y++) mask.data.fill(1, y * width + r.x, y * width + r.x + r.width);
  return mask;
}

/** Pixels whose centre lies inside the closed polygon (even-odd rule). points: x0, y0, x1, y1, ... */
export function polygon(width: number, height: number, points: number[]): Mask {
  const mask = emptyMask(width, height);
  const n = points.length / 2;
  for (let y = 0; y < height; y++) {
    const cy = y + 0.5;
    const crossings: number[] = [];
    for (let k = 0; k < n; k++) {
      const [x0, y0] = [points[2 * k], points[2 * k + 1]];
      const [x1, y1] = [points[2 * ((k + 1) % n)], points[2 * ((k + 1) % n) + 1]];
      if (y0 <= cy !== y1 <= cy) crossings.push(x0 + ((cy - y0) / (y1 - y0)) * (x1 - x0));
    }
    crossings.sort((a, b) => a - b);
    for (let k = 0; k + 1 < crossings.length; k += 2) {
      const first = Math.max(0, Math.ceil(crossings[k] - 0.5));
      const last = Math.min(width, Math.ceil(crossings[k + 1] - 0.5));
      if (last > first) mask.data.fill(1, y * width + first, y * width + last);
    }
  }
  return mask;
}

/** `next` applied to what was selected. */
export function combine(before: Mask | null, next: Mask, how: Combine): Mask {
  if (!before || how === "replace")
    return how === "subtract" || how === "intersect" ? emptyMask(next.width, next.height) : next;
  const rules = {
    add: (a: number, b: number) => Math.max(a, b),
    subtract: (a: number, b: number) => a * (1 - b),
    intersect: (a: number, b: number) => a * b,
  };
  const data = before.data.map((value, k) => rules[how](value, next.data[k]));
  return { width: next.width, height: next.height, data };
}

export const invert = (mask: Mask): Mask => ({ ...mask, data: mask.data.map((value) => 1 - value) });

export const isEmpty = (mask: Mask): boolean => !mask.data.some((value) => value > 0.5);

/** Paths of the mask's outline as unit segments x0, y0, x1, y1 between pixels, joined along rows and columns. */
export function outline(mask: Mask): number[] {
  const { width, height, data } = mask;
  const on = (x: number, y: number) => x >= 0 && y >= 0 && x < width && y < height && data[y * width + x] > 0.5;
  const lines: number[] = [];
  const scan = (
    across: number,
    along: number,
    edge: (a: number, b: number) => boolean,
    add: (a: number, from: number, to: number) => void,
  ) => {
    for (let a = 0; a <= across; a++) {
      let from = -1;
      for (let b = 0; b <= along; b++) {
        const is = b < along && edge(a, b);
        if (is && from < 0) from = b;
        if (!is && from >= 0) {
          add(a, from, b);
          from = -1;
        }
      }
    }
  };
  scan(
    height,
    width,
    (y, x) => on(x, y) !== on(x, y - 1),
    (y, a, b) => lines.push(a, y, b, y),
  );
  scan(
    width,
    height,
    (x, y) => on(x, y) !== on(x - 1, y),
    (x, a, b) => lines.push(x, a, x, b),
  );
  return lines;
}
