/** What the tools that follow the pen have in common: dabs along its path, behind a string where the hand is steadied. */

import { signal } from "@preact/signals";

import { editor } from "../editor/editor";
import type { LayerInfo } from "../messages";
import { brushFor, grainOf, stringLength } from "../paint/brush";
import { DabPath, Stabiliser } from "../paint/dabs";
import { solid } from "../paint/patch";
import { union, type Point } from "../paint/raster";
import type { Stroke } from "../paint/stroke";
import { brush } from "../state/store";
import type { Pen, ToolGesture } from "./tool";

/** The brush on its string, to be shown; null: no stroke is drawn, or there is no string. */
export const pulled = signal<Point | null>(null);

const point = (pen: Pen): Point => ({ x: pen.x, y: pen.y, pressure: pen.pressure });

/**
 * Something drawn along the pen's path; `begin` makes the stroke and says what its colours are. plain: with a round tip,
 * whatever the brush has.
 */
export function freehand(
  begin: (pen: Pen) => Stroke | null,
  finish: (stroke: Stroke) => void = () => {},
  plain = false,
): ToolGesture {
  let stroke: Stroke | null = null;
  let path: DabPath;
  let hand: Stabiliser;
  return {
    inAnotherView: "ends",
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
      void editor.strokes.end(stroke, finish);
      stroke = null;
    },
    cancel() {
      pulled.value = null;
      if (stroke) void editor.strokes.cancel(stroke);
      stroke = null;
    },
  };
}

/** A stroke on the mask of a layer: it hides the layer there, or shows it. */
export function maskStroke(shows: boolean, layer: LayerInfo): Stroke | null {
  const name = shows ? "Show" : "Hide";
  const stroke = editor.strokes.begin("mask", name, { opacity: brush.value.opacity, target: { layer: layer.id } });
  stroke?.setSource(solid(shows ? [255, 255, 255] : [0, 0, 0], "normal", () => stroke.base));
  return stroke;
}
