/** From the pointers on the view to the tool in hand or to the camera: one of them has the pen at a time. */

import { signal } from "@preact/signals";

import { glide, go } from "../editor/camera-moves";
import { editor } from "../editor/editor";
import { boxGesture } from "../paint/crop-box";
import { camera, frozen, pose, state } from "../state/store";
import type { Vec3 } from "../view/camera";
import { Gestures } from "../view/gestures";
import { Drawing, NO_PRESSURE, type PenKnowledge } from "./drawing";
import { pickColor } from "./eyedropper";
import { eraser } from "./eraser";
import { inHand } from "./index";
import type { Pen, ToolGesture } from "./tool";

/** Pen over the view, view pixels; null: elsewhere. */
export const hover = signal<{ x: number; y: number } | null>(null);
/** Space is held: the pen moves the camera. */
export const spaceHeld = signal(false);

/** A press that moves less is a click, CSS pixels. */
const CLICK_PX = 4;
/** The button of a pen's other end (Pointer Events). */
const ERASER_BUTTON = 5;
/** How near the eye may come, of the asset's radius. */
const NEAREST_SHARE = 0.02;

export const gestures = new Gestures({
  pose: () => pose.value,
  go,
  glide,
  up: () => (state.value?.asset.up ?? [0, -1, 0]) as Vec3,
  nearest: () => (state.value?.asset.radius ?? 1) * NEAREST_SHARE,
  extent: () => state.value?.asset.radius ?? 1,
  frame: () => editor.viewer.renderer.domElement.getBoundingClientRect(),
  hit: (eye, direction) => editor.viewer.hit(eye, direction),
});

class PenInput {
  private drawing: { drag: Drawing; pointer: number; last: PointerEvent } | null = null;
  private readonly pens: PenKnowledge = { pressed: null };
  /** Alt is held and the pointer down: a click takes a colour, a drag turns the view. */
  private choosing: { pen: Pen; event: PointerEvent; dragged: boolean } | null = null;
  private penSeen = false;

  /** No stroke reads the view, and none is drawn: the camera may move. */
  get cameraFree(): boolean {
    return !frozen.value && !this.drawing;
  }

  /** Take back what the pen has begun (Escape). */
  cancel(): void {
    if (!this.takeBack()) inHand().gesture?.cancel();
  }

  /** Take back the stroke (or drag) that the pen is at; false: it is at none. */
  takeBack(): boolean {
    const begun = this.drawing;
    this.drawing = null;
    begun?.drag.cancel();
    return begun !== null;
  }

  /** The pen goes up where it is: what it drew stays. */
  finish(): void {
    const begun = this.drawing;
    this.drawing = null;
    begun?.drag.up();
  }

  /** Another view under the pen: the window was resized, came to another screen, or the asset was turned elsewhere. What
   * the pen is at is in pixels of the view before, so its next point would lie somewhere else. */
  viewMoved(): void {
    const changed = this.drawing?.drag.gesture.inAnotherView;
    if (changed === "ends") this.finish();
    else if (changed !== "goes on") this.takeBack();
  }

  /** `box`: the view on the page. */
  down(event: PointerEvent, box: HTMLElement): void {
    if ((event.target as HTMLElement).closest("button, input")) return;
    box.focus({ preventScroll: true });
    if (event.pointerType === "pen") this.penSeen = true;
    box.setPointerCapture(event.pointerId);
    const pen = penOf(event, box);
    if (event.button === ERASER_BUTTON && state.value) return this.draw(event, eraser.gesture, pen);
    const onBox = event.button === 0 && !spaceHeld.value && !gestures.busy ? boxGesture(pen) : null;
    if (onBox) return this.draw(event, onBox, pen);
    const spec = inHand();
    // once a pen was seen, fingers turn the view; and a second finger always does
    const finger = event.pointerType === "touch" && (this.penSeen || gestures.busy || this.drawing !== null);
    const moves = event.button !== 0 || spaceHeld.value || !spec.gesture || finger || state.value === null;
    if (moves) {
      if (this.drawing && this.drawing.last.pointerType !== "touch" && finger) return; // the palm of the hand that draws
      if (this.drawing && finger) {
        gestures.down(this.drawing.last, "orbit"); // a second finger: it was meant as a pinch
        this.cancel();
      }
      const alone = event.altKey && event.button === 2 ? "dolly" : "orbit";
      if (!this.drawing) gestures.down(event, event.button === 1 || event.shiftKey ? "pan" : alone);
      return;
    }
    if (event.altKey && !spec.takesAlt && !this.drawing) {
      this.choosing = { pen, event, dragged: false };
      return gestures.down(event, event.shiftKey ? "pan" : "orbit");
    }
    this.draw(event, spec.gesture, pen);
  }

  move(event: PointerEvent, box: HTMLElement): void {
    const pen = penOf(event, box);
    hover.value = event.pointerType === "touch" ? null : { x: pen.x, y: pen.y };
    if (event.buttons === 0) return this.released(event);
    const { drawing, choosing } = this;
    if (drawing?.pointer === event.pointerId) {
      drawing.last = event;
      const between = event.getCoalescedEvents?.() ?? [];
      for (const one of between.length ? between : [event]) drawing.drag.move(penOf(one, box));
      return;
    }
    if (choosing && !choosing.dragged) {
      const first = choosing.event;
      choosing.dragged = Math.hypot(event.clientX - first.clientX, event.clientY - first.clientY) > CLICK_PX;
      if (!choosing.dragged) return;
    }
    if (this.cameraFree) gestures.move(event);
    else gestures.rest(event);
  }

  up(event: PointerEvent, box: HTMLElement): void {
    gestures.up(event);
    if (this.choosing) {
      const { pen, dragged } = this.choosing;
      this.choosing = null;
      if (!dragged && event.type !== "pointercancel") (inHand().altClick ?? pickColor)(pen);
      return;
    }
    const drag = this.ended(event);
    if (!drag) return;
    if (event.type !== "pointercancel") drag.up(penOf(event, box));
    else if (event.pointerType === "touch")
      drag.cancel(); // the system made another gesture of it
    else drag.up(); // a pen that is taken away keeps what it drew
  }

  /** Nothing is pressed: where something still goes on, its end was not seen (outside of the window, or lost). */
  private released(event: PointerEvent): void {
    gestures.up(event);
    this.choosing = null;
    this.ended(event)?.up();
  }

  private ended(event: PointerEvent): Drawing | null {
    if (this.drawing?.pointer !== event.pointerId) return null;
    const { drag } = this.drawing;
    this.drawing = null;
    return drag;
  }

  private draw(event: PointerEvent, gesture: ToolGesture | null, pen: Pen): void {
    if (!gesture || this.drawing) return;
    if (event.pointerType === "pen") gestures.stop(); // what rests there is the hand that draws, until it is lifted
    const drag = new Drawing(gesture, pen, event.pointerType === "pen", this.pens);
    this.drawing = { drag, pointer: event.pointerId, last: event };
  }
}

export const penInput = new PenInput();

function penOf(event: PointerEvent, box: HTMLElement): Pen {
  const frame = box.getBoundingClientRect();
  const scale = (camera.value?.width ?? frame.width) / frame.width;
  // what a pen's 0 means is found out by Drawing; fingers without pressure may say 0 as well
  const pressure =
    event.pointerType === "mouse" ? 1 : event.pointerType === "pen" ? event.pressure : event.pressure || NO_PRESSURE;
  return {
    x: (event.clientX - frame.left) * scale,
    y: (event.clientY - frame.top) * scale,
    pressure,
    shift: event.shiftKey,
    alt: event.altKey,
  };
}

/** Turn by keys, radians. */
export function turnBy(right: number, down: number): void {
  if (penInput.cameraFree) gestures.turn(right, down);
}

/** Look at what is under the cursor. */
export function focusAtCursor(): void {
  const at = hover.value;
  const now = camera.value;
  const frame = editor.viewer.renderer.domElement.getBoundingClientRect();
  if (!penInput.cameraFree || !now) return;
  const [x, y] = at ? [at.x / now.width, at.y / now.height] : [0.5, 0.5];
  gestures.focus(frame.left + x * frame.width, frame.top + y * frame.height);
}
