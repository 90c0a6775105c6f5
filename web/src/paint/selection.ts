/** Changing the selection, and fetching what of it the present view shows when that, or the selection, has changed. */

import { effect } from "@preact/signals";

import { editor, report, run } from "../editor/editor";
import type { PixelateOptions, SelectChange } from "../messages";
import { blobUrl, pixelsOf, sendBlob } from "../net/blobs";
import { camera, readOnly, selectedLayer, state, toast } from "../state/store";
import { sameView, type CameraJson } from "../view/camera";
import { maskPng } from "./picture";
import type { Mask } from "./raster";
import {
  faintPoints,
  removesBody,
  selectedCount,
  selection,
  selectionSent,
  selectionWaits,
  sent,
  wholeIsSelected,
} from "./selected";
import { combine, isEmpty, type Combine } from "./selection-masks";

/** The camera rests so long before what it shows of the selection is fetched. */
const REST_MS = 120;

/** Changes after which it is the same thing that is selected. */
const EDGES: readonly SelectChange["to"][] = ["grow", "shrink", "feather"];

/** Act on what is selected, once that is known: a key right after a lasso means the lasso. */
export async function withSelection(act: (selected: number) => unknown): Promise<void> {
  if (selectionWaits()) await selectionSent();
  await act(selectedCount.value);
}

/** Apply a mask that was drawn on the present view. It is shown at once. */
export function selectArea(mask: Mask, how: Combine, through: boolean): void {
  const now = camera.value;
  if (!now || !state.value) return;
  const next = combine(selection.value, mask, how);
  if (isEmpty(mask) && how !== "replace") return;
  if (isEmpty(next)) return void changeSelection("none");
  if (how === "replace") wholeIsSelected.value = false;
  selection.value = next;
  shown.dropRequests(); // what was fetched before is out of date
  void sent(async () => {
    const blob = await sendBlob(await maskPng(mask), "selection.png");
    await run("selection.area", { camera: now, mask: blob, how, through }, "Selecting");
  });
}

/** Everything, nothing, the rest and so on. `radius`: world units. */
export function changeSelection(to: SelectChange["to"], radius = 0, share?: number): void {
  if (!state.value) return;
  if (to === "none") selection.value = null;
  if (!EDGES.includes(to)) wholeIsSelected.value = false;
  void sent(() => run("selection.change", { to, radius, ...(share === undefined ? {} : { share }) }, "Selecting"));
}

/** Select the whole thing that something is selected of: tinted, it is to be added to and taken from before it goes. */
export async function selectWhole(): Promise<void> {
  const answer = await sent(() => run("selection.change", { to: "body" }, "Looking for the whole thing"));
  if (!answer) return;
  wholeIsSelected.value = true;
  if (answer.note) toast("info", answer.note);
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
  const fields = { remove, body: removesBody.value && !wholeIsSelected.value };
  const answer = await sent(() => run("fill.selection", fields, remove ? "Removing and filling" : "Filling"));
  if (!answer) return;
  selectedLayer.value = answer.layer.id;
  if (answer.note) toast("info", answer.note);
}

/** Make what is selected unreadable from all sides, by a layer. size: edge of a cell, per cent of the asset's diameter. */
export async function pixelateSelected(size: number, options: Pick<PixelateOptions, "style" | "merge">): Promise<void> {
  if (readOnly.value || selectedCount.value === 0) return;
  const operation: PixelateOptions = { kind: "pixelate", size: `${Number(size.toPrecision(3))}%`, ...options };
  const answer = await sent(() => run("layer.add", { operation, name: "Pixelate" }, "Pixelating"));
  if (answer) selectedLayer.value = answer.layer.id;
}

/** Keeps `selection` what the present view shows of it. */
class ShownSelection {
  private newestRequest = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private seen = { camera: null as CameraJson | null, revision: 0, session: "" };

  /** Answers that are on their way count no more. */
  dropRequests(): void {
    this.newestRequest++;
  }

  /** The camera moved, or the selection may have changed. */
  look(): void {
    const [now, present] = [camera.value, state.value];
    if (!now || !present) return;
    const { revision } = present.selection;
    const { seen } = this;
    const moved = !seen.camera || !sameFrame(seen.camera, now);
    const changed = revision !== seen.revision || present.session !== seen.session;
    this.seen = { camera: now, revision, session: present.session };
    if (!moved && !changed) return;
    if (present.selection.gaussians === 0) {
      this.dropRequests();
      selection.value = null;
      wholeIsSelected.value = false;
      return;
    }
    if (moved) selection.value = null;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => selectionWaits() || void this.fetch(), moved ? REST_MS : 0);
    if (selectionWaits()) void selectionSent().then(() => this.fetch());
  }

  private async fetch(): Promise<void> {
    const [now, number] = [camera.value, ++this.newestRequest];
    if (!now || !state.value) return;
    if (selectedCount.value === 0) return void (selection.value = null);
    try {
      const answer = await editor.link.do("selection.view", { camera: now });
      const mask = answer.mask && (await pixelsOf(blobUrl(answer.mask), now.width, now.height));
      if (number !== this.newestRequest || camera.value !== now) return;
      if (!mask) return void (selection.value = null);
      const data = new Float32Array(now.width * now.height);
      for (let k = 0; k < data.length; k++) data[k] = mask.data[k * 4] / 255;
      selection.value = { width: now.width, height: now.height, data };
      faintPoints.value = answer.points;
    } catch (error) {
      report(error);
    }
  }
}

/** The same pixels see the same places, whatever the background is. */
const sameFrame = (a: CameraJson, b: CameraJson): boolean => sameView({ ...a, background: b.background }, b);

const shown = new ShownSelection();
effect(() => shown.look());
