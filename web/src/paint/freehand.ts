/** Tools that follow the pen: brush, eraser, clone, heal, and the straight line. */

import { signal } from "@preact/signals";

import { brush, camera, color, maskShows, paintMode, toast } from "../state/store";
import { brushFor, colorSource, grainOf, stringLength } from "./brush";
import { DabPath, Stabiliser, type Brush } from "./dabs";
import {
  beginStroke,
  cancelStroke,
  chosenEraser,
  chosenMask,
  chosenPaintLayer,
  cloneFrom,
  endStroke,
  originalPixels,
  viewPixels,
} from "./stroke-queue";
import type { LayerInfo } from "../messages";
import type { Pixels } from "./flood";
import { setColor } from "./point-tools";
import { heal } from "./heal";
import { limit, picture, shifted, solid } from "./patch";
import { union, type Mask, type Point, type Rect } from "./raster";
import { selection } from "./selection";
import type { Stroke } from "./stroke";
import { withRelief } from "./relief";
import { sourceNear } from "./surroundings";
import type { Pen, ToolHandler } from "./tool";

/** The brush on its string, to be shown; null: no stroke is drawn, or there is no string. */
export const pulled = signal<Point | null>(null);

const point = (pen: Pen): Point => ({ x: pen.x, y: pen.y, pressure: pen.pressure });

/**
 * Something drawn along the pen's path; `begin` makes the stroke and says what its colours are. plain: with a round tip,
 * whatever the brush has.
 */
function along(
  begin: (pen: Pen) => Stroke | null,
  finish: (stroke: Stroke) => void = () => {},
  plain = false,
): ToolHandler {
  let stroke: Stroke | null = null;
  let path: DabPath;
  let hand: Stabiliser;
  return {
    down(pen) {
      stroke = begin(pen);
      if (!stroke) return;
      path = new DabPath(stroke.mask, brushFor(pen.x, pen.y, plain));
      hand = new Stabiliser(stringLength());
      if (!plain) stroke.setGrain(grainOf());
      stroke.touch(path.down(hand.down(point(pen))));
    },
    move(pen) {
      if (!stroke) return;
      const at = hand.move(point(pen));
      if (at) stroke.touch(path.move(at));
      if (stringLength() > 0) pulled.value = hand.brush;
    },
    up(pen) {
      pulled.value = null;
      if (!stroke) return;
      // a mouse has full pressure to the end, a pen that is lifted has none: that of the last point stays
      const end = { ...point(pen), pressure: hand.brush?.pressure ?? pen.pressure };
      stroke.touch(union(path.move(end), path.up()));
      void endStroke(stroke, finish);
      stroke = null;
    },
    cancel() {
      pulled.value = null;
      if (stroke) void cancelStroke(stroke);
      stroke = null;
    },
  };
}

const NAMES = { normal: "Brush", color: "Colour", darken: "Darken", lighten: "Lighten" } as const;

/** Hide or show the layer whose mask is chosen. */
function maskStroke(shows: boolean, layer: LayerInfo | null = chosenMask()): Stroke | null {
  if (!layer) return null;
  const stroke = beginStroke("mask", shows ? "Show" : "Hide", brush.value.opacity, { layer: layer.id });
  stroke?.setSource(solid(shows ? [255, 255, 255] : [0, 0, 0], "normal", () => stroke.base));
  return stroke;
}

export const paintBrush = along(() => {
  if (chosenMask()) return maskStroke(maskShows.value);
  const stroke = beginStroke("paint", NAMES[paintMode.value]);
  if (!stroke) return null;
  stroke.setSource(colorSource(stroke));
  setColor(color.value); // one of the latest now
  return stroke;
});

/** Takes away the chosen layer's paint; with Shift, and where no paint is chosen, everything down to the original. */
export const eraser = along((pen) => {
  if (chosenMask()) return maskStroke(!maskShows.value);
  const chosen = pen.shift ? null : chosenPaintLayer();
  if (chosen?.kind === "merged") return maskStroke(false, chosen); // all that it is made of goes there
  const more = chosenEraser();
  const stroke = chosen
    ? beginStroke("erase", "Erase")
    : beginStroke("erase", "Erase to original", brush.value.opacity, more ? { layer: more.id } : {});
  if (!stroke) return null;
  let original: Pixels | null = null;
  stroke.setSource(picture(() => original ?? stroke.base));
  originalPixels(chosen?.id ?? null).then(
    (pixels) => {
      original = pixels;
      stroke.paint();
    },
    () => {}, // the toast was shown; erasing works without its picture
  );
  return stroke;
});

function fromSource(pen: Pen, name: string): Stroke | null {
  const from = cloneFrom.value;
  if (!from) {
    toast("info", "Choose where to copy from first.", "Hold Alt and click on the asset, or press Set the source.");
    return null;
  }
  const offset: [number, number] = from.offset ?? [pen.x - from.x, pen.y - from.y];
  cloneFrom.value = { ...from, offset };
  const stroke = beginStroke("clone", name);
  stroke?.setSource(shifted(offset[0], offset[1], () => stroke.base));
  return stroke;
}

export const clone = withRelief(
  sampling(along((pen) => fromSource(pen, "Clone"), undefined, true)),
  () => choosingSource.value,
);

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

/**
 * With a source: shows the copy while drawing and mends its colours at the end, when the border of the region is known.
 * Without one the region is shown light while it is drawn, and mended from its surroundings.
 */
export const healer = sampling(
  along(
    (pen) => {
      if (cloneFrom.value) return fromSource(pen, "Heal");
      const stroke = beginStroke("clone", "Heal");
      stroke?.setSource(solid([128, 128, 128], "lighten", () => stroke.base));
      return stroke;
    },
    (stroke) => mend(stroke, cloneFrom.value?.offset ?? null),
    true,
  ),
);

/** Heal what is selected of the view from what lies around it: tone from its border, texture from beside it. */
export async function healFromAround(): Promise<void> {
  const area = selection.value;
  if (!area) return;
  await viewPixels();
  const stroke = beginStroke("clone", "Heal from around", 1);
  if (!stroke) return;
  stroke.mask.data.set(area.data);
  stroke.setSource(solid([128, 128, 128], "lighten", () => stroke.base));
  stroke.touch(bounds(area));
  await endStroke(stroke, (drawn) => {
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

/** The next click chooses the source: for those without an Alt key. */
export const choosingSource = signal(false);

/** Alt and a click choose the source instead. */
function sampling(handler: ToolHandler): ToolHandler {
  return {
    ...handler,
    down(pen) {
      if (pen.alt || choosingSource.value) cloneFrom.value = { x: pen.x, y: pen.y, offset: null };
      else handler.down(pen);
      choosingSource.value = false;
    },
  };
}

let lineStart: Pen | null = null;
let lineStroke: Stroke | null = null;
let lineBrush: Brush;

/** Drag from end to end; Shift keeps to multiples of 45 degrees. */
export const line: ToolHandler = {
  down(pen) {
    lineStart = pen;
    lineStroke = beginStroke("paint", "Line");
    const stroke = lineStroke;
    if (!stroke) return;
    lineBrush = { ...brushFor(pen.x, pen.y), pressureSize: false, pressureFlow: false };
    stroke.setSource(colorSource(stroke));
    stroke.setGrain(grainOf());
  },
  move(pen) {
    if (!lineStroke || !lineStart) return;
    let [dx, dy] = [pen.x - lineStart.x, pen.y - lineStart.y];
    if (pen.shift) {
      const angle = Math.round(Math.atan2(dy, dx) / (Math.PI / 4)) * (Math.PI / 4);
      const length = Math.hypot(dx, dy);
      [dx, dy] = [Math.cos(angle) * length, Math.sin(angle) * length];
    }
    lineStroke.reset();
    const from = { x: lineStart.x, y: lineStart.y, pressure: 1 };
    const path = new DabPath(lineStroke.mask, lineBrush); // anew, with the same seed: jitter does not flicker
    const begun = path.down(from);
    const drawn = path.move({ x: from.x + dx, y: from.y + dy, pressure: 1 });
    lineStroke.touch(union(union(begun, drawn), path.up()));
  },
  up() {
    if (lineStroke) void endStroke(lineStroke);
    lineStroke = lineStart = null;
  },
  cancel() {
    if (lineStroke) void cancelStroke(lineStroke);
    lineStroke = lineStart = null;
  },
};
