/**
 * What is selected, as far as it is seen: the server keeps it, on the asset's Gaussians and the same for all windows. It
 * limits every tool there; here it is shown, and strokes are drawn as they will be.
 */

import { computed, signal } from "@preact/signals";

import { state } from "../state/store";
import type { Vec3 } from "../view/camera";
import type { Mask } from "./raster";

/** What of the present view is selected, 0..1; null: nothing is, or it is not known yet. */
export const selection = signal<Mask | null>(null);
/** x, y, x, y, ... view pixels of what is selected and too faint to be seen; they belong to `selection`. */
export const faintPoints = signal<number[]>([]);
export const selectedCount = computed(() => state.value?.selection.gaussians ?? 0);
/** Whether the selected area is tinted. */
export const tinted = signal(true);
/** A box along the world's axes that is being set; null: none. */
export const cropBox = signal<{ low: Vec3; high: Vec3 } | null>(null);
/** Whether *Remove and fill* takes the whole thing that is selected, or only what is. */
export const removesBody = signal(true);

/** The whole thing was asked for and is tinted: what is selected by now, more or less of it, is what goes. */
export const wholeIsSelected = signal(false);

selection.subscribe(() => (faintPoints.value = []));
computed(() => state.value?.session).subscribe(() => (cropBox.value = null));

/** What was sent and has no answer yet, one after the other: strokes wait for it. */
const sending = { last: Promise.resolve() as Promise<unknown>, count: 0 };

/** Resolves when the server knows the selection that is seen here. */
export const selectionSent = (): Promise<void> => sending.last.then(() => {});

/** Whether something that changes the selection has no answer yet. */
export const selectionWaits = (): boolean => sending.count > 0;

/** Run what changes the selection, one after the other. */
export function sent<T>(work: () => Promise<T>): Promise<T> {
  const result = sending.last.then(work);
  sending.count++;
  sending.last = result.catch(() => {}).finally(() => sending.count--);
  return result;
}
