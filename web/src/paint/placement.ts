/** A picture or a text laid on the view or on the surface, to be moved, scaled and turned before it becomes a layer. */

import { effect, signal } from "@preact/signals";

import { camera, state, swapped } from "../state/store";
import { rewindowed, type CameraJson, type Vec3 } from "../view/camera";
import { DraftSteps } from "../state/draft-steps";
import { viewScale } from "./brush-settings";
import { anchorAt, anchorPixel, angleOf, decalHandles, type Anchor } from "./decal";
import { surfaceOf, viewSurface, wrapping } from "./view-surface";

export interface Placement {
  kind: "text" | "picture";
  image: ImageBitmap | HTMLCanvasElement;
  name: string;
  /** Middle, view pixels. */
  x: number;
  y: number;
  /** View pixels per pixel of the image. */
  scale: number;
  /** Radians, clockwise. */
  angle: number;
  /** Where it lies on the surface; x, y, scale and angle follow from it. null: on the view. */
  anchor?: Anchor | null;
  /** It stays on the view: it was lifted off one. */
  flat?: boolean;
  /** World units per pixel of the image that it shall have on the surface. */
  unit?: number;
}

export const placement = signal<Placement | null>(null);
/**
 * The layer whose text or sticker is being changed; it is hidden meanwhile. `strokes`: it holds strokes, which one
 * sticker replaces.
 */
export const editedLayer = signal<EditedLayer | null>(null);

interface EditedLayer {
  layer: string;
  /** Id of its project: layers of others have the same numbers. */
  project: string;
  name: string;
  gesture: string;
  strokes?: boolean;
}

/** The server shows a layer again that such a gesture hid, when the page is gone. */
export const heldGesture = (layer: string): string => `held ${layer} ${Date.now()}`;
/** It is being laid on the surface by the server. */
export const laying = signal(false);

/** Where it stands, without what it shows. */
export type Stand = Pick<Placement, "x" | "y" | "scale" | "angle" | "anchor" | "unit">;
export const standOf = ({ x, y, scale, angle, anchor, unit }: Placement): Stand => ({
  ...{ x, y, scale, angle, anchor, unit },
});
/** Its drags, for undo. */
export const placedSteps = new DraftSteps<Stand>();

/** The knob for turning stands this far above the box, pixels of the screen. */
const KNOB_PX = 28;

/** Up of the object, on which pictures stand. */
export const level = (): Vec3 | null => (state.value?.asset.up as Vec3 | undefined) ?? null;

/** Corners of the box (left upper, right upper, right lower, left lower) and the knob, in view pixels. */
export function handles(p: Placement): { corners: [number, number][]; knob: [number, number] } {
  if (p.anchor) return decalHandles(camera.value!, p.anchor, p.image.width, p.image.height, KNOB_PX * viewScale.value);
  const [w, h] = [(p.image.width * p.scale) / 2, (p.image.height * p.scale) / 2];
  const toView = (x: number, y: number): [number, number] => [
    p.x + x * Math.cos(p.angle) - y * Math.sin(p.angle),
    p.y + x * Math.sin(p.angle) + y * Math.cos(p.angle),
  ];
  return {
    corners: [toView(-w, -h), toView(w, -h), toView(w, h), toView(-w, h)],
    knob: toView(0, -h - KNOB_PX * viewScale.value),
  };
}

/** x, y, scale and angle of what lies on the surface, on the present view or another. */
export function fromAnchor(p: Placement, anchor: Anchor, now: CameraJson = camera.value!): Placement {
  const { x, y, depth } = anchorPixel(now, anchor);
  return {
    ...p,
    anchor,
    unit: anchor.unit,
    x,
    y,
    scale: (anchor.unit * now.fx) / Math.max(depth, 1e-9),
    angle: angleOf(now, anchor, level()),
  };
}

/** Reach over which the surface's direction is averaged under a picture, world units. */
export const evened = ({ image }: Placement, size: number): number => 0.35 * size * Math.min(image.width, image.height);

/** The same, laid on the surface under its middle where the view sees one. */
function laid(p: Placement): Placement {
  const view = surfaceOf(camera.value);
  const at = view?.at(p.x, p.y);
  if (!view || !at || p.flat) return p;
  const size = p.unit ?? (p.scale * at.point[2]) / view.camera.fx;
  const anchor = anchorAt(view, p.x, p.y, p.angle, size, level(), evened(p, size));
  return anchor ? { ...p, anchor, unit: size } : p;
}

/** What lies on the view stays on its place of the picture when only the window changes. */
function followWindow(): void {
  let before: CameraJson | null = null;
  effect(() => {
    const now = camera.value;
    const same = before && now && rewindowed(before, now);
    before = now;
    const p = placement.peek();
    if (!p || p.anchor || !same) return;
    const [x, y] = same.at(p.x, p.y);
    placement.value = { ...p, x, y, scale: p.scale * same.scale };
  });
}
followWindow();

effect(() => {
  if (!placement.value) placedSteps.forget();
});

effect(() => {
  // another window deleted it, undo took it back, another project is shown for good: what is placed becomes a layer of
  // its own
  const [edited, now] = [editedLayer.value, state.value];
  if (!edited || !now || swapped.value) return;
  const there = now.project.id === edited.project && now.layers.some(({ id }) => id === edited.layer);
  if (!there) editedLayer.value = null;
});

effect(() => {
  // it goes onto the surface as soon as that is known, stays there when the view turns, and comes off it again
  const [view, { on }, now] = [viewSurface.value, wrapping.value, camera.value];
  const p = placement.value;
  if (!p || !now || p.flat || laying.value) return;
  if (!on) {
    if (p.anchor) placement.value = { ...fromAnchor(p, p.anchor), anchor: null };
  } else if (!p.anchor && view && surfaceOf(now)) {
    const next = laid(p);
    if (next !== p) placement.value = next;
  }
});
