/** What is drawn over the view but is not part of any picture: cursor, selection, handles, the clone source. */

import { effect, signal } from "@preact/signals";

import { cloneFrom } from "../paint/strokes";
import { drawPlacement, handles, placement } from "../paint/placement";
import { draft } from "../paint/point-tools";
import { outline } from "../paint/select";
import { selection } from "../paint/selection";
import { brush, selecting, tool } from "../state/store";

/** Pen over the view, view pixels; null: elsewhere. */
export const hover = signal<{ x: number; y: number } | null>(null);

const ROUND = ["brush", "erase", "clone", "heal", "line"];

/** Keep the canvas up to date. `ratio`: canvas pixels per view pixel. */
export function drawOverlay(canvas: HTMLCanvasElement, ratio: () => number): () => void {
  const context = canvas.getContext("2d")!;
  let lines: { mask: unknown; path: Path2D } | null = null;
  return effect(() => {
    const k = ratio();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    let empty = true;
    context.setTransform(k, 0, 0, k, 0, 0);
    const two = (path: Path2D, dash: number[] = []) => {
      // dark under light: visible on everything
      empty = false;
      context.setLineDash([]);
      context.lineWidth = 3 / k;
      context.strokeStyle = "rgba(0,0,0,.55)";
      context.stroke(path);
      context.setLineDash(dash.map((d) => d / k));
      context.lineWidth = 1.25 / k;
      context.strokeStyle = "#fff";
      context.stroke(path);
    };
    const mask = selection.value;
    if (mask) {
      if (lines?.mask !== mask) lines = { mask, path: segments(outline(mask)) };
      two(lines.path, [4, 4]);
    }
    const points = draft.value;
    if (points && points.length > 2) two(polyline(points), [4, 4]);
    const placed = placement.value;
    if (placed) {
      drawPlacement(context, placed);
      const { corners, knob } = handles(placed);
      two(polyline(corners.flat()));
      for (const [x, y] of [...corners, knob]) {
        const dot = new Path2D();
        dot.arc(x, y, 5 / k, 0, 7);
        context.fillStyle = "#fff";
        context.fill(dot);
        two(dot);
      }
    }
    const from = cloneFrom.value;
    const at = hover.value;
    const current = tool.value;
    if (from && (current === "clone" || current === "heal")) {
      const [x, y] = from.offset && at ? [at.x - from.offset[0], at.y - from.offset[1]] : [from.x, from.y];
      two(cross(x, y, 7 / k));
    }
    const round = ROUND.includes(current) || (current === "select" && selecting.value.kind === "brush");
    if (at && round && !placed) {
      const ring = new Path2D();
      ring.arc(at.x, at.y, Math.max(brush.value.size / 2, 1), 0, 7);
      two(ring);
    } else if (at && (current === "pick" || current === "fill" || current === "select")) two(cross(at.x, at.y, 7 / k));
    canvas.style.visibility = empty ? "hidden" : "visible"; // Chromium goes on showing what was on a canvas that is only cleared
  });
}

function segments(lines: number[]): Path2D {
  const path = new Path2D();
  for (let i = 0; i < lines.length; i += 4) {
    path.moveTo(lines[i], lines[i + 1]);
    path.lineTo(lines[i + 2], lines[i + 3]);
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
