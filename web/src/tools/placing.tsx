/**
 * What texts and pictures have in common: drag the inside to move, a corner to scale, the knob to turn (Shift: steps of 15
 * degrees), and whether they lie on the surface.
 */

import { viewScale } from "../paint/brush-settings";
import { anchorAt, anchorPixel, angleOf, upAt, type Anchor } from "../paint/decal";
import { decalAsked } from "../paint/decal-preview";
import { discardPlacement } from "../paint/lay-placement";
import {
  evened,
  fromAnchor,
  handles,
  laying,
  level,
  placedSteps,
  placement,
  standOf,
  type Placement,
} from "../paint/placement";
import { surfaceOf, wrapping } from "../paint/view-surface";
import { camera } from "../state/store";
import { Check, Slider } from "../ui/parts";
import type { Pen, ToolGesture } from "./tool";

/** Reach of a handle, pixels of the screen: more for a finger. */
const GRAB_PX = 14;
const TOUCH_GRAB_PX = 22;
const grabReach = (): number => (matchMedia("(pointer: coarse)").matches ? TOUCH_GRAB_PX : GRAB_PX) * viewScale.value;
/** Of angles while Shift is held, radians. */
const STEP = Math.PI / 12;

type Grip = { part: "move" | "scale" | "turn"; from: Placement; pen: Pen };

/** `begin`: a press where nothing is placed yet; `begun`: it went up again. */
export function placing(begin: (pen: Pen) => void = () => {}, begun: () => void = () => {}): ToolGesture {
  let grip: Grip | null = null;
  let beginning = false;
  return {
    inAnotherView: "goes on",
    down(pen) {
      const p = placement.value;
      if (laying.value) return;
      if (!p) {
        beginning = true;
        return begin(pen);
      }
      const { corners, knob } = handles(p);
      const grabbed = ([x, y]: [number, number]) => Math.hypot(pen.x - x, pen.y - y) < grabReach();
      grip = { part: grabbed(knob) ? "turn" : corners.some(grabbed) ? "scale" : "move", from: p, pen };
      placedSteps.note(standOf(p));
    },
    move(pen) {
      // a key may have taken it away, or had it laid, while it was dragged
      if (grip && placement.value && !laying.value)
        placement.value = grip.from.anchor ? onSurface(grip, grip.from.anchor, pen) : onView(grip, pen);
    },
    up() {
      if (grip && placement.value === grip.from) placedSteps.dropLast(); // a click
      grip = null;
      if (beginning) begun();
      beginning = false;
    },
    cancel() {
      const held = grip;
      grip = null;
      beginning = false;
      if (!held) return void discardPlacement();
      placedSteps.dropLast();
      if (placement.value && !laying.value) placement.value = held.from; // the drag is taken back, not the picture
    },
  };
}

/** Move what is placed by pixels of the screen; `again`: the key is held, and all of it is one step. */
export function nudge(right: number, down: number, again: boolean): void {
  const p = placement.value;
  if (!p || laying.value) return;
  const [x, y] = [right * viewScale.value, down * viewScale.value];
  const at = (x: number, y: number): Pen => ({ x, y, pressure: 1, shift: false, alt: false });
  const grip: Grip = { part: "move", from: p, pen: at(0, 0) };
  if (!again) placedSteps.note(standOf(p));
  placement.value = p.anchor ? onSurface(grip, p.anchor, at(x, y)) : onView(grip, at(x, y));
}

/** Moved, scaled or turned on the view. */
function onView({ part, from, pen: first }: Grip, pen: Pen): Placement {
  if (part === "move") return { ...from, x: from.x + pen.x - first.x, y: from.y + pen.y - first.y };
  const reach = (at: Pen) => Math.hypot(at.x - from.x, at.y - from.y) || 1;
  if (part === "scale") return { ...from, scale: Math.max(0.01, (from.scale * reach(pen)) / reach(first)) };
  const angle = Math.atan2(pen.y - from.y, pen.x - from.x) + Math.PI / 2;
  return { ...from, angle: pen.shift ? Math.round(angle / STEP) * STEP : angle };
}

/** Moved, scaled or turned on the surface. */
function onSurface({ part, from, pen: first }: Grip, anchor: Anchor, pen: Pen): Placement {
  const now = camera.value!;
  const middle = anchorPixel(now, anchor);
  if (part === "move") {
    const view = surfaceOf(now);
    const [x, y] = [middle.x + pen.x - first.x, middle.y + pen.y - first.y];
    const moved =
      view && anchorAt(view, x, y, angleOf(now, anchor, level()), anchor.unit, level(), evened(from, anchor.unit));
    return moved ? fromAnchor(from, moved) : placement.value!;
  }
  const reach = (at: Pen) => Math.hypot(at.x - middle.x, at.y - middle.y) || 1;
  if (part === "scale")
    return fromAnchor(from, { ...anchor, unit: anchor.unit * Math.max(0.02, reach(pen) / reach(first)) });
  const turned = (at: Pen) => Math.atan2(at.y - middle.y, at.x - middle.x);
  let angle = angleOf(now, anchor, level()) + turned(pen) - turned(first);
  if (pen.shift) angle = Math.round(angle / STEP) * STEP;
  return fromAnchor(from, { ...anchor, up: upAt(now, anchor.normal, angle, level()) });
}

/** Whether it lies on the surface, and how far round. */
export function OnSurface() {
  const { on, limit } = wrapping.value;
  if (placement.value?.flat) return null;
  return (
    <>
      <Check
        label="On the surface"
        value={on}
        onChange={(next) => (wrapping.value = { ...wrapping.value, on: next })}
      />
      {on && (
        <Slider
          label="Wrap"
          value={limit}
          min={5}
          max={180}
          step={5}
          unit="°"
          reset={180}
          onInput={(v) => (wrapping.value = { ...wrapping.value, limit: Math.round(v) })}
        />
      )}
      {on && placement.value && !placement.value.anchor && <span class="hint">No surface under it yet</span>}
      {on && placement.value?.anchor && decalAsked.value && (
        <span class="hint">Flat until it is known how it lies</span>
      )}
    </>
  );
}
