/** The view with everything that lies over it, and the pointers on it. */

import { useEffect, useRef } from "preact/hooks";

import { refresh } from "../editor/camera-moves";
import { editor } from "../editor/editor";
import { placement } from "../paint/placement";
import { camera, moving, pose, view } from "../state/store";
import { inHand } from "../tools";
import { gestures, hover, penInput, spaceHeld } from "../tools/pen-input";
import { drawOverlay } from "./overlay";
import { Overlays } from "./server-renders";

/** The camera rests so long before the view is read for the next stroke. */
const REST_MS = 350;

export function Stage({ canvas }: { canvas: HTMLCanvasElement }) {
  const box = useRef<HTMLDivElement>(null);
  const overlay = useRef<HTMLCanvasElement>(null);

  useEffect(() => {
    const { overlayCanvas } = editor.strokes;
    box.current!.prepend(canvas);
    canvas.after(overlayCanvas);
    canvas.className = "view";
    overlayCanvas.className = "overlay";
    return follow(box.current!, overlay.current!);
  }, [canvas]);

  const cursor = spaceHeld.value || inHand().cursor() === "hand" ? "grab" : placement.value ? "move" : "none";
  return (
    <div
      ref={box}
      class="stage"
      id="stage"
      tabIndex={0}
      role="application"
      aria-label="View of the asset: drag to use the tool, hold Space or Alt and drag to turn the asset, arrow keys turn it"
      style={{ cursor }}
      onPointerDown={(event) => penInput.down(event, event.currentTarget)}
      onPointerMove={(event) => penInput.move(event, event.currentTarget)}
      onPointerUp={(event) => penInput.up(event, event.currentTarget)}
      onPointerCancel={(event) => penInput.up(event, event.currentTarget)}
      onPointerLeave={() => (hover.value = null)}
      onContextMenu={(event) => event.preventDefault()}
      onWheel={(event) => {
        event.preventDefault();
        if (penInput.cameraFree) gestures.wheel(event);
      }}
    >
      <Overlays />
      <canvas ref={overlay} class="cursor-overlay" aria-hidden="true" />
    </div>
  );
}

/** Keep the canvases at the window's size, and what lies over the view up to date, until the returned function is called. */
function follow(box: HTMLElement, overlay: HTMLCanvasElement): () => void {
  const ratio = () => ((camera.value?.width ?? 1) > 0 ? overlay.width / (camera.value?.width ?? 1) : 1);
  const size = new ResizeObserver(() => {
    const dpr = window.devicePixelRatio || 1;
    overlay.width = Math.round(box.clientWidth * dpr);
    overlay.height = Math.round(box.clientHeight * dpr);
    refresh();
  });
  size.observe(box);
  // another screen, or the browser's zoom: other pixels in the same place
  let screen: MediaQueryList | null = null;
  const otherScreen = () => {
    screen?.removeEventListener("change", otherScreen);
    screen = matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`);
    screen.addEventListener("change", otherScreen);
    if (pose.value) refresh();
  };
  otherScreen();
  const stopOverlay = drawOverlay(overlay, ratio);
  const stopView = view.subscribe(() => refresh());
  let timer: ReturnType<typeof setTimeout>;
  const stopCamera = camera.subscribe(() => {
    penInput.viewMoved();
    editor.strokes.viewMoved();
    moving.value = true;
    clearTimeout(timer);
    timer = setTimeout(() => {
      moving.value = false;
      if (inHand().gesture) editor.strokes.warmUp();
    }, REST_MS);
  });
  return () => {
    size.disconnect();
    screen?.removeEventListener("change", otherScreen);
    stopOverlay();
    stopView();
    stopCamera();
  };
}
