/**
 * What all tools share: the view's pixels and the strokes under way. One stroke after the other is
 * committed, but the next may be drawn meanwhile.
 */

import { signal } from "@preact/signals";

import { blobUrl, pixelsOf } from "../net/blobs";
import {
  brush,
  camera,
  limits,
  maskedLayer,
  method,
  pendingStrokes,
  readOnly,
  selectedLayer,
  spreading,
  state,
  status,
  swapped,
  toast,
  tool,
} from "../state/store";
import { painting } from "../state/pending-layers";
import { storageAnswered } from "../state/storage";
import { giveUpWaiting, isShown, projectIsBack } from "../state/waiting";
import { link, report, run, track, viewer } from "../state/studio";
import { CommandError } from "../net/connection";
import type { LayerInfo } from "../messages";
import { rewindowed, sameView, type CameraJson } from "../view/camera";
import type { Pixels } from "./flood";
import { limitsToSend } from "./limits";
import { selection, selectionSent } from "./selection";
import { Stroke, type StrokeTarget } from "./stroke";
import { mirrorOfStroke } from "./symmetry";

/** Tools whose paint can go on over the material that it lies on. */
export const SPREADING_TOOLS: readonly string[] = ["brush", "line", "fill"];
/** Above 0 while the camera must stay: a stroke still reads the view. */
export const frozen = signal(0);
/** Where clone and heal read from, in view pixels, and the stroke's offset once it began. */
export const cloneFrom = signal<{ x: number; y: number; offset: [number, number] | null } | null>(null);

export const overlayCanvas = document.createElement("canvas");
const overlay = overlayCanvas.getContext("2d", { willReadFrequently: true })!;
const active = new Set<Stroke>();
/** The commit that runs last; strokes wait for it before they read the view. */
let lastCommit: Promise<void> = Promise.resolve();
let cached: { camera: CameraJson; revision: number; pixels: Promise<ImageData> } | null = null;
let original: { camera: CameraJson; below: string | null; pixels: Promise<Pixels> } | null = null;

/** The view as it is seen now, 8 bit. Drawn anew only when something changed. */
export function viewPixels(): Promise<ImageData> {
  const now = camera.value!;
  if (!cached || cached.camera !== now || cached.revision !== viewer.revision) {
    cached = { camera: now, revision: viewer.revision, pixels: viewer.read() };
    cached.pixels.catch(() => (cached = null));
  }
  return cached.pixels;
}

/** The view of the original asset, or of what is below a layer, rendered by the server. */
export function originalPixels(below: string | null = null): Promise<Pixels> {
  const now = camera.value!;
  if (below !== null || original?.camera !== now || original.below !== below) {
    const pixels = run("view.render", { camera: now, which: "original", below }).then((answer) => {
      if (!answer) throw new Error("the original could not be rendered");
      return pixelsOf(blobUrl(answer.picture), now.width, now.height);
    });
    original = { camera: now, below, pixels };
    pixels.catch(() => (original = null));
  }
  return original.pixels;
}

/** The paint layer that strokes made while no paint layer was chosen: those that follow go there too. */
let firstOf: { chosen: string | null; session: string; layer: string } | null = null;

/** The chosen layer, if it takes strokes. */
export function chosenPaintLayer(): LayerInfo | null {
  const layer = state.value?.layers.find((one) => one.id === selectedLayer.value);
  return layer && layer.strokes !== null ? layer : null;
}

/** The chosen layer, if strokes back to the original can go on in it; from another view they make a new one. */
export function chosenEraser(): LayerInfo | null {
  const layer = state.value?.layers.find((one) => one.id === selectedLayer.value);
  const fits = layer?.kind === "erase" && layer.visible && layer.opacity === brush.value.opacity;
  return fits ? layer : null;
}

/** The layer whose mask is being painted, while it is the chosen one. */
export function chosenMask(): LayerInfo | null {
  const layer = state.value?.layers.find((one) => one.id === maskedLayer.value);
  return layer?.mask && layer.id === selectedLayer.value ? layer : null;
}

/** Where a stroke that begins now will go: into the chosen paint layer, else into a new one. */
function paintTarget(): () => StrokeTarget {
  const chosen = chosenPaintLayer();
  if (chosen) return () => ({ layer: chosen.id });
  const [before, session] = [selectedLayer.value, state.value!.session];
  return () => {
    const first = firstOf;
    const there = first && state.value?.layers.some((one) => one.id === first.layer);
    if (there && first.session === session && first.chosen === before) return { layer: first.layer };
    return { into_new: unused("Paint") };
  };
}

/**
 * Begin a stroke on the present view; null (with a toast) when nothing can be painted. `given`: what it becomes; by
 * default it goes into the chosen paint layer, or becomes a layer of its own that spreads.
 */
export function beginStroke(
  kind: "paint" | "clone" | "erase" | "mask",
  name: string,
  opacity = brush.value.opacity,
  given?: StrokeTarget,
): Stroke | null {
  const spreads = !given && kind === "paint" && spreading.value.on && SPREADING_TOOLS.includes(tool.value);
  const target = spreads ? { spread: spreading.value.threshold } : given;
  const now = camera.value;
  if (!now || viewer.count === 0) return null;
  if (swapped.value) {
    toast("warning", "Painting waits for your answer above.", `Go back to ${swapped.value.name}, or stay here.`);
    return null;
  }
  if (readOnly.value) {
    toast(
      "warning",
      "This project is open elsewhere and is read-only here.",
      "Close it there, or save a copy under another name.",
    );
    return null;
  }
  const chosen = chosenPaintLayer();
  if (!target && chosen && (!chosen.visible || chosen.opacity === 0)) {
    toast("warning", `${chosen.name} is hidden.`, "Show it, or choose another layer to paint into.");
    return null;
  }
  const single = target !== undefined;
  const [before, session, home] = [selectedLayer.value, state.value!.session, state.value!.project.id];
  fitOverlay(now);
  const base = asSeen();
  const stroke = new Stroke({
    link,
    camera: now,
    overlay,
    base,
    after: Promise.all([lastCommit, selectionSent()]).then(() => {}),
    onScreen: () => camera.value !== null && sameView(camera.value, now),
    kind,
    layer: kind === "erase" && !single ? (chosen?.id ?? null) : null,
    name: single && !target.replaces && !target.layer ? unused(name) : name,
    project: home,
    isHome: () => status.value !== "open" || isShown(home),
    newestStep,
    target: single ? () => target : paintTarget(),
    commit: async (fields) => {
      const { layer: id, into_new, replaces } = fields;
      const goal = id ?? replaces;
      const there = state.value?.layers.find((one) => one.id === goal)?.name ?? into_new;
      if (goal) painting.value = [...painting.value, goal];
      try {
        const { layer } = await track("paint.end", fields, there ? `${name} in ${there}` : fields.name!);
        if (into_new) firstOf = { chosen: before, session, layer: layer.id };
        return layer;
      } finally {
        if (goal) painting.value = painting.value.filter((_, k) => k !== painting.value.indexOf(goal));
      }
    },
    method: method.value,
    limits: limitsToSend(limits.value),
    opacity,
    mirror: target?.placed ? null : mirrorOfStroke(kind, name),
    selection: selection.value,
  });
  frozen.value++;
  stroke.ready.catch(() => {}).finally(() => frozen.value--);
  active.add(stroke);
  pendingStrokes.value = active.size;
  return stroke;
}

/** Pen up: commit and show what it did. The overlay stays until the new Gaussians are on the screen. */
export function endStroke(stroke: Stroke, finish: (stroke: Stroke) => void = () => {}): Promise<void> {
  const before = lastCommit;
  lastCommit = (async () => {
    await before;
    try {
      await stroke.ready;
      if (!stroke.withdrawn) finish(stroke);
      const layer = await committed(stroke);
      if (layer) selectedLayer.value = layer.id;
      await viewer.settle();
    } catch (error) {
      if (!stroke.withdrawn) {
        report(error, stroke.name);
        await stroke.cancel();
      }
    } finally {
      forget(stroke);
      warmUp();
    }
  })();
  return lastCommit;
}

/** The stroke's layer; null where there is nothing of it. Where its project is away it waits for it. */
async function committed(stroke: Stroke): Promise<LayerInfo | null> {
  for (;;) {
    if (stroke.withdrawn) return null;
    try {
      return await stroke.end();
    } catch (error) {
      const { project, committing } = stroke;
      if (error instanceof CommandError && error.kind === "storage" && !stroke.withdrawn) {
        stroke.committing = null; // nothing of it was saved
        report(error, stroke.name);
        if (!(await storageAnswered())) {
          await stroke.cancel();
          return null;
        }
        stroke.again();
        continue;
      }
      const away = error instanceof CommandError && error.kind === "lost";
      if (stroke.withdrawn || !(away || state.value?.project.id !== project)) throw error;
      if (!(await projectIsBack(project))) {
        await stroke.cancel();
        return null;
      }
      if (committing !== null && wasCommitted(stroke.name, committing)) return null;
      stroke.again();
    }
  }
}

/** Number of the step in effect. */
const newestStep = (): number => state.value?.history[state.value.cursor]?.id ?? 0;

/** Whether a step of that name came after `newest` and is in effect: the stroke was saved, only its answer is lost. */
function wasCommitted(name: string, newest: number): boolean {
  const { history, cursor } = state.value!;
  return history.slice(0, cursor + 1).some((step) => step.id > newest && step.label.includes(name));
}

/** Resolves when every stroke that was drawn is a layer, or is given up. */
export const strokesCommitted = (): Promise<void> => lastCommit;

/** Take back the newest stroke that is not being saved yet; false: there is none. */
export function takeBackPending(): boolean {
  const newest = [...active].filter((one) => one.committing === null && !one.withdrawn).at(-1);
  if (newest) void cancelStroke(newest);
  return newest !== undefined;
}

/** Stay in the project that is shown: what waits for another one goes. */
export function stayHere(): void {
  const count = active.size;
  giveUpWaiting();
  swapped.value = null;
  if (count > 0) toast("info", count === 1 ? "One stroke was given up." : `${count} strokes were given up.`);
}

export async function cancelStroke(stroke: Stroke): Promise<void> {
  const told = stroke.cancel();
  forget(stroke);
  await told;
}

let seen: CameraJson | null = null;

/** Another camera: what lies on the old view goes. The source of clone and heal stays where only the window changed. */
export function viewMoved(): void {
  const now = camera.value;
  if (now) fitOverlay(now);
  overlay.clearRect(0, 0, overlayCanvas.width, overlayCanvas.height);
  for (const stroke of active) stroke.paint(); // back on their view, those that wait are seen again
  const same = seen && now && rewindowed(seen, now);
  seen = now;
  const from = cloneFrom.value;
  if (!from) return;
  if (!same) return void (cloneFrom.value = null);
  const [x, y] = same.at(from.x, from.y);
  const offset: [number, number] | null = from.offset && [from.offset[0] * same.scale, from.offset[1] * same.scale];
  cloneFrom.value = { x, y, offset };
}

/** Read the view before a stroke needs it. */
export function warmUp(): void {
  if (camera.value && viewer.count > 0 && active.size === 0) void viewPixels().catch(() => {});
}

/** The view with the strokes that lie over it. */
async function asSeen(): Promise<ImageData> {
  const painted = overlay.getImageData(0, 0, overlayCanvas.width, overlayCanvas.height).data;
  const pixels = await viewPixels();
  if (active.size < 2) return pixels;
  const data = new Uint8ClampedArray(pixels.data);
  for (let at = 0; at < data.length; at += 4) {
    const alpha = painted[at + 3] / 255;
    if (alpha > 0) for (let c = 0; c < 3; c++) data[at + c] = painted[at + c] * alpha + data[at + c] * (1 - alpha);
  }
  return new ImageData(data, pixels.width, pixels.height);
}

/** A name that no layer and no stroke under way has: conflicts and the history speak of layers by name. */
function unused(name: string): string {
  const taken = new Set([
    ...(state.value?.layers ?? []).map((layer) => layer.name),
    ...[...active].map((one) => one.name),
  ]);
  for (let k = 1; ; k++) {
    const next = k === 1 ? name : `${name} ${k}`;
    if (!taken.has(next)) return next;
  }
}

function fitOverlay(now: CameraJson): void {
  if (overlayCanvas.width !== now.width) overlayCanvas.width = now.width;
  if (overlayCanvas.height !== now.height) overlayCanvas.height = now.height;
}

function forget(stroke: Stroke): void {
  active.delete(stroke);
  stroke.erase();
  pendingStrokes.value = active.size;
  overlay.clearRect(0, 0, overlayCanvas.width, overlayCanvas.height);
  for (const other of active) other.paint();
}
