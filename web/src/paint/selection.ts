/**
 * What is selected. The server keeps it, on the asset's Gaussians and the same for all windows; here is what of the
 * present view that is, fetched anew when the view or the selection has changed. It limits every tool on the server;
 * here it is shown, and strokes are drawn as they will be.
 */

import { computed, effect, signal } from "@preact/signals";

import type { SelectChange } from "../messages";
import { blobUrl, pixelsOf, sendBlob } from "../net/blobs";
import { camera, readOnly, selectedLayer, state, toast } from "../state/store";
import { link, report, run } from "../state/studio";
import { sameView, type CameraJson, type Vec3 } from "../view/camera";
import { maskPng } from "./picture";
import type { Mask } from "./raster";
import { combine, isEmpty, type Combine } from "./selection-masks";

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

const REST_MS = 120;
/** What was sent and has no answer yet: strokes wait for it. */
let sending: Promise<unknown> = Promise.resolve();
let waiting = 0;
let newestRequest = 0;

/** Resolves when the server knows the selection that is seen here. */
export const selectionSent = (): Promise<void> => sending.then(() => {});

/** Act on what is selected, once that is known: a key right after a lasso means the lasso. */
export async function withSelection(act: (selected: number) => unknown): Promise<void> {
  if (waiting > 0) await selectionSent();
  await act(selectedCount.value);
}

/** Apply a mask that was drawn on the present view. It is shown at once. */
export function selectArea(mask: Mask, how: Combine, through: boolean): void {
  const now = camera.value;
  if (!now || !state.value) return;
  const next = combine(selection.value, mask, how);
  if (isEmpty(mask) && how !== "replace") return;
  if (isEmpty(next)) return void changeSelection("none");
  selection.value = next;
  newestRequest++; // what was fetched before is out of date
  void sent(async () => {
    const blob = await sendBlob(await maskPng(mask), "selection.png");
    await run("selection.area", { camera: now, mask: blob, how, through }, "Selecting");
  });
}

/** Everything, nothing, the rest and so on. `radius`: world units. */
export function changeSelection(to: SelectChange["to"], radius = 0, share?: number): void {
  if (!state.value) return;
  if (to === "none") selection.value = null;
  void sent(() => run("selection.change", { to, radius, ...(share === undefined ? {} : { share }) }, "Selecting"));
}

export const deselect = (): void => changeSelection("none");

/** Hide what is selected, or all the rest, by a layer. */
export async function hideSelected(rest: boolean, name: string): Promise<void> {
  if (readOnly.value) return;
  const answer = await sent(() => run("selection.hide", { name, rest }, rest ? "Cropping" : "Hiding"));
  if (answer) selectedLayer.value = answer.layer.id;
}

/** Fill a hole that is circled, or what is left where the body of what is selected, or just that, is hidden. */
export async function fillSelected(remove: boolean): Promise<void> {
  if (readOnly.value || selectedCount.value === 0) return;
  const fields = { remove, body: removesBody.value };
  const answer = await sent(() => run("fill.selection", fields, remove ? "Removing and filling" : "Filling"));
  if (!answer) return;
  selectedLayer.value = answer.layer.id;
  if (answer.note) toast("info", answer.note);
}

/** Run what changes the selection, one after the other. */
export function sent<T>(work: () => Promise<T>): Promise<T> {
  const result = sending.then(work);
  waiting++;
  sending = result.catch(() => {}).finally(() => waiting--);
  return result;
}

/** Fetch what is selected of the present view. */
async function refresh(): Promise<void> {
  const [now, number] = [camera.value, ++newestRequest];
  if (!now || !state.value) return;
  if (selectedCount.value === 0) return void (selection.value = null);
  try {
    const answer = await link.do("selection.view", { camera: now });
    const mask = answer.mask && (await pixelsOf(blobUrl(answer.mask), now.width, now.height));
    if (number !== newestRequest || camera.value !== now) return;
    if (!mask) return void (selection.value = null);
    const data = new Float32Array(now.width * now.height);
    for (let k = 0; k < data.length; k++) data[k] = mask.data[k * 4] / 255;
    selection.value = { width: now.width, height: now.height, data };
    faintPoints.value = answer.points;
  } catch (error) {
    report(error);
  }
}

let timer: ReturnType<typeof setTimeout> | undefined;
let seen: { camera: CameraJson | null; revision: number; session: string } = { camera: null, revision: 0, session: "" };

/** The camera moved, or the selection may have changed. */
function look(): void {
  const [now, present] = [camera.value, state.value];
  if (!now || !present) return;
  const { revision } = present.selection;
  const moved = !seen.camera || !sameFrame(seen.camera, now);
  const changed = revision !== seen.revision || present.session !== seen.session;
  seen = { camera: now, revision, session: present.session };
  if (!moved && !changed) return;
  if (present.selection.gaussians === 0) {
    newestRequest++;
    selection.value = null;
    return;
  }
  if (moved) selection.value = null;
  clearTimeout(timer);
  timer = setTimeout(() => waiting === 0 && void refresh(), moved ? REST_MS : 0);
  if (waiting > 0) void selectionSent().then(refresh);
}

/** The same pixels see the same places, whatever the background is. */
const sameFrame = (a: CameraJson, b: CameraJson): boolean => sameView({ ...a, background: b.background }, b);

effect(look);
selection.subscribe(() => (faintPoints.value = []));
computed(() => state.value?.session).subscribe(() => (cropBox.value = null));
