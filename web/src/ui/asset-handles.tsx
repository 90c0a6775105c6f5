/** Handles over the view that move, turn and scale the chosen asset. */

import { useRef } from "preact/hooks";

import { chosenAsset, draggedAsset, grown, turned, type Stand } from "../state/assets";
import { camera, readOnly } from "../state/store";
import { add, scale, type CameraJson, type Vec3 } from "../view/camera";

const AXES = [
  ["X", "#ff6b61", [1, 0, 0]],
  ["Y", "#6fd66f", [0, 1, 0]],
  ["Z", "#6ea8ff", [0, 0, 1]],
] as const;
/** Pixels: length of the arrows, where the discs that turn are, radius of what can be grabbed. */
const ARROW = 62;
const DISC = 84;
const GRAB = 9;
/** Where the square that scales is. */
const SQUARE = 46;
/** An axis that is seen shorter has its disc aside: the others would lie over it. */
const END_ON = 24;
const GROW_PX = 140;
type Point = readonly [number, number];
type Part = "move" | "scale" | `${"along" | "about"} ${0 | 1 | 2}`;

/** Pixels of a point; null behind the camera. */
function project(now: CameraJson, p: Vec3): { at: Point; depth: number } | null {
  const [x, y, z] = now.world_to_camera.map((row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3]);
  return z > 1e-6 ? { at: [(now.fx * x) / z + now.cx, (now.fy * y) / z + now.cy], depth: z } : null;
}

/** The diagonal direction, so many pixels long, that leads farthest from all points. */
function freeDiagonal(length: number, points: readonly Point[]): Point {
  const side = length / Math.SQRT2;
  const corners: Point[] = [
    [side, side],
    [-side, side],
    [-side, -side],
    [side, -side],
  ];
  const room = ([x, y]: Point) => Math.min(...points.map((point) => Math.hypot(x - point[0], y - point[1])));
  return corners.reduce((best, corner) => (room(corner) > room(best) + 1 ? corner : best));
}

interface Drag {
  part: Part;
  start: Point;
  stand: Stand;
  center: Vec3;
  send: (fields: Partial<Stand>) => Promise<void>;
}

export function AssetHandles() {
  const drag = useRef<Drag | null>(null);
  const [asset, now] = [chosenAsset.value, camera.value];
  if (!asset || !now || !asset.visible || readOnly.value) return null;
  const center = asset.center as Vec3;
  const middle = project(now, center);
  const stage = document.getElementById("stage");
  if (!middle || !stage) return null;
  const shrink = stage.clientWidth / now.width; // CSS pixels per pixel of the view
  const unit = middle.depth / (now.fx * shrink); // world units per CSS pixel
  const at: Point = [middle.at[0] * shrink, middle.at[1] * shrink];
  const [right, down, forward] = now.world_to_camera.slice(0, 3).map((row) => [row[0], row[1], row[2]] as Vec3);
  const tips = AXES.map(([, , axis]) => {
    const end = project(now, add(center, scale(axis as unknown as Vec3, ARROW * unit)));
    const [x, y] = end ? [end.at[0] * shrink - at[0], end.at[1] * shrink - at[1]] : [0, 0];
    return [x, y] as const;
  });
  const discs: Point[] = [];
  for (const [x, y] of tips) {
    const length = Math.hypot(x, y);
    const out = (length + DISC - ARROW) / length;
    discs.push(length > END_ON ? [x * out, y * out] : freeDiagonal(DISC, [...tips, ...discs]));
  }
  const [squareX, squareY] = freeDiagonal(SQUARE, [...tips, ...discs]);
  const grab = (part: Part) => (event: PointerEvent) => {
    event.preventDefault();
    event.stopPropagation();
    (event.currentTarget as Element).setPointerCapture(event.pointerId);
    const stand = { move: asset.move, turn: asset.turn, scale: asset.scale };
    drag.current = { part, start: [event.clientX, event.clientY], stand, center, send: draggedAsset(asset.id) };
  };
  const pull = (event: PointerEvent) => {
    if (!drag.current) return;
    event.stopPropagation();
    const { part, start, stand, center: pivot, send } = drag.current;
    const [dx, dy] = [event.clientX - start[0], event.clientY - start[1]];
    const [kind, number] = part.split(" ");
    const k = Number(number) as 0 | 1 | 2;
    if (kind === "move") {
      const by = add(scale(right, dx * unit), scale(down, dy * unit));
      void send({ move: add(stand.move as Vec3, by) });
    } else if (kind === "along") {
      const [x, y] = tips[k];
      const length = Math.max(x * x + y * y, (ARROW / 4) ** 2); // seen nearly from its end
      const by = ((dx * x + dy * y) / length) * ARROW * unit;
      void send({ move: stand.move.map((value, n) => (n === k ? value + by : value)) });
    } else if (kind === "scale") void send(grown(stand, Math.exp(dx / GROW_PX), pivot));
    else {
      const box = stage.getBoundingClientRect();
      const [cx, cy] = [box.left + at[0], box.top + at[1]];
      const angle = (px: number, py: number) => Math.atan2(py - cy, px - cx);
      const swept = angle(event.clientX, event.clientY) - angle(start[0], start[1]);
      const sign = forward[k] < 0 ? -1 : 1;
      void send(turned(stand, k, (sign * Math.atan2(Math.sin(swept), Math.cos(swept)) * 180) / Math.PI, pivot));
    }
  };
  const drop = (event: PointerEvent) => {
    if (drag.current) event.stopPropagation();
    drag.current = null;
  };
  const handle = (part: Part) => ({
    onPointerDown: grab(part),
    onPointerMove: pull,
    onPointerUp: drop,
    onPointerCancel: drop,
  });
  return (
    <svg class="asset-handles" role="group" aria-label={`Handles of ${asset.name}`}>
      <g transform={`translate(${at[0]} ${at[1]})`}>
        {AXES.map(([name, color], k) => {
          const [x, y] = tips[k];
          const [ox, oy] = discs[k];
          return (
            <g key={name} stroke={color} fill={color}>
              <line x2={x} y2={y} stroke-width="2.5" />
              <circle class="grab" cx={x} cy={y} r="6" {...handle(`along ${k as 0 | 1 | 2}`)}>
                <title>{`Move along ${name}`}</title>
              </circle>
              <circle class="grab ring" cx={ox} cy={oy} r={GRAB} {...handle(`about ${k as 0 | 1 | 2}`)}>
                <title>{`Turn about ${name}`}</title>
              </circle>
            </g>
          );
        })}
        <circle class="grab middle" r={GRAB} {...handle("move")}>
          <title>Move in the view</title>
        </circle>
        <rect class="grab middle" x={squareX - 7} y={squareY - 7} width={14} height={14} {...handle("scale")}>
          <title>Scale: drag to the right or left</title>
        </rect>
      </g>
    </svg>
  );
}
