/**
 * The selection, which belongs to the view on which it was drawn. When the camera moves it limits nothing any more, but
 * is kept with its view: it comes back there, and a global look goes on to use it from anywhere.
 */

import { computed, signal } from "@preact/signals";

import { camera, pose, state } from "../state/store";
import { sameView, type CameraJson, type Pose } from "../view/camera";
import type { Mask } from "./raster";

interface Area {
  mask: Mask;
  camera: CameraJson;
}

/** Limits painting on the present view; null: none. */
export const selection = signal<Mask | null>(null);
/** A selection of another view. */
export const storedArea = signal<(Area & { pose: Pose }) | null>(null);
/** What is selected, with its view. */
export const selectedArea = computed<Area | null>(() =>
  selection.value && camera.value ? { mask: selection.value, camera: camera.value } : storedArea.value,
);

let last: { camera: CameraJson; pose: Pose } | null = null;

selection.subscribe((mask) => mask && (storedArea.value = null)); // a new one replaces it
computed(() => state.value?.session).subscribe(deselect); // it was drawn on another asset

export function deselect(): void {
  selection.value = storedArea.value = null;
}

/** The camera moved: put the selection aside, or bring it back. */
export function viewMoved(): void {
  const [now, at] = [camera.value, pose.value];
  const before = last;
  last = now && at && { camera: now, pose: at };
  if (!now || (before && sameFrame(before.camera, now))) return;
  if (selection.value) {
    storedArea.value = before && { mask: selection.value, ...before };
    selection.value = null;
  } else if (storedArea.value && sameFrame(storedArea.value.camera, now)) selection.value = storedArea.value.mask;
}

/** The same pixels see the same places, whatever the background is. */
const sameFrame = (a: CameraJson, b: CameraJson): boolean => sameView({ ...a, background: b.background }, b);
