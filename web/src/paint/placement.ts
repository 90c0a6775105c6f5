/** A picture or a text laid on the view, to be moved, scaled and turned before it becomes a layer. */

import { effect, signal } from "@preact/signals";

import type { LayerInfo, Placed } from "../messages";
import { blobUrl, sendBlob } from "../net/blobs";
import {
  brush,
  camera,
  color,
  limits,
  method,
  paintMode,
  selectedLayer,
  state,
  text,
  toast,
  tool,
} from "../state/store";
import { go, link, report, run } from "../state/studio";
import { fromCamera, rewindowed, type CameraJson, type Vec3 } from "../view/camera";
import {
  anchorAt,
  anchorPixel,
  angleOf,
  cardMap,
  decalBounds,
  decalHandles,
  drawDecal,
  upAt,
  type Anchor,
  type DecalMap,
} from "./decal";
import { viewScale } from "./brush-settings";
import { limitsToSend } from "./limits";
import { beginStroke, endStroke } from "./stroke-queue";
import { surfaceOf, viewSurface, wrapping, surfaceArrived } from "./view-surface";
import { blend, type Rgb } from "./colors";
import type { Pen, ToolHandler } from "./tool";

export interface Placement {
  kind: "text" | "stamp";
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
export const editedLayer = signal<{ layer: string; name: string; gesture: string; strokes?: boolean } | null>(null);

/** Reach of a handle, pixels of the screen: more for a finger. */
const GRAB_PX = 14;
const TOUCH_GRAB_PX = 22;
const grabReach = (): number => (matchMedia("(pointer: coarse)").matches ? TOUCH_GRAB_PX : GRAB_PX) * viewScale.value;
/** Of angles while Shift is held. */
const STEP = Math.PI / 12;
/** The knob for turning stands this far above the box, pixels of the screen. */
const KNOB_PX = 28;

/** It is being laid on the surface by the server. */
export const laying = signal(false);

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

/** Draw it (not its handles). */
export function drawPlacement(
  context: CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D,
  p: Placement,
): void {
  if (p.anchor) return drawOnSurface(context, p, p.anchor);
  context.save();
  context.translate(p.x, p.y);
  context.rotate(p.angle);
  context.scale(p.scale, p.scale);
  context.imageSmoothingQuality = "high";
  context.drawImage(p.image, -p.image.width / 2, -p.image.height / 2);
  context.restore();
}

/** Blocks of the card that is shown while it moves, pixels. */
const CARD_BLOCK = 4;
/** How long it rests before the server is asked where it lies. */
const REST_MS = 150;
/** Up of the object, on which pictures stand. */
const level = (): Vec3 | null => (state.value?.asset.up as Vec3 | undefined) ?? null;
/** Where the server would lay it, on the view and with the settings of `key`. */
const shown = signal<{ key: string; map: DecalMap } | null>(null);
let card: { key: string; map: DecalMap } | null = null;
let drawn: { image: Placement["image"]; width: number; pixels: ImageData } | null = null;

/** The image's pixels at about the size at which they are shown. */
function imagePixels(image: Placement["image"], width: number): ImageData {
  const factor = Math.min(1, 1.3 ** Math.ceil(Math.log(Math.max(width, 1) / image.width) / Math.log(1.3)));
  const columns = Math.max(1, Math.round(image.width * factor));
  if (drawn?.image !== image || drawn.width !== columns) {
    const canvas = new OffscreenCanvas(columns, Math.max(1, Math.round(image.height * factor)));
    const context = canvas.getContext("2d")!;
    context.imageSmoothingQuality = "high";
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    drawn = { image, width: columns, pixels: context.getImageData(0, 0, canvas.width, canvas.height) };
  }
  return drawn.pixels;
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
    asking = true;
    try {
      const { block, columns, rows, data } = await link.do("decal.show", request);
      const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
      shown.value = { key, map: { block, columns, rows, places: new Float32Array(bytes.buffer) } };
    } catch {
      return; // it stays a card; why it cannot lie there is said when it is laid
    } finally {
      asking = false;
    }
    await ask();
  };
  effect(() => {
    const p = placement.value;
    const request = p && !laying.value ? decalRequest(p) : null;
    clearTimeout(timer);
    if (request) timer = setTimeout(() => void ask(), REST_MS);
  });
}

/** As the server would lay it; while that is not known, as a flat card on its tangent plane. */
function drawOnSurface(
  context: CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D,
  p: Placement,
  anchor: Anchor,
): void {
  const now = camera.value!;
  const size: [number, number] = [p.image.width * anchor.unit, p.image.height * anchor.unit];
  const key = JSON.stringify(decalRequest(p));
  let exact = shown.value;
  if (exact?.key !== key) {
    if (card?.key !== key) card = { key, map: cardMap(now, anchor, size, CARD_BLOCK) };
    exact = card;
  }
  const part = decalBounds(exact.map, now, 0.6 * size[0], 0.6 * size[1]);
  if (!part) return;
  const widthPx = (size[0] * now.fx) / Math.max(anchorPixel(now, anchor).depth, 1e-9);
  const pixels = drawDecal(exact.map, imagePixels(p.image, widthPx), size, part);
  const canvas = new OffscreenCanvas(part.width, part.height);
  canvas.getContext("2d")!.putImageData(new ImageData(pixels, part.width, part.height), 0, 0);
  context.drawImage(canvas, part.x, part.y);
}

/** x, y, scale and angle of what lies on the surface, on the present view or another. */
function fromAnchor(p: Placement, anchor: Anchor, now: CameraJson = camera.value!): Placement {
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
const evened = ({ image }: Placement, size: number): number => 0.35 * size * Math.min(image.width, image.height);

/** The same, laid on the surface under its middle where the view sees one. */
function laid(p: Placement): Placement {
  const view = surfaceOf(camera.value);
  const at = view?.at(p.x, p.y);
  if (!view || !at || p.flat) return p;
  const size = p.unit ?? (p.scale * at.point[2]) / view.camera.fx;
  const anchor = anchorAt(view, p.x, p.y, p.angle, size, level(), evened(p, size));
  return anchor ? { ...p, anchor, unit: size } : p;
}

let windowSeen: CameraJson | null = null;

effect(() => {
  // what lies on the view stays on its place of the picture when only the window changes
  const now = camera.value;
  const same = windowSeen && now && rewindowed(windowSeen, now);
  windowSeen = now;
  const p = placement.peek();
  if (!p || p.anchor || !same) return;
  const [x, y] = same.at(p.x, p.y);
  placement.value = { ...p, x, y, scale: p.scale * same.scale };
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

type Grip = { part: "move" | "scale" | "turn"; from: Placement; pen: Pen };
let grip: Grip | null = null;
/** A text was begun by the press that is under way. */
let begun = false;

/** Where the words of a text are written: the place of the caret in them; null: nobody writes. */
export const caret = signal<number | null>(null);
/** Gives the keys to the words; set by whoever shows their field. select: all of them, to be replaced. */
export const words: { focus: (select: boolean) => void } = { focus: () => {} };

/** Drag the inside to move, a corner to scale, the knob to turn (Shift: steps of 15 degrees). A text starts where one clicks. */
export const placer: ToolHandler = {
  down(pen) {
    const p = placement.value;
    if (laying.value) return;
    if (!p) {
      begun = tool.value === "text";
      if (begun) startText(pen);
      return;
    }
    const { corners, knob } = handles(p);
    const grabbed = ([x, y]: [number, number]) => Math.hypot(pen.x - x, pen.y - y) < grabReach();
    grip = { part: grabbed(knob) ? "turn" : corners.some(grabbed) ? "scale" : "move", from: p, pen };
  },
  move(pen) {
    if (!grip) return;
    const { part, from, pen: first } = grip;
    if (from.anchor) return void (placement.value = onSurface(part, from, from.anchor, first, pen));
    if (part === "move") placement.value = { ...from, x: from.x + pen.x - first.x, y: from.y + pen.y - first.y };
    const reach = (at: Pen) => Math.hypot(at.x - from.x, at.y - from.y) || 1;
    if (part === "scale")
      placement.value = { ...from, scale: Math.max(0.01, (from.scale * reach(pen)) / reach(first)) };
    if (part === "turn") {
      const angle = Math.atan2(pen.y - from.y, pen.x - from.x) + Math.PI / 2;
      placement.value = { ...from, angle: pen.shift ? Math.round(angle / STEP) * STEP : angle };
    }
  },
  up() {
    grip = null;
    if (begun) words.focus(true); // a click is a caret: not before it is over, or the view would take the keys again
    begun = false;
  },
  cancel() {
    const held = grip;
    grip = null;
    begun = false;
    if (held)
      placement.value = held.from; // the drag is taken back, not the picture
    else void discardPlacement();
  },
};

/** Moved, scaled or turned on the surface. */
function onSurface(part: Grip["part"], from: Placement, anchor: Anchor, first: Pen, pen: Pen): Placement {
  const now = camera.value!;
  const middle = anchorPixel(now, anchor);
  if (part === "move") {
    const view = surfaceOf(now);
    const [x, y] = [middle.x + pen.x - first.x, middle.y + pen.y - first.y];
    const moved =
      view && anchorAt(view, x, y, angleOf(now, anchor, level()), anchor.unit, level(), evened(from, anchor.unit));
    return moved ? fromAnchor(from, moved) : placement.value!;
  }
  const reach = (at: Pen) => Math.hypot(at.x - middle.x, at.y - middle.y) || 1;
  if (part === "scale")
    return fromAnchor(from, { ...anchor, unit: anchor.unit * Math.max(0.02, reach(pen) / reach(first)) });
  const turned = (at: Pen) => Math.atan2(at.y - middle.y, at.x - middle.x);
  let angle = angleOf(now, anchor, level()) + turned(pen) - turned(first);
  if (pen.shift) angle = Math.round(angle / STEP) * STEP;
  return fromAnchor(from, { ...anchor, up: upAt(now, anchor.normal, angle, level()) });
}

/** Take it away; a layer that was being changed is as it was. */
export async function discardPlacement(): Promise<void> {
  if (laying.value) return;
  placement.value = null;
  const edited = editedLayer.value;
  editedLayer.value = null;
  if (edited) await run("layer.set", { layer: edited.layer, visible: true, gesture: edited.gesture }, edited.name);
}

/** Lay the text or the sticker of a layer on its view again, to be changed. */
export async function changePlaced(layer: LayerInfo): Promise<void> {
  const placed = layer.placed;
  const [view] = layer.views;
  if (!placed || !view) return;
  if (placement.value) await discardPlacement();
  const seen = (placed.view ?? view.camera) as CameraJson;
  go(fromCamera(seen, state.value!.asset.center as Vec3));
  wrapping.value = { on: typeof placed.unit === "number", limit: placed.wrap ?? 180 };
  brush.value = { ...brush.value, opacity: placed.opacity };
  paintMode.value = placed.mode;
  const kind = placed.kind === "text" ? "text" : "stamp";
  let image: Placement["image"];
  if (kind === "text") {
    const { text: written, font, size, bold, italic } = placed;
    text.value = { text: written, font, size, bold, italic };
    color.value = placed.color;
    image = textImage();
  } else {
    const pixels = await fetch(blobUrl(placed.image!));
    image = await createImageBitmap(await pixels.blob());
  }
  tool.value = kind;
  selectedLayer.value = layer.id;
  const gesture = `change ${layer.id} ${Date.now()}`;
  editedLayer.value = { layer: layer.id, name: layer.name, gesture };
  const [x, y] = [placed.x, placed.y].map((v, k) => {
    const [at, now] = [seen, camera.value!];
    return k === 0 ? now.cx + ((v - at.cx) * now.fx) / at.fx : now.cy + ((v - at.cy) * now.fy) / at.fy;
  });
  const scale = (placed.scale * camera.value!.fx) / seen.fx;
  const unit = placed.unit ?? undefined;
  placement.value = { kind, image, name: layer.name, x, y, scale, angle: placed.angle, unit };
  await run("layer.set", { layer: layer.id, visible: false, gesture }, layer.name);
}

/** Lay a picture on the middle of the view, at most half as large as that. */
export async function startStamp(file: Blob, name: string, view: { width: number; height: number }): Promise<void> {
  const image = await createImageBitmap(file);
  const scale = Math.min(1, (0.5 * view.width) / image.width, (0.5 * view.height) / image.height);
  placement.value = { kind: "stamp", image, name, x: view.width / 2, y: view.height / 2, scale, angle: 0 };
}

function startText(pen: Pen): void {
  const scale = viewScale.value; // letters are as large as their pixels are on the screen
  placement.value = { kind: "text", image: textImage(), name: "Text", x: pen.x, y: pen.y, scale, angle: 0 };
}

/** The CSS font of the text as it is set. */
function textFont(): string {
  const { font, size, bold, italic } = text.value;
  const family = JSON.stringify(font).replace(/^"(serif|sans-serif|monospace|cursive)"$/, "$1");
  return `${italic ? "italic " : ""}${bold ? "bold " : ""}${size}px ${family}`;
}

/** Height of a line, and where the middle of the first one is, of the letters' size. */
const LINE = 1.25;
const FIRST_MIDDLE = 0.72;

/** The text in its font and colour on a canvas that just holds it. */
function textImage(): HTMLCanvasElement {
  const { text: written, size } = text.value;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d")!;
  const lines = (written || " ").split("\n");
  context.font = textFont();
  const width = Math.max(...lines.map((line) => context.measureText(line).width));
  canvas.width = Math.ceil(width + size * 0.4);
  canvas.height = Math.ceil(size * LINE * lines.length + size * 0.2);
  context.font = textFont();
  context.textBaseline = "middle";
  context.textAlign = "center";
  context.fillStyle = color.value;
  lines.forEach((line, k) => context.fillText(line, canvas.width / 2, size * (FIRST_MIDDLE + LINE * k)));
  return canvas;
}

/** The two ends of the caret in the words that are being written, view pixels; null: there is none. */
export function caretLine(p: Placement): [number, number, number, number] | null {
  const at = caret.value;
  if (at === null || p.kind !== "text" || laying.value) return null;
  const context = (p.image as HTMLCanvasElement).getContext("2d")!;
  const { text: written, size } = text.value;
  const before = written.slice(0, at).split("\n");
  const line = written.split("\n")[before.length - 1];
  const { width, height } = p.image;
  const x = (width - context.measureText(line).width) / 2 + context.measureText(before.at(-1)!).width;
  const middle = size * (FIRST_MIDDLE + LINE * (before.length - 1));
  const [leftUpper, rightUpper, rightLower, leftLower] = handles(p).corners;
  const toView = (u: number, v: number): [number, number] =>
    [0, 1].map((k) => {
      const [above, below] = [
        leftUpper[k] + (rightUpper[k] - leftUpper[k]) * u,
        leftLower[k] + (rightLower[k] - leftLower[k]) * u,
      ];
      return above + (below - above) * v;
    }) as [number, number];
  return [...toView(x / width, (middle - 0.55 * size) / height), ...toView(x / width, (middle + 0.55 * size) / height)];
}

effect(() => {
  // the settings or the colour changed while a text is being placed
  void [text.value, color.value];
  const p = placement.peek();
  if (p?.kind === "text") placement.value = { ...p, image: textImage() };
});

/** What is kept of it with its layer. */
async function placedInfo(p: Placement): Promise<Placed> {
  const { x, y, scale, angle } = p;
  const surface = { unit: p.anchor?.unit ?? null, wrap: wrapping.value.limit, view: p.anchor?.camera ?? null };
  const common = { x, y, scale, angle, opacity: brush.value.opacity, mode: paintMode.value, ...surface };
  const written = { ...text.value, color: color.value, image: null };
  if (p.kind === "text") return { kind: "text", ...common, ...written };
  const canvas = new OffscreenCanvas(p.image.width, p.image.height);
  canvas.getContext("2d")!.drawImage(p.image, 0, 0);
  const image = await sendBlob(await canvas.convertToBlob({ type: "image/png" }), `${p.name}.png`);
  return { kind: "sticker", ...common, ...written, text: "", image };
}

/** Have it laid on the surface; it is shown as it was placed until that is done. */
async function lay(p: Placement, anchor: Anchor, placed: Placed, name: string): Promise<void> {
  const { x, y, camera: seen } = anchor; // where it was put, which the present view may not show
  const edited = editedLayer.value;
  laying.value = true;
  try {
    const canvas = new OffscreenCanvas(p.image.width, p.image.height);
    const context = canvas.getContext("2d")!;
    context.globalAlpha = brush.value.opacity;
    context.drawImage(p.image, 0, 0);
    const picture = await sendBlob(await canvas.convertToBlob({ type: "image/png" }), `${p.kind}.png`);
    const answer = await run(
      "decal.lay",
      {
        camera: seen,
        x,
        y,
        picture,
        width: anchor.unit * p.image.width,
        angle: (-angleOf(seen, anchor, level()) * 180) / Math.PI,
        wrap: wrapping.value.limit,
        placed,
        ...(edited ? { replaces: edited.layer, gesture: edited.gesture } : {}),
        name,
        method: method.value,
        limits: limitsToSend(limits.value),
      },
      name,
    );
    if (!answer) return; // it stays where it is, to be moved; the reason was said
    placement.value = null;
    editedLayer.value = null;
    selectedLayer.value = answer.layer.id;
    if (answer.note) toast("warning", answer.note);
  } catch (error) {
    report(error, name);
  } finally {
    laying.value = false;
  }
}

/** Make it a layer, or the layer that it was again. */
export async function commitPlacement(): Promise<void> {
  if (!placement.value || laying.value) return;
  if (wrapping.value.on && !placement.value.flat && !placement.value.anchor && !surfaceOf(camera.value)) {
    laying.value = true; // applied before the surface is known, it is to lie there all the same
    await surfaceArrived(camera.value!);
    laying.value = false; // now it goes there
  }
  const current = placement.value;
  if (!current) return;
  const p = current.anchor ? fromAnchor(current, current.anchor, current.anchor.camera) : current;
  const edited = editedLayer.value;
  const placed = await placedInfo(p).catch((error) => void report(error));
  if (!placed) return;
  const target = edited && !edited.strokes ? { replaces: edited.layer, gesture: edited.gesture, placed } : { placed };
  const title = p.kind === "text" ? `Text: ${text.value.text.slice(0, 40)}` : p.name;
  if (p.anchor) return lay(p, p.anchor, placed, title);
  const stroke = beginStroke("paint", title, brush.value.opacity, target);
  if (!stroke) return;
  placement.value = null;
  editedLayer.value = null;
  const { width, height } = stroke.mask;
  const context = new OffscreenCanvas(width, height).getContext("2d")!;
  drawPlacement(context, p);
  const { data } = context.getImageData(0, 0, width, height);
  for (let k = 0; k < width * height; k++) stroke.mask.data[k] = data[k * 4 + 3] / 255;
  const mode = paintMode.value;
  stroke.setSource((x, y, out) => {
    const at = (y * width + x) * 4;
    const pixel: Rgb = [data[at], data[at + 1], data[at + 2]];
    const base = mode === "normal" ? null : stroke.base;
    [out[0], out[1], out[2]] = base ? blend(mode, pixel, [base.data[at], base.data[at + 1], base.data[at + 2]]) : pixel;
  });
  stroke.touch({ x: 0, y: 0, width, height });
  await endStroke(stroke);
  if (edited?.strokes) await run("layer.delete", { layer: edited.layer }, edited.name);
}
