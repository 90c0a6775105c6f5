/** The axes of the world as they lie in the view: click on one to look from there, drag to turn. */

import { keyOf, labelOf } from "../keys/bindings";
import { spoken } from "../keys/chord";
import { camera, pose, readOnly, state, toast } from "../state/store";
import { run } from "../editor/editor";
import { dot, type Vec3 } from "../view/camera";
import { goHome, viewFrom } from "./keys";
import { CommandButton } from "./command-button";
import { Button } from "./parts";
import { turnBy } from "../tools/pen-input";

const onButton = (event: PointerEvent) => (event.target as HTMLElement).closest("button") !== null;
const confirmFront = (answer: unknown) =>
  answer && toast("info", "This side is the front.", `${labelOf("view.home")}: ${spoken(keyOf("view.home"))}.`);

/** Larger where fingers are to hit its axes. Pixels. */
const TOUCHED = matchMedia("(pointer: coarse)").matches;
const SIZE = TOUCHED ? 156 : 84;
const REACH = TOUCHED ? 54 : 30;
const RADIANS_PER_PIXEL = Math.PI / 200;
const AXES: readonly (readonly [string, Vec3])[] = [
  ["+X", [1, 0, 0]],
  ["−X", [-1, 0, 0]],
  ["+Y", [0, 1, 0]],
  ["−Y", [0, -1, 0]],
  ["+Z", [0, 0, 1]],
  ["−Z", [0, 0, -1]],
];

export function Gizmo() {
  const now = pose.value;
  if (!now || !state.value) return null;
  const points = AXES.map(([name, axis]) => ({
    name,
    axis,
    x: SIZE / 2 + REACH * dot(axis, now.right),
    y: SIZE / 2 + REACH * dot(axis, now.down),
    depth: dot(axis, now.forward),
  }));
  const drag = (event: PointerEvent) => {
    if (event.buttons === 0 || onButton(event)) return;
    turnBy(event.movementX * RADIANS_PER_PIXEL, event.movementY * RADIANS_PER_PIXEL);
  };
  const from = (axis: Vec3, depth: number) => viewFrom(depth < -0.999 ? (axis.map((v) => -v) as Vec3) : axis);
  return (
    <div
      class="gizmo"
      style={{ width: `${SIZE}px`, height: `${SIZE}px` }}
      role="group"
      aria-label="Axes"
      onPointerDown={(event) => onButton(event) || event.currentTarget.setPointerCapture(event.pointerId)}
      onPointerMove={drag}
    >
      <svg width={SIZE} height={SIZE} aria-hidden="true">
        {points
          .filter(({ name }) => name.startsWith("+"))
          .map(({ name, x, y }) => (
            <line key={name} class={`axis ${name[1]}`} x1={SIZE / 2} y1={SIZE / 2} x2={x} y2={y} />
          ))}
      </svg>
      {points.map(({ name, axis, x, y, depth }) => (
        <button
          key={name}
          type="button"
          class={`axis ${name[1]} ${name.startsWith("+") ? "plus" : "minus"}`}
          style={{ left: `${x}px`, top: `${y}px`, zIndex: Math.round(10 - 5 * depth) }}
          title={`Look from ${name}`}
          aria-label={`Look from ${name}`}
          onClick={() => from(axis, depth)}
        >
          {name.startsWith("+") ? name[1] : ""}
        </button>
      ))}
      <span class="gizmo-actions">
        <CommandButton icon="home" command="view.home" onClick={goHome} />
        <Button
          icon="front"
          label="This side is the front (saved in the project)"
          disabled={readOnly.value}
          onClick={() => camera.value && void run("asset.front", { camera: camera.value }).then(confirmFront)}
        />
      </span>
    </div>
  );
}
