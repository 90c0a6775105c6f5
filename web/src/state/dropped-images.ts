/** Pictures that came from elsewhere and wait to become an edit: at most four views. */

import { computed, signal } from "@preact/signals";

import type { PictureChecked } from "../messages";
import { blobUrl, sendBlob } from "../net/blobs";
import { CommandError } from "../net/connection";
import { limitsToSend } from "../paint/limits";
import { type CameraJson } from "../view/camera";
import { camera, limits, type Method, selectedLayer, state, tab, toast } from "./store";
import { editor, report, run } from "../editor/editor";

export const MAX_IMAGES = 4;

export interface DroppedImage {
  id: number;
  name: string;
  /** The picture as it came. */
  blob: string;
  checked: PictureChecked | null;
  /** Why it could not be used as it is. */
  problem: string;
  threshold: number | null;
}

export const droppedImages = signal<DroppedImage[]>([]);
export const editMode = signal<"local" | "global" | "spread">("local");
let nextId = 1;

computed(() => state.value?.session).subscribe(() => (droppedImages.value = [])); // they were pictures of another asset
editor.onPicture = (blob, name) => void add(blob, name);

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
  const again = droppedImages.value.find((one) => one.name === name); // saved over: the newer one counts
  if (!again && droppedImages.value.length >= MAX_IMAGES)
    return toast("warning", `One edit takes at most ${MAX_IMAGES} pictures.`, "Apply these or remove one.");
  const image: DroppedImage = { id: again?.id ?? nextId++, name, blob, checked: null, problem: "", threshold: null };
  droppedImages.value = again
    ? droppedImages.value.map((one) => (one.id === again.id ? image : one))
    : [...droppedImages.value, image];
  await check(image.id);
}

/** A picture that the server made of a view, and checked already. */
export function addChecked(name: string, checked: PictureChecked): void {
  tab.value = "pictures";
  if (droppedImages.value.length >= MAX_IMAGES)
    return toast("warning", `One edit takes at most ${MAX_IMAGES} pictures.`, "Apply these or remove one.");
  const image = { id: nextId++, name, blob: checked.picture, checked, problem: "", threshold: null };
  droppedImages.value = [...droppedImages.value, image];
}

/** How far a pixel must differ to count as changed; `check` goes by it. */
export const setThreshold = (id: number, threshold: number): void => update(id, { threshold });

/** Find the camera, correct the size, find what changed. `camera`: the picture shows this view. */
export async function check(id: number, given: { camera?: CameraJson } = {}): Promise<void> {
  const image = imageOf(id);
  if (!image) return;
  const { threshold } = image;
  /** Not of a picture that was saved over, or of a threshold before. */
  const isPresent = () => imageOf(id)?.blob === image.blob && imageOf(id)?.threshold === threshold;
  const at =
    given.camera ?? (image.checked?.camera_source === "given" ? (image.checked.camera as CameraJson) : undefined);
  try {
    const checked = await editor.link.do("picture.check", {
      picture: image.blob,
      name: image.name,
      camera: at ?? null,
      threshold,
    });
    if (isPresent()) update(id, { checked, problem: "" });
  } catch (error) {
    if (!(error instanceof CommandError)) throw error;
    if (isPresent()) update(id, { checked: null, problem: [error.message, error.hint].filter(Boolean).join(". ") });
  }
}

export const isPresentView = (id: number): Promise<void> =>
  camera.value ? check(id, { camera: camera.value }) : Promise.resolve();

export function discard(id: number): void {
  droppedImages.value = droppedImages.value.filter((one) => one.id !== id);
}

export const maskUrl = (image: DroppedImage): string | null => image.checked && blobUrl(image.checked.mask);

/** One layer from all pictures that have a camera. */
export async function applyImages(method: Method): Promise<void> {
  const ready = droppedImages.value.filter((one) => one.checked);
  const mode = editMode.value;
  const views = ready.map((one) => ({
    camera: one.checked!.camera,
    picture: one.checked!.picture,
    mask: mode !== "global" ? one.checked!.mask : null,
  }));
  const name = ready
    .map((one) => one.name.replace(/\.[^.]*$/, ""))
    .join(", ")
    .slice(0, 200);
  const answer = await run(
    "edit",
    {
      views,
      kind: "picture",
      mode,
      method,
      name,
      limits: mode !== "global" ? limitsToSend(limits.value) : {},
    },
    "Lifting the picture onto the asset",
  );
  if (!answer) return;
  droppedImages.value = droppedImages.value.filter((one) => !ready.includes(one));
  selectedLayer.value = answer.layer.id;
}

const imageOf = (id: number): DroppedImage | undefined => droppedImages.value.find((one) => one.id === id);

function update(id: number, part: Partial<DroppedImage>): void {
  droppedImages.value = droppedImages.value.map((one) => (one.id === id ? { ...one, ...part } : one));
}
