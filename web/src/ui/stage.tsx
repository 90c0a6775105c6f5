/** The view with everything that lies over it, and the pointer on it. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { frozen, overlayCanvas, viewMoved, warmUp } from "../paint/stroke-queue";
import { clone, eraser, healer, line, paintBrush } from "../paint/freehand";
import { boxTool } from "../paint/crop-box";
import { Drawing, NO_PRESSURE, type PenKnowledge } from "../paint/drawing";
import { placement, placer } from "../paint/placement";
import { eyedropper, filler, pickColor, selector } from "../paint/point-tools";
import type { Pen, ToolHandler } from "../paint/tool";
import { camera, pose, state, tool, view, type Tool } from "../state/store";
import { glide, go, refresh, report, viewer } from "../state/studio";
import type { Vec3 } from "../view/camera";
import { Gestures } from "../view/gestures";
import { drawOverlay, hover } from "./overlay";
import { Overlays } from "./server-renders";

const HANDLERS: Partial<Record<Tool, ToolHandler>> = {
  brush: paintBrush,
  erase: eraser,
  fill: filler,
  line,
  text: placer,
  stamp: placer,
  clone,
  heal: healer,
  pick: eyedropper,
  select: selector,
};
/** Space is held: the pen moves the camera. */
export const spaceHeld = signal(false);
/** The view's camera moves: still pictures of the old one are out of date. */
export const moving = signal(false);
const REST_MS = 350;

export const gestures = new Gestures({
  pose: () => pose.value,
  go,
  glide,
  up: () => (state.value?.asset.up ?? [0, -1, 0]) as Vec3,
  nearest: () => (state.value?.asset.radius ?? 1) * 0.02,
  extent: () => state.value?.asset.radius ?? 1,
  frame: () => viewer.renderer.domElement.getBoundingClientRect(),
  hit: (eye, direction) => viewer.hit(eye, direction),
});
let drawing: { drag: Drawing; pointer: number; last: PointerEvent } | null = null;
const pens: PenKnowledge = { pressed: null };
/** Alt is held and the pointer down: a click takes a colour, a drag turns the view. */
let choosing: { pen: Pen; event: PointerEvent; dragged: boolean } | null = null;
let penSeen = false;
/** A press that moves less is a click, CSS pixels. */
const CLICK_PX = 4;
/** Tools in which Alt means something to the pen itself. */
const ALT_TOOLS: readonly Tool[] = ["select"];
const ERASER_BUTTON = 5;

/** Take back what the pen has begun (Escape). */
export function cancelDrawing(): void {
  if (!takeBackDrawing()) HANDLERS[tool.value]?.cancel();
}

/** Take back the stroke (or drag) that the pen is at; false: it is at none. */
export function takeBackDrawing(): boolean {
  const begun = drawing;
  drawing = null;
  begun?.drag.cancel();
  return begun !== null;
}

/** Whether the camera may move now: no stroke reads the view. */
export const cameraFree = (): boolean => !frozen.value && !drawing;

/** Turn by keys. */
export const turnBy = (right: number, down: number): void => {
  if (cameraFree()) gestures.turn(right, down);
};

/** Look at what is under the cursor. */
export function focusAtCursor(): void {
  const at = hover.value;
  const now = camera.value;
  const frame = viewer.renderer.domElement.getBoundingClientRect();
  if (!cameraFree() || !now) return;
  const [x, y] = at ? [at.x / now.width, at.y / now.height] : [0.5, 0.5];
  gestures.focus(frame.left + x * frame.width, frame.top + y * frame.height);
}

export function Stage({ canvas }: { canvas: HTMLCanvasElement }) {
  const box = useRef<HTMLDivElement>(null);
  const overlay = useRef<HTMLCanvasElement>(null);

  useEffect(() => {
    const element = box.current!;
    element.prepend(canvas);
    canvas.after(overlayCanvas);
    canvas.className = "view";
    overlayCanvas.className = "overlay";
    const ratio = () => ((camera.value?.width ?? 1) > 0 ? overlay.current!.width / (camera.value?.width ?? 1) : 1);
    const size = new ResizeObserver(() => {
      const dpr = window.devicePixelRatio || 1;
      overlay.current!.width = Math.round(element.clientWidth * dpr);
      overlay.current!.height = Math.round(element.clientHeight * dpr);
      refresh();
    });
    size.observe(element);
    // another screen, or the browser's zoom: other pixels in the same place
    let screen: MediaQueryList | null = null;
    const otherScreen = () => {
      screen?.removeEventListener("change", otherScreen);
      screen = matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`);
      screen.addEventListener("change", otherScreen);
      if (pose.value) refresh();
    };
    otherScreen();
    const stopOverlay = drawOverlay(overlay.current!, ratio);
    const stopView = view.subscribe(() => refresh());
    let timer: ReturnType<typeof setTimeout>;
    const stopCamera = camera.subscribe(() => {
      viewMoved();
      moving.value = true;
      clearTimeout(timer);
      timer = setTimeout(() => {
        moving.value = false;
        if (tool.value !== "orbit") warmUp();
      }, REST_MS);
    });
    return () => {
      size.disconnect();
      screen?.removeEventListener("change", otherScreen);
      stopOverlay();
      stopView();
      stopCamera();
    };
  }, []);

  const penOf = (event: PointerEvent): Pen => {
    const frame = box.current!.getBoundingClientRect();
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
  };

  const draw = (event: PointerEvent, handler: ToolHandler | undefined, pen: Pen) => {
    if (!handler || drawing) return;
    drawing = {
      drag: new Drawing(handler, pen, event.pointerType === "pen", pens),
      pointer: event.pointerId,
      last: event,
    };
  };

  const down = (event: PointerEvent) => {
    if ((event.target as HTMLElement).closest("button, input")) return;
    box.current!.focus({ preventScroll: true });
    if (event.pointerType === "pen") penSeen = true;
    box.current!.setPointerCapture(event.pointerId);
    const pen = penOf(event);
    if (event.button === ERASER_BUTTON && state.value) return draw(event, eraser, pen);
    const onBox = event.button === 0 && !spaceHeld.value && !gestures.busy ? boxTool(pen) : null;
    if (onBox) return draw(event, onBox, pen);
    const finger = event.pointerType === "touch" && (penSeen || gestures.busy || drawing !== null);
    const moves = event.button !== 0 || spaceHeld.value || tool.value === "orbit" || finger || state.value === null;
    if (moves) {
      if (drawing && finger) {
        gestures.down(drawing.last, "orbit"); // a second finger: it was meant as a pinch
        cancelDrawing();
      }
      const alone = event.altKey && event.button === 2 ? "dolly" : "orbit";
      if (!drawing) gestures.down(event, event.button === 1 || event.shiftKey ? "pan" : alone);
      return;
    }
    if (event.altKey && !ALT_TOOLS.includes(tool.value) && !drawing) {
      choosing = { pen, event, dragged: false };
      return gestures.down(event, event.shiftKey ? "pan" : "orbit");
    }
    draw(event, HANDLERS[tool.value], pen);
  };

  const move = (event: PointerEvent) => {
    const pen = penOf(event);
    hover.value = event.pointerType === "touch" ? null : { x: pen.x, y: pen.y };
    if (event.buttons === 0) return released(event);
    if (drawing?.pointer === event.pointerId) {
      drawing.last = event;
      const between = event.getCoalescedEvents?.() ?? [];
      for (const one of between.length ? between : [event]) drawing.drag.move(penOf(one));
      return;
    }
    if (choosing && !choosing.dragged) {
      const first = choosing.event;
      choosing.dragged = Math.hypot(event.clientX - first.clientX, event.clientY - first.clientY) > CLICK_PX;
      if (!choosing.dragged) return;
    }
    if (frozen.value === 0) gestures.move(event);
    else gestures.rest(event);
  };

  /** Nothing is pressed: where something still goes on, its end was not seen (outside of the window, or lost). */
  const released = (event: PointerEvent) => {
    gestures.up(event);
    choosing = null;
    if (drawing?.pointer !== event.pointerId) return;
    const { drag } = drawing;
    drawing = null;
    drag.up();
  };

  const up = (event: PointerEvent) => {
    gestures.up(event);
    if (choosing) {
      const { pen, dragged } = choosing;
      choosing = null;
      if (dragged || event.type === "pointercancel") return;
      if (tool.value === "clone" || tool.value === "heal") return HANDLERS[tool.value]!.down(pen);
      return void pickColor(pen).catch(report);
    }
    if (drawing?.pointer !== event.pointerId) return;
    const { drag } = drawing;
    drawing = null;
    if (event.type !== "pointercancel") drag.up(penOf(event));
    else if (event.pointerType === "touch")
      drag.cancel(); // the system made another gesture of it
    else drag.up(); // a pen that is taken away keeps what it drew
  };

  const grabbing = spaceHeld.value || tool.value === "orbit";
  const cursor = grabbing ? "grab" : placement.value ? "move" : "none";
  return (
    <div
      ref={box}
      class="stage"
      id="stage"
      tabIndex={0}
      role="application"
      aria-label="View of the asset: drag to use the tool, hold Space or Alt and drag to turn the asset, arrow keys turn it"
      style={{ cursor }}
      onPointerDown={down}
      onPointerMove={move}
      onPointerUp={up}
      onPointerCancel={up}
      onPointerLeave={() => (hover.value = null)}
      onContextMenu={(event) => event.preventDefault()}
      onWheel={(event) => {
        event.preventDefault();
        if (cameraFree()) gestures.wheel(event);
      }}
    >
      <Overlays />
      <canvas ref={overlay} class="cursor-overlay" aria-hidden="true" />
    </div>
  );
}
