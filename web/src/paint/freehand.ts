/** Tools that follow the pen: brush, eraser, clone, heal, and the straight line. */

import { signal } from "@preact/signals";

import { brush, color, maskShows, paintMode, rgb, toast } from "../state/store";
import {
  beginStroke,
  cancelStroke,
  chosenMask,
  chosenPaintLayer,
  cloneFrom,
  endStroke,
  originalPixels,
} from "./strokes";
import type { Pixels } from "./flood";
import { heal } from "./heal";
import { limit, picture, shifted, solid } from "./patch";
import { dab, segment, type Point, type Tip } from "./raster";
import type { Stroke } from "./stroke";
import type { Pen, ToolHandler } from "./tool";

/** A pen that is not pressed at all still marks: its share of the size. */
const MIN_PRESSURE = 0.1;

function tip(pressure: number): Tip {
  const { size, hardness, flow, pressureSize, pressureFlow } = brush.value;
  const press = (on: boolean) => (on ? MIN_PRESSURE + (1 - MIN_PRESSURE) * pressure : 1);
  return { radius: Math.max(0.5, (size / 2) * press(pressureSize)), hardness, flow: flow * press(pressureFlow) };
}

const brushColor = (): [number, number, number] => rgb(color.value).map((c) => c * 255) as [number, number, number];

/** Something drawn along the pen's path; `begin` makes the stroke and says what its colours are. */
function along(begin: (pen: Pen) => Stroke | null, finish: (stroke: Stroke) => void = () => {}): ToolHandler {
  let stroke: Stroke | null = null;
  let last: Point;
  let left = 0;
  const point = (pen: Pen): Point => ({ x: pen.x, y: pen.y, pressure: pen.pressure });
  return {
    down(pen) {
      stroke = begin(pen);
      if (!stroke) return;
      last = point(pen);
      left = 0;
      stroke.touch(dab(stroke.mask, last.x, last.y, tip(last.pressure)));
    },
    move(pen) {
      if (!stroke) return;
      const step = segment(stroke.mask, last, point(pen), tip, left);
      left = step.left;
      last = point(pen);
      stroke.touch(step.rect);
    },
    up() {
      if (!stroke) return;
      void endStroke(stroke, finish);
      stroke = null;
    },
    cancel() {
      if (stroke) void cancelStroke(stroke);
      stroke = null;
    },
  };
}

const NAMES = { normal: "Brush", color: "Colour", darken: "Darken", lighten: "Lighten" } as const;

/** Hide or show the layer whose mask is chosen. */
function maskStroke(shows: boolean): Stroke | null {
  const layer = chosenMask();
  if (!layer) return null;
  const stroke = beginStroke("mask", shows ? "Show" : "Hide", brush.value.opacity, { layer: layer.id });
  stroke?.setSource(solid(shows ? [255, 255, 255] : [0, 0, 0], "normal", () => stroke.base));
  return stroke;
}

export const paintBrush = along(() => {
  if (chosenMask()) return maskStroke(maskShows.value);
  const stroke = beginStroke("paint", NAMES[paintMode.value]);
  stroke?.setSource(solid(brushColor(), paintMode.value, () => stroke.base));
  return stroke;
});

/** Takes away the chosen layer's paint; with Shift, and where no paint is chosen, everything down to the original. */
export const eraser = along((pen) => {
  if (chosenMask()) return maskStroke(!maskShows.value);
  const chosen = pen.shift ? null : chosenPaintLayer();
  const stroke = chosen
    ? beginStroke("erase", "Erase")
    : beginStroke("erase", "Erase to original", brush.value.opacity, {});
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

export const clone = sampling(along((pen) => fromSource(pen, "Clone")));

/** Shows the copy while drawing and mends its colours at the end, when the border of the region is known. */
export const healer = sampling(
  along(
    (pen) => fromSource(pen, "Heal"),
    (stroke) => {
      const { base, mask, extent } = stroke;
      const [dx, dy] = cloneFrom.value?.offset ?? [0, 0];
      if (!base || extent.width === 0) return;
      const healed = heal(
        base,
        mask,
        extent,
        (x, y) => (limit(y - dy, base.height) * base.width + limit(x - dx, base.width)) * 4,
      );
      const area = healed.rect;
      stroke.setSource((x, y, out) => {
        const at = ((y - area.y) * area.width + x - area.x) * 4;
        [out[0], out[1], out[2]] = [healed.data[at], healed.data[at + 1], healed.data[at + 2]];
      });
      stroke.touch(extent);
    },
  ),
);

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

/** Drag from end to end; Shift keeps to multiples of 45 degrees. */
export const line: ToolHandler = {
  down(pen) {
    lineStart = pen;
    lineStroke = beginStroke("paint", "Line");
    const stroke = lineStroke;
    stroke?.setSource(solid(brushColor(), paintMode.value, () => stroke.base));
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
    lineStroke.touch(dab(lineStroke.mask, from.x, from.y, tip(1)));
    lineStroke.touch(segment(lineStroke.mask, from, { x: from.x + dx, y: from.y + dy, pressure: 1 }, tip, 0).rect);
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
