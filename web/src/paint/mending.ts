/** Strokes that mend: colours from somewhere else, with the tone of the place itself. */

import { editor } from "../editor/editor";
import { camera } from "../state/store";
import type { Pixels } from "./flood";
import { heal } from "./heal";
import { limit, solid } from "./patch";
import type { Mask, Rect } from "./raster";
import { selection } from "./selected";
import type { Stroke } from "./stroke";
import { sourceNear } from "./surroundings";

/** Light over what is drawn, until it is mended. */
export const markMending = (stroke: Stroke): void =>
  stroke.setSource(solid([128, 128, 128], "lighten", () => stroke.base));

/** Pixels that show the background and nothing else. */
function emptyPixels(pixels: Pixels): (at: number) => boolean {
  const [r, g, b] = (camera.value?.background ?? [-1, -1, -1]).map((v) => Math.round(v * 255));
  return (at) => pixels.data[at] === r && pixels.data[at + 1] === g && pixels.data[at + 2] === b;
}

/** Mend what a stroke covers, from `offset` away or, where that is null, from what lies around it. */
export function mend(stroke: Stroke, offset: [number, number] | null): void {
  const { base, mask, extent } = stroke;
  if (!base || extent.width === 0) return;
  const isEmpty = emptyPixels(base);
  const away = offset ?? sourceNear(base, mask, extent, isEmpty);
  const from = (x: number, y: number) =>
    away ? (limit(y - away[1], base.height) * base.width + limit(x - away[0], base.width)) * 4 : -1; // -1: tone alone
  const { rect: area, data } = heal(base, mask, extent, from, isEmpty);
  stroke.setSource((x, y, out) => {
    const at = ((y - area.y) * area.width + x - area.x) * 4;
    [out[0], out[1], out[2]] = [data[at], data[at + 1], data[at + 2]];
  });
  stroke.touch(extent);
}

/** Heal what is selected of the view from what lies around it: tone from its border, texture from beside it. */
export async function healFromAround(): Promise<void> {
  const area = selection.value;
  if (!area) return;
  await editor.pixels.now();
  const stroke = editor.strokes.begin("clone", "Heal from around", { opacity: 1, oneSided: true });
  if (!stroke) return;
  stroke.mask.data.set(area.data);
  markMending(stroke);
  stroke.touch(bounds(area));
  await editor.strokes.end(stroke, (drawn) => {
    const isEmpty = drawn.base ? emptyPixels(drawn.base) : () => false;
    for (let k = 0; k < area.data.length; k++) if (isEmpty(k * 4)) drawn.mask.data[k] = 0; // nothing to paint on
    mend(drawn, null);
  });
}

/** The rectangle of what a mask covers. */
function bounds({ width, height, data }: Mask): Rect {
  let [left, top, right, bottom] = [width, height, 0, 0];
  for (let k = 0; k < data.length; k++) {
    if (data[k] <= 0) continue;
    const [x, y] = [k % width, Math.floor(k / width)];
    [left, top] = [Math.min(left, x), Math.min(top, y)];
    [right, bottom] = [Math.max(right, x + 1), Math.max(bottom, y + 1)];
  }
  return { x: left, y: top, width: Math.max(0, right - left), height: Math.max(0, bottom - top) };
}
