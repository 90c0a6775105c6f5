/** A source beside a region that looks like what is around it, for healing where nobody chose one. Pure. */

import type { Pixels } from "./flood";
import type { Mask, Rect } from "./raster";

/** Distances that are tried, in sizes of the region, and directions. */
const DISTANCES = [1.1, 1.5, 2.1];
const DIRECTIONS = 16;
/** Pixels of the region that are looked at, at most, along each side. */
const SAMPLES = 14;
/** Pixels around the region whose colours are compared. */
const RING = 4;
/** Most of the source that may be missing: outside the view, empty, or in the region itself. */
const MAX_MISSING = 0.25;
/** Levels (of 255) of difference that a source that is missing everywhere would cost. */
const MISSING_COST = 400;
/** Where even the best source differs by more levels, its texture belongs to something else. */
const MAX_UNLIKE = 40;
/** And one that lies one size of the region farther away. */
const FAR_COST = 2;

/** How far [dx, dy] the source lies from the region, to be subtracted; null: there is none. */
export function sourceNear(
  picture: Pixels,
  mask: Mask,
  rect: Rect,
  isEmpty: (at: number) => boolean,
): [number, number] | null {
  const { width, height } = picture;
  const at = (x: number, y: number) => (y * width + x) * 4;
  const painted = (x: number, y: number) => mask.data[y * width + x] > 0;
  const usable = (x: number, y: number) => x >= 0 && y >= 0 && x < width && y < height && !isEmpty(at(x, y));
  const [region, ring] = [[] as [number, number][], [] as [number, number][]];
  const step = (side: number) => Math.max(1, Math.floor((side + 2 * RING) / SAMPLES));
  for (let y = rect.y - RING; y < rect.y + rect.height + RING; y += step(rect.height))
    for (let x = rect.x - RING; x < rect.x + rect.width + RING; x += step(rect.width)) {
      if (x < 0 || y < 0 || x >= width || y >= height) continue;
      if (painted(x, y)) region.push([x, y]);
      else if (usable(x, y)) ring.push([x, y]);
    }
  if (region.length === 0) return null;
  let best: { cost: number; offset: [number, number] } | null = null;
  for (const distance of DISTANCES)
    for (let k = 0; k < DIRECTIONS; k++) {
      const angle = (2 * Math.PI * k) / DIRECTIONS;
      const reach = distance / Math.max(Math.abs(Math.cos(angle)), Math.abs(Math.sin(angle))); // along a square
      const dx = Math.round(reach * Math.cos(angle) * (rect.width + RING));
      const dy = Math.round(reach * Math.sin(angle) * (rect.height + RING));
      let missing = 0;
      for (const [x, y] of region) if (!usable(x - dx, y - dy) || painted(x - dx, y - dy)) missing++;
      const share = missing / region.length;
      if (share > MAX_MISSING) continue;
      let [difference, count] = [0, 0];
      for (const [x, y] of ring) {
        if (!usable(x - dx, y - dy) || painted(x - dx, y - dy)) continue;
        for (let c = 0; c < 3; c++)
          difference += Math.abs(picture.data[at(x, y) + c] - picture.data[at(x - dx, y - dy) + c]);
        count += 3;
      }
      const unlike = count ? difference / count : 0;
      if (unlike > MAX_UNLIKE) continue;
      const cost = unlike + MISSING_COST * share + FAR_COST * distance;
      if (!best || cost < best.cost) best = { cost, offset: [dx, dy] };
    }
  return best?.offset ?? null;
}
