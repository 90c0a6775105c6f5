/** What is drawn over the view but is not part of any picture: cursor, selection, handles, the clone source. */

import { effect } from "@preact/signals";

import { cursorFrame } from "../paint/brush";
import { viewScale } from "../paint/brush-settings";
import { meanRadius, type Frame } from "../paint/dabs";
import { outlineOf } from "../paint/mirror";
import { mirroredPixel, mirrorPlane } from "../paint/symmetry";
import { boxHandles, handleAt } from "../paint/crop-box";
import { drawPlacement } from "../paint/decal-preview";
import { handles, laying, placement } from "../paint/placement";
import { caretLine } from "../paint/text-image";
import { outline } from "../paint/selection-masks";
import type { Mask } from "../paint/raster";
import { cropBox, faintPoints, selection, tinted } from "../paint/selected";
import { brush, camera, state } from "../state/store";
import { inHand } from "../tools";
import { copySource } from "../tools/copy-source";
import { pulled } from "../tools/freehand";
import { hover } from "../tools/pen-input";
import { draft } from "../tools/select";
import { project, type CameraJson, type Vec3 } from "../view/camera";

/** Alpha of the tint, 0..255. */
const TINT = 70;
/** Of what is selected and too faint to be seen: screen pixels. */
const MARK_RADIUS = 3.5;
const MARK_COLOR = "rgba(60,150,255,.75)";
/** Of the axes X, Y, Z, as of the gizmo. */
const AXIS_COLORS = ["#e05252", "#6cbf4b", "#4a86e8"];

/** Keep the canvas up to date. `ratio`: canvas pixels per view pixel. */
export function drawOverlay(canvas: HTMLCanvasElement, ratio: () => number): () => void {
  const context = canvas.getContext("2d")!;
  let tint: { mask: Mask; image: HTMLCanvasElement } | null = null;
  let lines: { mask: unknown; path: Path2D } | null = null;
  return effect(() => {
    const k = ratio();
    const px = viewScale.value; // of the view, in a pixel of the screen
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    let empty = true;
    context.setTransform(k, 0, 0, k, 0, 0);
    const two = (path: Path2D, dash: number[] = []) => {
      // dark under light: visible on everything
      empty = false;
      context.setLineDash([]);
      context.lineWidth = 3 * px;
      context.strokeStyle = "rgba(0,0,0,.55)";
      context.stroke(path);
      context.setLineDash(dash.map((d) => d * px));
      context.lineWidth = 1.25 * px;
      context.strokeStyle = "#fff";
      context.stroke(path);
    };
    const mask = selection.value;
    if (mask && tinted.value) {
      if (tint?.mask !== mask) tint = { mask, image: tintOf(mask) };
      context.drawImage(tint.image, 0, 0);
      empty = false;
    }
    if (mask) {
      if (lines?.mask !== mask) lines = { mask, path: segments(outline(mask)) };
      two(lines.path, [4, 4]);
    }
    if (mask && tinted.value && faintPoints.value.length) {
      const rings = dots(faintPoints.value, MARK_RADIUS * px);
      context.fillStyle = MARK_COLOR;
      context.fill(rings);
      two(rings);
    }
    const box = cropBox.value;
    const now = camera.value;
    if (box && now) {
      two(edges(box, now));
      const pen = hover.value;
      const near = pen && handleAt(box, now, pen.x, pen.y);
      for (const handle of boxHandles(box, now)) {
        const dot = new Path2D();
        const over = near?.axis === handle.axis && near.side === handle.side;
        dot.arc(handle.x, handle.y, (over ? 8 : 6) * px, 0, 7);
        context.fillStyle = AXIS_COLORS[handle.axis];
        context.fill(dot);
        two(dot);
      }
    }
    const points = draft.value;
    if (points && points.length > 2) two(polyline(points), [4, 4]);
    const placed = placement.value;
    if (placed) {
      context.globalAlpha = brush.value.opacity; // as it will be laid
      drawPlacement(context, placed);
      context.globalAlpha = 1;
      const { corners, knob } = laying.value ? { corners: [], knob: [0, 0] as [number, number] } : handles(placed);
      empty = false;
      if (corners.length) two(polyline(corners.flat()));
      const line = caretLine(placed);
      if (line) two(segments(line));
      for (const [x, y] of corners.length ? [...corners, knob] : []) {
        const dot = new Path2D();
        dot.arc(x, y, 5 * px, 0, 7);
        context.fillStyle = "#fff";
        context.fill(dot);
        two(dot);
      }
    }
    const from = copySource.value;
    const at = hover.value;
    const spec = inHand();
    const cursor = placed && spec.cursor() === "ring" ? "none" : spec.cursor();
    if (from && spec.copies) {
      const [x, y] = from.offset && at ? [at.x - from.offset[0], at.y - from.offset[1]] : [from.x, from.y];
      two(cross(x, y, 7 * px));
    }
    const plane = mirrorPlane.value;
    if (plane && now && cursor === "ring") {
      const { center, radius } = state.value!.asset;
      const points = outlineOf(plane, center as Vec3, 1.05 * radius).map((point) => project(now, point));
      if (points.every(([, , depth]) => depth > 0)) {
        const path = polyline(points.flatMap(([x, y]) => [x, y]));
        context.fillStyle = "rgba(120,190,255,.07)";
        context.fill(path);
        two(path, [6, 5]);
      }
      const other = at && mirroredPixel(now, at.x, at.y);
      if (other) two(ellipse(other.x, other.y, cursorFrame(at.x, at.y)), other.hidden ? [2, 4] : []);
    }
    const string = pulled.value;
    if (string && at) two(segments([string.x, string.y, at.x, at.y]));
    if (at && now && cursor === "ring") {
      two(ellipse(string?.x ?? at.x, string?.y ?? at.y, cursorFrame(string?.x ?? at.x, string?.y ?? at.y)));
    } else if (at && cursor === "disc") {
      const ring = new Path2D();
      ring.arc(at.x, at.y, Math.max((brush.value.size / 2) * viewScale.value, 1), 0, 7);
      two(ring);
    } else if (at && cursor === "cross") two(cross(at.x, at.y, 7 * px));
    canvas.style.visibility = empty ? "hidden" : "visible"; // Chromium goes on showing what was on a canvas that is only cleared
  });
}

/** The mask in a colour that no asset has for long. */
function tintOf(mask: Mask): HTMLCanvasElement {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [mask.width, mask.height];
  const image = new ImageData(mask.width, mask.height);
  for (let k = 0; k < mask.data.length; k++) {
    [image.data[k * 4], image.data[k * 4 + 1], image.data[k * 4 + 2]] = [60, 150, 255];
    image.data[k * 4 + 3] = mask.data[k] * TINT;
  }
  canvas.getContext("2d")!.putImageData(image, 0, 0);
  return canvas;
}

/** The edges of a box that lie before the camera. */
function edges({ low, high }: { low: Vec3; high: Vec3 }, camera: CameraJson): Path2D {
  const lines: number[] = [];
  const corner = (k: number): Vec3 => [0, 1, 2].map((axis) => (k & (1 << axis) ? high : low)[axis]) as Vec3;
  for (let k = 0; k < 8; k++)
    for (let axis = 0; axis < 3; axis++) {
      if (k & (1 << axis)) continue;
      const [a, b] = [project(camera, corner(k)), project(camera, corner(k | (1 << axis)))];
      if (a[2] > 0 && b[2] > 0) lines.push(a[0], a[1], b[0], b[1]);
    }
  return segments(lines);
}

function segments(lines: number[]): Path2D {
  const path = new Path2D();
  for (let i = 0; i < lines.length; i += 4) {
    path.moveTo(lines[i], lines[i + 1]);
    path.lineTo(lines[i + 2], lines[i + 3]);
  }
  return path;
}

/** The circle of a brush as the view sees it, at least one pixel in radius. */
function ellipse(x: number, y: number, [a, b, c, d]: Frame): Path2D {
  const least = Math.max(1, 1 / meanRadius([a, b, c, d]));
  const points: number[] = [];
  for (let k = 0; k < 48; k++) {
    const [u, v] = [least * Math.cos((k * Math.PI) / 24), least * Math.sin((k * Math.PI) / 24)];
    points.push(x + a * u + b * v, y + c * u + d * v);
  }
  return polyline(points);
}

/** A disc around each point. */
function dots(points: readonly number[], radius: number): Path2D {
  const path = new Path2D();
  for (let i = 0; i < points.length; i += 2) {
    path.moveTo(points[i] + radius, points[i + 1]);
    path.arc(points[i], points[i + 1], radius, 0, 7);
  }
  return path;
}

function polyline(points: number[]): Path2D {
  const path = new Path2D();
  path.moveTo(points[0], points[1]);
  for (let i = 2; i < points.length; i += 2) path.lineTo(points[i], points[i + 1]);
  path.closePath();
  return path;
}

function cross(x: number, y: number, r: number): Path2D {
  return segments([x - r, y, x + r, y, x, y - r, x, y + r]);
}
