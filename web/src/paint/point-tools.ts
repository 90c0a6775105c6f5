/** Tools that act on a point or an area: fill, eyedropper, selection. */

import { signal } from "@preact/signals";

import { brush, camera, color, fill, hex, recentColors, selecting } from "../state/store";
import { report, run } from "../state/studio";
import { beginStroke, endStroke, viewPixels } from "./stroke-queue";
import { colorSource, grainOf } from "./brush";
import { viewScale } from "./brush-settings";
import { likeColor, soften } from "./flood";
import { combine, isEmpty, polygon, rectangle, type Combine } from "./selection-masks";
import { dab, emptyMask, segment, type Mask } from "./raster";
import { deselect, selectArea, selection, sent } from "./selection";
import type { Pen, ToolHandler } from "./tool";

/** What is being drawn as a selection: x0, y0, x1, y1 ... of a closed polygon. */
export const draft = signal<number[] | null>(null);

const nothing = () => {};

export const filler: ToolHandler = {
  down(pen) {
    void fillAt(pen).catch(report);
  },
  move: nothing,
  up: nothing,
  cancel: nothing,
};

async function fillAt(pen: Pen): Promise<void> {
  const { tolerance, contiguous } = fill.value;
  const pixels = await viewPixels();
  const mask = soften(likeColor(pixels, Math.floor(pen.x), Math.floor(pen.y), tolerance, contiguous), 1);
  const stroke = beginStroke("paint", "Bucket", brush.value.opacity);
  if (!stroke) return;
  stroke.setSource(colorSource(stroke));
  stroke.setGrain(grainOf());
  stroke.mask.data.set(mask.data);
  stroke.touch({ x: 0, y: 0, width: mask.width, height: mask.height });
  await endStroke(stroke);
}

/** The colour as seen: the view's pixel under the pen. */
export async function pickColor(pen: Pen): Promise<void> {
  const { data, width, height } = await viewPixels();
  const [x, y] = [Math.floor(pen.x), Math.floor(pen.y)];
  if (x < 0 || y < 0 || x >= width || y >= height) return;
  const at = (y * width + x) * 4;
  setColor(hex([data[at] / 255, data[at + 1] / 255, data[at + 2] / 255]));
}

export function setColor(next: string): void {
  color.value = next;
  recentColors.value = [next, ...recentColors.value.filter((c) => c !== next)].slice(0, 24);
}

export const eyedropper: ToolHandler = {
  down: (pen) => void pickColor(pen).catch(report),
  move: (pen) => void pickColor(pen).catch(report),
  up: nothing,
  cancel: nothing,
};

let start: Pen | null = null;
/** A selection that is being painted, and what was selected before. */
let painting: { before: Mask | null; mask: Mask; last: Pen; left: number; how: Combine } | null = null;

const tip = () => ({
  radius: Math.max(1, (brush.value.size / 2) * viewScale.value),
  hardness: brush.value.hardness,
  flow: 1,
});

function startPainting(pen: Pen): void {
  const now = camera.value;
  if (!now) return;
  const how = pen.alt || (selecting.value.combine === "subtract" && !pen.shift) ? "subtract" : "add";
  painting = { before: selection.value, mask: emptyMask(now.width, now.height), last: pen, left: 0, how };
  dab(painting.mask, pen.x, pen.y, tip());
  showPainted();
}

function showPainted(): void {
  if (!painting) return;
  const next = combine(painting.before, painting.mask, painting.how);
  selection.value = isEmpty(next) ? null : next;
}

/** Rectangle, lasso or colour; with Shift added to what is selected, with Alt taken from it. */
export const selector: ToolHandler = {
  down(pen) {
    if (selecting.value.kind === "brush") return startPainting(pen);
    start = pen;
    if (selecting.value.kind === "color") void selectColor(pen).catch(report);
    else draft.value = [pen.x, pen.y];
  },
  move(pen) {
    if (painting) {
      painting.left = segment(painting.mask, painting.last, pen, tip, painting.left).left;
      painting.last = pen;
      return showPainted();
    }
    if (!start || !draft.value) return;
    if (selecting.value.kind === "lasso") draft.value = [...draft.value, pen.x, pen.y];
    else draft.value = [start.x, start.y, pen.x, start.y, pen.x, pen.y, start.x, pen.y];
  },
  async up(pen) {
    if (painting) {
      const { before, mask, how } = painting;
      painting = null;
      selection.value = before;
      return selectArea(mask, how, selecting.value.through);
    }
    const points = draft.value;
    const first = start;
    draft.value = start = null;
    if (!points || !first) return;
    const { width, height } = await viewPixels();
    if (points.length < 6) {
      if (!first.shift && !first.alt && selecting.value.combine === "replace") deselect();
      return;
    }
    const [x, y] = [Math.min(first.x, pen.x), Math.min(first.y, pen.y)];
    const box = { x, y, width: Math.abs(pen.x - first.x), height: Math.abs(pen.y - first.y) };
    take(selecting.value.kind === "lasso" ? polygon(width, height, points) : rectangle(width, height, box), first);
  },
  cancel() {
    if (painting) selection.value = painting.before;
    draft.value = start = painting = null;
  },
};

/** As seen: the like-coloured pixels of the view, or Gaussians of that colour all over the asset. */
async function selectColor(pen: Pen): Promise<void> {
  const { tolerance, contiguous } = selecting.value;
  const now = camera.value;
  if (!now) return;
  if (!contiguous) {
    const fields = { camera: now, x: pen.x, y: pen.y, tolerance, how: howOf(pen) };
    return void (await sent(() => run("selection.color", fields, "Selecting")));
  }
  take(likeColor(await viewPixels(), Math.floor(pen.x), Math.floor(pen.y), tolerance, true), pen);
}

const howOf = (pen: Pen): Combine => {
  if (pen.shift && pen.alt) return "intersect";
  return pen.shift ? "add" : pen.alt ? "subtract" : selecting.value.combine;
};

function take(mask: Mask, pen: Pen): void {
  selectArea(soften(mask, selecting.value.feather), howOf(pen), selecting.value.through);
}
