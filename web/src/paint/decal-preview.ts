/** How a placed text or picture is shown: as it will lie on the surface, once the server has said how. */

import { effect, signal } from "@preact/signals";

import { editor } from "../editor/editor";
import { camera } from "../state/store";
import { anchorPixel, angleOf, cardMap, decalBounds, drawDecal, type Anchor, type DecalMap } from "./decal";
import { rememberLatest } from "./latest";
import { editedLayer, laying, level, placement, type Placement } from "./placement";
import { wrapping } from "./view-surface";

type Context = CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D;

/** Blocks of the card that is shown while it moves, pixels. */
const CARD_BLOCK = 4;
/** How long it rests before the server is asked where it lies. */
const REST_MS = 150;
/** Steps of the sizes at which pixels are kept. */
const SIZE_STEP = 1.3;

/** Where the server would lay it, on the view and with the settings of `key`. */
const shown = signal<{ key: string; map: DecalMap } | null>(null);
/** The server is asked how it lies: what is shown until then is a flat card. */
export const decalAsked = signal(false);
/** Of the card, which is not what will be laid. */
const CARD_ALPHA = 0.6;

/** Draw it (not its handles). */
export function drawPlacement(context: Context, p: Placement): void {
  if (p.anchor) return drawOnSurface(context, p, p.anchor);
  context.save();
  context.translate(p.x, p.y);
  context.rotate(p.angle);
  context.scale(p.scale, p.scale);
  context.imageSmoothingQuality = "high";
  context.drawImage(p.image, -p.image.width / 2, -p.image.height / 2);
  context.restore();
}

/** The image made smaller by a factor. */
const scaledPixels = rememberLatest((image: Placement["image"], factor: number): ImageData => {
  const [columns, rows] = [image.width, image.height].map((size) => Math.max(1, Math.round(size * factor)));
  const context = new OffscreenCanvas(columns, rows).getContext("2d")!;
  context.imageSmoothingQuality = "high";
  context.drawImage(image, 0, 0, columns, rows);
  return context.getImageData(0, 0, columns, rows);
});

/** The image's pixels at about the width at which they are shown. */
function imagePixels(image: Placement["image"], width: number): ImageData {
  const steps = Math.ceil(Math.log(Math.max(width, 1) / image.width) / Math.log(SIZE_STEP));
  return scaledPixels(image, Math.min(1, SIZE_STEP ** steps));
}

/** What decides where it lies and how a view shows that; null: it is not on the surface. */
function decalRequest({ image, anchor }: Placement) {
  const now = camera.value;
  if (!anchor || !now) return null;
  const { x, y, unit, camera: seen } = anchor;
  const angle = (-angleOf(seen, anchor, level()) * 180) / Math.PI;
  const replaces = editedLayer.value?.layer;
  const size = { width: unit * image.width, columns: image.width, rows: image.height };
  const place = { camera: seen, x, y, angle, wrap: wrapping.value.limit, ...size };
  return { ...place, view: now, ...(replaces ? { replaces } : {}) };
}

/** Ask the server for the map of what is shown, once it rests: one question at a time, and the newest one next. */
export function followDecal(): void {
  let timer: ReturnType<typeof setTimeout>;
  let asking = false;
  const ask = async (): Promise<void> => {
    const p = placement.peek();
    const request = p && !laying.peek() ? decalRequest(p) : null;
    const key = JSON.stringify(request);
    if (!request || asking || shown.peek()?.key === key) return;
    asking = decalAsked.value = true;
    try {
      const { block, columns, rows, data } = await editor.link.do("decal.show", request);
      const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
      shown.value = { key, map: { block, columns, rows, places: new Float32Array(bytes.buffer) } };
    } catch {
      return; // it stays a card; why it cannot lie there is said when it is laid
    } finally {
      asking = decalAsked.value = false;
    }
    await ask();
  };
  effect(() => {
    const p = placement.value;
    const request = p && !laying.value ? decalRequest(p) : null;
    clearTimeout(timer);
    const pending = request !== null && shown.peek()?.key !== JSON.stringify(request);
    decalAsked.value = pending;
    if (pending) timer = setTimeout(() => void ask(), REST_MS);
  });
}

/** A flat card on the tangent plane, of the size of the image on the surface: it is there at once. */
const cardOf = rememberLatest((_key: string, anchor: Anchor, width: number, height: number): DecalMap =>
  cardMap(camera.value!, anchor, [width, height], CARD_BLOCK),
);

/** As the server would lay it; while that is not known, as a card. */
function drawOnSurface(context: Context, p: Placement, anchor: Anchor): void {
  const now = camera.value!;
  const size: [number, number] = [p.image.width * anchor.unit, p.image.height * anchor.unit];
  const key = JSON.stringify(decalRequest(p));
  const exact = shown.value;
  const map = exact?.key === key ? exact.map : cardOf(key, anchor, ...size);
  const part = decalBounds(map, now, 0.6 * size[0], 0.6 * size[1]);
  if (!part) return;
  const widthPx = (size[0] * now.fx) / Math.max(anchorPixel(now, anchor).depth, 1e-9);
  const pixels = drawDecal(map, imagePixels(p.image, widthPx), size, part);
  const canvas = new OffscreenCanvas(part.width, part.height);
  canvas.getContext("2d")!.putImageData(new ImageData(pixels, part.width, part.height), 0, 0);
  const before = context.globalAlpha;
  if (exact?.key !== key) context.globalAlpha = before * CARD_ALPHA;
  context.drawImage(canvas, part.x, part.y);
  context.globalAlpha = before;
}
