/** The surface of the present view, asked of the server when a tool needs it. */

import { effect, signal } from "@preact/signals";

import { camera, state, tool } from "../state/store";
import { link } from "../state/studio";
import { sameView, type CameraJson } from "../view/camera";
import { engine } from "./brush-settings";
import { SurfaceView } from "./surface-blocks";

/** Of the present view, or of the one before until its answer is there; null: not needed so far. */
export const viewSurface = signal<SurfaceView | null>(null);
/** Whether texts and pictures are laid on the surface, and by how many degrees that may turn away; 180: no limit. */
export const wrapping = signal({ on: true, limit: 180 });
/** Whether the mirrored brush is shown. */
export const mirroring = signal(false);
const BRUSHES = ["brush", "erase", "line", "clone", "heal"];
const LAYING = ["text", "stamp"];
const REST_MS = 120;

/** What is known of the surface of exactly this view. */
export const surfaceOf = (view: CameraJson | null): SurfaceView | null =>
  view && viewSurface.value && same(viewSurface.value.camera, view) ? viewSurface.value : null;
/** The same view comes back as another object when one goes away and returns. */
const same = (one: CameraJson, other: CameraJson): boolean => one === other || sameView(one, other);

/** How long something that was to lie on the surface waits for it. */
const PATIENCE_MS = 5000;

/** Resolves when the surface of this view is there, or no longer awaited. */
export function surfaceArrived(view: CameraJson): Promise<void> {
  return new Promise((resolve) => {
    const end = () => (clearTimeout(timer), stop(), resolve());
    const timer = setTimeout(() => end(), PATIENCE_MS);
    const stop = effect(() => {
      if (surfaceOf(view)) queueMicrotask(() => end());
    });
  });
}

let requestedKey = "";

async function ask(view: CameraJson, key: string): Promise<void> {
  requestedKey = key;
  try {
    const { block, columns, rows, data } = await link.do("view.surface", { camera: view });
    if (!camera.value || !same(camera.value, view)) return;
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    viewSurface.value = new SurfaceView(view, block, columns, rows, new Float32Array(bytes.buffer));
  } catch {
    requestedKey = ""; // the tools go on without it; a lost connection is said elsewhere
  }
}

/** Start following the view. */
export function followSurface(): void {
  let timer: ReturnType<typeof setTimeout>;
  effect(() => {
    const [view, now] = [camera.value, state.value];
    const { unit, follow } = engine.value;
    const lays = LAYING.includes(tool.value) && wrapping.value.on;
    const brushes = BRUSHES.includes(tool.value) && (unit === "world" || follow || mirroring.value);
    const needed = lays || brushes;
    clearTimeout(timer);
    if (!view || !now || !needed) return;
    // paint changes what is seen, but hardly where the surface is: layers that hide or fill something do
    const hidden = now.layers
      .filter((layer) => ["hide", "fill"].includes(layer.kind))
      .map((layer) => `${layer.id}${layer.visible}`);
    const key = JSON.stringify([now.session, view, hidden]);
    if (key !== requestedKey) timer = setTimeout(() => void ask(view, key), REST_MS);
  });
}
