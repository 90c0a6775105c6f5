/** A picture or a text laid on the view, to be moved, scaled and turned before it becomes a layer. */

import { effect, signal } from "@preact/signals";

import type { LayerInfo, Placed } from "../messages";
import { blobUrl, sendBlob } from "../net/blobs";
import { brush, camera, color, paintMode, selectedLayer, state, text, tool } from "../state/store";
import { go, report, run } from "../state/studio";
import { fromCamera, type CameraJson, type Vec3 } from "../view/camera";
import { beginStroke, endStroke } from "./strokes";
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
}

export const placement = signal<Placement | null>(null);
/**
 * The layer whose text or sticker is being changed; it is hidden meanwhile. `strokes`: it holds strokes, which one
 * sticker replaces.
 */
export const editedLayer = signal<{ layer: string; name: string; gesture: string; strokes?: boolean } | null>(null);

const GRAB = 14;
/** The knob for turning stands this far above the box, view pixels. */
export const KNOB = 28;

/** Corners of the box (left upper, right upper, right lower, left lower) and the knob, in view pixels. */
export function handles(p: Placement): { corners: [number, number][]; knob: [number, number] } {
  const [w, h] = [(p.image.width * p.scale) / 2, (p.image.height * p.scale) / 2];
  const toView = (x: number, y: number): [number, number] => [
    p.x + x * Math.cos(p.angle) - y * Math.sin(p.angle),
    p.y + x * Math.sin(p.angle) + y * Math.cos(p.angle),
  ];
  return { corners: [toView(-w, -h), toView(w, -h), toView(w, h), toView(-w, h)], knob: toView(0, -h - KNOB) };
}

/** Draw it (not its handles). */
export function drawPlacement(
  context: CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D,
  p: Placement,
): void {
  context.save();
  context.translate(p.x, p.y);
  context.rotate(p.angle);
  context.scale(p.scale, p.scale);
  context.imageSmoothingQuality = "high";
  context.drawImage(p.image, -p.image.width / 2, -p.image.height / 2);
  context.restore();
}

type Grip = { part: "move" | "scale" | "turn"; from: Placement; pen: Pen };
let grip: Grip | null = null;

/** Drag the inside to move, a corner to scale, the knob to turn (Shift: steps of 15 degrees). A text starts where one clicks. */
export const placer: ToolHandler = {
  down(pen) {
    const p = placement.value;
    if (!p) return void (tool.value === "text" && startText(pen));
    const { corners, knob } = handles(p);
    const grabbed = ([x, y]: [number, number]) => Math.hypot(pen.x - x, pen.y - y) < GRAB;
    grip = { part: grabbed(knob) ? "turn" : corners.some(grabbed) ? "scale" : "move", from: p, pen };
  },
  move(pen) {
    if (!grip) return;
    const { part, from, pen: first } = grip;
    if (part === "move") placement.value = { ...from, x: from.x + pen.x - first.x, y: from.y + pen.y - first.y };
    const reach = (at: Pen) => Math.hypot(at.x - from.x, at.y - from.y) || 1;
    if (part === "scale")
      placement.value = { ...from, scale: Math.max(0.01, (from.scale * reach(pen)) / reach(first)) };
    if (part === "turn") {
      const step = Math.PI / 12;
      const angle = Math.atan2(pen.y - from.y, pen.x - from.x) + Math.PI / 2;
      placement.value = { ...from, angle: pen.shift ? Math.round(angle / step) * step : angle };
    }
  },
  up() {
    grip = null;
  },
  cancel() {
    grip = null;
    void discardPlacement();
  },
};

/** Take it away; a layer that was being changed is as it was. */
export async function discardPlacement(): Promise<void> {
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
  go(fromCamera(view.camera as CameraJson, state.value!.asset.center as Vec3));
  brush.value = { ...brush.value, opacity: placed.opacity };
  paintMode.value = placed.mode;
  const kind = placed.kind === "text" ? "text" : "stamp";
  let image: Placement["image"];
  if (kind === "text") {
    const { text: words, font, size, bold, italic } = placed;
    text.value = { text: words, font, size, bold, italic };
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
    const [at, now] = [view.camera, camera.value!];
    return k === 0 ? now.cx + ((v - at.cx) * now.fx) / at.fx : now.cy + ((v - at.cy) * now.fy) / at.fy;
  });
  const scale = (placed.scale * camera.value!.fx) / view.camera.fx;
  placement.value = { kind, image, name: layer.name, x, y, scale, angle: placed.angle };
  await run("layer.set", { layer: layer.id, visible: false, gesture }, layer.name);
}

/** Lay a picture on the middle of the view, at most half as large as that. */
export async function startStamp(file: Blob, name: string, view: { width: number; height: number }): Promise<void> {
  const image = await createImageBitmap(file);
  const scale = Math.min(1, (0.5 * view.width) / image.width, (0.5 * view.height) / image.height);
  placement.value = { kind: "stamp", image, name, x: view.width / 2, y: view.height / 2, scale, angle: 0 };
}

function startText(pen: Pen): void {
  placement.value = { kind: "text", image: textImage(), name: "Text", x: pen.x, y: pen.y, scale: 1, angle: 0 };
}

/** The text in its font and colour on a canvas that just holds it. */
function textImage(): HTMLCanvasElement {
  const { text: words, font, size, bold, italic } = text.value;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d")!;
  const style = `${italic ? "italic " : ""}${bold ? "bold " : ""}${size}px ${JSON.stringify(font).replace(/^"(serif|sans-serif|monospace|cursive)"$/, "$1")}`;
  const lines = (words || " ").split("\n");
  context.font = style;
  const width = Math.max(...lines.map((line) => context.measureText(line).width));
  canvas.width = Math.ceil(width + size * 0.4);
  canvas.height = Math.ceil(size * 1.25 * lines.length + size * 0.2);
  context.font = style;
  context.textBaseline = "middle";
  context.textAlign = "center";
  context.fillStyle = color.value;
  lines.forEach((line, k) => context.fillText(line, canvas.width / 2, size * (0.72 + 1.25 * k)));
  return canvas;
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
  const common = { x, y, scale, angle, opacity: brush.value.opacity, mode: paintMode.value };
  const { text: words, font, size, bold, italic } = text.value;
  const written = { text: words, font, size, bold, italic, color: color.value, image: null };
  if (p.kind === "text") return { kind: "text", ...common, ...written };
  const canvas = new OffscreenCanvas(p.image.width, p.image.height);
  canvas.getContext("2d")!.drawImage(p.image, 0, 0);
  const image = await sendBlob(await canvas.convertToBlob({ type: "image/png" }), `${p.name}.png`);
  return { kind: "sticker", ...common, ...written, text: "", image };
}

/** Make it a layer, or the layer that it was again. */
export async function commitPlacement(): Promise<void> {
  const p = placement.value;
  if (!p) return;
  const edited = editedLayer.value;
  const placed = await placedInfo(p).catch((error) => void report(error));
  if (!placed) return;
  const target = edited && !edited.strokes ? { replaces: edited.layer, gesture: edited.gesture, placed } : { placed };
  const title = p.kind === "text" ? `Text: ${text.value.text.slice(0, 40)}` : p.name;
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
