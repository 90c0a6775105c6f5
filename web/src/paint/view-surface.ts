/** What is known of the surface of the present view, and what wants to know it. */

import { effect, signal } from "@preact/signals";

import { sameView, type CameraJson } from "../view/camera";
import { engine } from "./brush-settings";
import { SurfaceView } from "./surface-blocks";

/** Of the present view, or of the one before until its answer is there; null: not needed so far. */
export const viewSurface = signal<SurfaceView | null>(null);
/** Whether texts and pictures are laid on the surface, and by how many degrees that may turn away; 180: no limit. */
export const wrapping = signal({ on: true, limit: 180 });
/** Whether the mirrored brush is shown. */
export const mirroring = signal(false);

/** Whether brushes are laid on the surface, or mirrored by it, so that their tools need to know it. */
export const brushNeedsSurface = (): boolean => {
  const { unit, follow } = engine.value;
  return unit === "world" || follow || mirroring.value;
};

/** What is known of the surface of exactly this view. */
export const surfaceOf = (view: CameraJson | null): SurfaceView | null =>
  view && viewSurface.value && isSameView(viewSurface.value.camera, view) ? viewSurface.value : null;
/** The same view comes back as another object when one goes away and returns. */
export const isSameView = (one: CameraJson, other: CameraJson): boolean => one === other || sameView(one, other);

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
