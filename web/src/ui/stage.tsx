/** The view with everything that lies over it, and the pointer on it. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { frozen, overlayCanvas, viewMoved, warmUp } from "../paint/strokes";
import { clone, eraser, healer, line, paintBrush } from "../paint/freehand";
import { placement, placer } from "../paint/placement";
import { eyedropper, filler, pickColor, selector } from "../paint/point-tools";
import type { Pen, ToolHandler } from "../paint/tool";
import { camera, pose, state, tool, view, type Tool } from "../state/store";
import { go, refresh, report, viewer } from "../state/studio";
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

const gestures = new Gestures({
  pose: () => pose.value,
  go,
  up: () => (state.value?.asset.up ?? [0, -1, 0]) as Vec3,
  nearest: () => (state.value?.asset.radius ?? 1) * 0.02,
  height: () => viewer.renderer.domElement.clientHeight,
});
let drawing: { handler: ToolHandler; pointer: number } | null = null;
let penSeen = false;

/** Take back what the pen has begun (Escape). */
export function cancelDrawing(): void {
  if (drawing) drawing.handler.cancel();
  else HANDLERS[tool.value]?.cancel();
  drawing = null;
}

/** Turn by keys. */
export const turnBy = (right: number, down: number): void => {
  if (!frozen.value && !drawing) gestures.turn(right, down);
};

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
      stopOverlay();
      stopView();
      stopCamera();
    };
  }, []);

  const penOf = (event: PointerEvent): Pen => {
    const frame = box.current!.getBoundingClientRect();
    const scale = (camera.value?.width ?? frame.width) / frame.width;
    const pressure = event.pointerType === "mouse" ? 1 : event.pressure || 0.5;
    return {
      x: (event.clientX - frame.left) * scale,
      y: (event.clientY - frame.top) * scale,
      pressure,
      shift: event.shiftKey,
      alt: event.altKey,
    };
  };

  const down = (event: PointerEvent) => {
    if ((event.target as HTMLElement).closest("button, input")) return;
    box.current!.focus({ preventScroll: true });
    if (event.pointerType === "pen") penSeen = true;
    const finger = event.pointerType === "touch" && (penSeen || gestures.busy || drawing !== null);
    const moves = event.button !== 0 || spaceHeld.value || tool.value === "orbit" || finger || state.value === null;
    box.current!.setPointerCapture(event.pointerId);
    if (moves) {
      if (drawing && finger) cancelDrawing(); // a second finger: it was meant as a pinch
      if (frozen.value === 0 && !drawing) gestures.down(event, event.button === 1 || event.shiftKey ? "pan" : "orbit");
      return;
    }
    const pen = penOf(event);
    if (event.altKey && (tool.value === "brush" || tool.value === "fill" || tool.value === "line"))
      return void pickColor(pen).catch(report);
    const handler = HANDLERS[tool.value];
    if (!handler || drawing) return;
    drawing = { handler, pointer: event.pointerId };
    handler.down(pen);
  };

  const move = (event: PointerEvent) => {
    const pen = penOf(event);
    hover.value = event.pointerType === "touch" ? null : { x: pen.x, y: pen.y };
    if (drawing?.pointer === event.pointerId) {
      const between = event.getCoalescedEvents?.() ?? [];
      for (const one of between.length ? between : [event]) drawing.handler.move(penOf(one));
    } else if (frozen.value === 0) gestures.move(event);
  };

  const up = (event: PointerEvent) => {
    gestures.up(event);
    if (drawing?.pointer !== event.pointerId) return;
    const { handler } = drawing;
    drawing = null;
    if (event.type === "pointercancel") handler.cancel();
    else handler.up(penOf(event));
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
      aria-label="View of the asset: drag to use the tool, hold Space and drag to turn the asset, arrow keys turn it"
      style={{ cursor }}
      onPointerDown={down}
      onPointerMove={move}
      onPointerUp={up}
      onPointerCancel={up}
      onPointerLeave={() => (hover.value = null)}
      onContextMenu={(event) => event.preventDefault()}
      onWheel={(event) => {
        event.preventDefault();
        if (frozen.value === 0 && !drawing) gestures.wheel(event);
      }}
    >
      <Overlays />
      <canvas ref={overlay} class="cursor-overlay" aria-hidden="true" />
    </div>
  );
}
