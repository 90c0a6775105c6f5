/** Pictures that came from elsewhere and wait to become an edit: at most four views. */

import { computed, signal } from "@preact/signals";

import type { PictureChecked } from "../messages";
import { blobUrl, sendBlob } from "../net/blobs";
import { CommandError } from "../net/link";
import { maskPng } from "../paint/picture";
import { selectedArea } from "../paint/selection";
import { sameSight, type CameraJson } from "../view/camera";
import { camera, selectedLayer, state, tab, toast } from "./store";
import { link, remember, report, run, watched } from "./studio";

export const MOST = 4;

export interface Drop {
  id: number;
  name: string;
  /** The picture as it came. */
  blob: string;
  checked: PictureChecked | null;
  /** Why it could not be used as it is. */
  problem: string;
  threshold: number | null;
}

export const drops = signal<Drop[]>([]);
export const dropMode = signal<"local" | "global">("local");
/** Of global edits: only what is selected on one of the views. */
export const dropWithin = signal(false);
/** The picture on whose view something is selected. */
export const selectedDrop = computed(
  () =>
    drops.value.find(
      ({ checked }) =>
        checked && selectedArea.value && sameSight(checked.camera as CameraJson, selectedArea.value.camera),
    ) ?? null,
);
let nextId = 1;

computed(() => state.value?.session).subscribe(() => (drops.value = [])); // they were pictures of another asset
watched.onPicture = (blob, name) => void add(blob, name);

/** A picture that was dropped or chosen. */
export async function addPicture(file: File): Promise<void> {
  try {
    await add(await sendBlob(file, file.name), file.name);
  } catch (error) {
    report(error);
  }
}

async function add(blob: string, name: string): Promise<void> {
  tab.value = "pictures";
  const again = drops.value.find((one) => one.name === name); // saved over: the newer one counts
  if (!again && drops.value.length >= MOST)
    return toast("warning", `One edit takes at most ${MOST} pictures.`, "Apply these or take one away.");
  const drop: Drop = { id: again?.id ?? nextId++, name, blob, checked: null, problem: "", threshold: null };
  drops.value = again ? drops.value.map((one) => (one.id === again.id ? drop : one)) : [...drops.value, drop];
  await check(drop.id, {});
}

/** Find the camera, mend the size, find what changed. `at`: the picture shows this view. */
export async function check(id: number, given: { camera?: CameraJson; threshold?: number }): Promise<void> {
  const drop = drops.value.find((one) => one.id === id);
  if (!drop) return;
  const threshold = given.threshold ?? drop.threshold;
  const at =
    given.camera ?? (drop.checked?.camera_source === "given" ? (drop.checked.camera as CameraJson) : undefined);
  try {
    const checked = await link.do("picture.check", {
      picture: drop.blob,
      name: drop.name,
      camera: at ?? null,
      threshold,
    });
    update(id, { checked, problem: "", threshold });
  } catch (error) {
    if (!(error instanceof CommandError)) throw error;
    update(id, { checked: null, problem: [error.message, error.hint].filter(Boolean).join(". ") });
  }
}

export const isPresentView = (id: number): Promise<void> =>
  camera.value ? check(id, { camera: camera.value }) : Promise.resolve();

export function discard(id: number): void {
  drops.value = drops.value.filter((one) => one.id !== id);
}

export const maskUrl = (drop: Drop): string | null => drop.checked && blobUrl(drop.checked.mask);

/** One layer from all pictures that have a camera. */
export async function applyDrops(method: "auto" | "ttt" | "lift" | "fit"): Promise<void> {
  const ready = drops.value.filter((one) => one.checked);
  const mode = dropMode.value;
  const within = mode === "global" && dropWithin.value ? selectedDrop.value : null;
  const selected = within && (await sendBlob(await maskPng(selectedArea.value!.mask), "mask.png"));
  const views = ready.map((one) => ({
    camera: one.checked!.camera,
    picture: one.checked!.picture,
    mask: mode === "local" ? one.checked!.mask : one === within ? selected : null,
  }));
  const name = ready
    .map((one) => one.name.replace(/\.[^.]*$/, ""))
    .join(", ")
    .slice(0, 200);
  const answer = await run(
    "edit",
    { views, kind: "picture", mode, method, name, within: within !== null },
    "Lifting the picture onto the asset",
  );
  if (!answer) return;
  drops.value = drops.value.filter((one) => !ready.includes(one));
  remember(answer.layer);
  selectedLayer.value = answer.layer.id;
}

function update(id: number, part: Partial<Drop>): void {
  drops.value = drops.value.map((one) => (one.id === id ? { ...one, ...part } : one));
}
