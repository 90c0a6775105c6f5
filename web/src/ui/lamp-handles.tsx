/** Lamps of the light that is set, over the view: to be chosen, dragged, aimed. */

import { useRef } from "preact/hooks";

import { draggedAcross, draggedAlong, outlines } from "../lights/lamp-drag";
import { beginGesture, changeLights, letGo, selectedLamp, shownLights } from "../lights/light-layers";
import { AIMED, changedLamp, hexOf, type LampLight } from "../lights/lights";
import { camera, readOnly, state, tab } from "../state/store";
import { add, project, sub, type CameraJson, type Vec3 } from "../view/camera";

/** Pixels: of the lamp itself, by how bright it is, and where the handle along the view is beside it. */
const SMALLEST = 5;
const LARGEST = 11;
const BESIDE = 34;
const EDGE_PX = 24;
/** Of an arrow key. */
const NUDGE_PX = 10;
const KEYS: Record<string, readonly [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
};
type Part = "position" | "target";
interface Drag {
  id: number;
  part: Part;
  along: boolean;
  start: readonly [number, number];
  from: Vec3;
}

export function LampHandles() {
  const drag = useRef<Drag | null>(null);
  const now = camera.value;
  const { lamps } = shownLights.value;
  const stage = document.getElementById("stage");
  if (tab.value !== "light" || !now || !state.value || !stage || !lamps.length || readOnly.value) return null;
  const offset = state.value.asset.offset as Vec3; // the view is relative to it, lamps are not
  const shrink = stage.clientWidth / now.width; // CSS pixels per pixel of the view
  const chosen = lamps.find(({ id }) => id === selectedLamp.value);
  const screen = (point: readonly number[]): readonly [number, number] | null => {
    const [x, y, z] = project(now, sub(point as Vec3, offset));
    return z > 1e-6 ? [x * shrink, y * shrink] : null;
  };
  const move = (lamp: number, part: Part, from: Vec3, dx: number, dy: number, along: boolean) => {
    const local = sub(from, offset);
    const to = along ? draggedAlong(now, local, dy) : draggedAcross(now, local, dx / shrink, dy / shrink);
    void changeLights(changedLamp(shownLights.peek(), lamp, { [part]: add(to, offset) }));
  };
  const grab = (lamp: LampLight, part: Part, along: boolean) => (event: PointerEvent) => {
    if (event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    const handle = event.currentTarget as HTMLElement & SVGElement;
    handle.setPointerCapture(event.pointerId);
    handle.focus({ preventScroll: true });
    selectedLamp.value = lamp.id;
    beginGesture();
    const [start, from] = [[event.clientX, event.clientY] as const, lamp[part] as Vec3];
    drag.current = { id: lamp.id, part, along: along || event.shiftKey, start, from };
  };
  const pull = (event: PointerEvent) => {
    const held = drag.current;
    if (!held) return;
    event.stopPropagation();
    const [dx, dy] = [event.clientX - held.start[0], event.clientY - held.start[1]];
    if (
      event.shiftKey !== held.along &&
      event.pointerType === "mouse" &&
      !(event.target as Element).matches(".depth")
    ) {
      // The other way from here on: what was dragged so far stays.
      const lamp = shownLights.peek().lamps.find(({ id }) => id === held.id);
      if (lamp)
        drag.current = {
          ...held,
          along: event.shiftKey,
          start: [event.clientX, event.clientY],
          from: lamp[held.part] as Vec3,
        };
      return;
    }
    move(held.id, held.part, held.from, dx, dy, held.along);
  };
  const drop = (event: PointerEvent) => {
    if (!drag.current) return;
    event.stopPropagation();
    drag.current = null;
    void letGo();
  };
  const key = (lamp: LampLight, part: Part) => (event: KeyboardEvent) => {
    const step = KEYS[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat) beginGesture();
    move(lamp.id, part, lamp[part] as Vec3, NUDGE_PX * step[0], NUDGE_PX * step[1], event.shiftKey);
  };
  const handle = (lamp: LampLight, part: Part, along = false) => ({
    tabindex: 0,
    role: "button" as const,
    onPointerDown: grab(lamp, part, along),
    onPointerMove: pull,
    onPointerUp: drop,
    onPointerCancel: drop,
    onKeyDown: key(lamp, part),
    onKeyUp: () => void letGo(),
  });
  const brightest = Math.max(...lamps.map(({ intensity }) => intensity));
  return (
    <svg class="asset-handles lamp-handles" role="group" aria-label="Lamps">
      {chosen && <Outlines lamp={chosen} now={now} offset={offset} shrink={shrink} />}
      {chosen && AIMED.includes(chosen.kind) && <Aim lamp={chosen} screen={screen} {...handle(chosen, "target")} />}
      {lamps.map((lamp, k) => {
        const place = screen(lamp.position);
        if (!place) return null;
        // One that lies outside of what is seen waits at the edge.
        const sides = [stage.clientWidth, stage.clientHeight];
        const at = place.map((value, n) => Math.max(EDGE_PX, Math.min(sides[n] - EDGE_PX, value)));
        const outside = at.some((value, n) => value !== place[n]);
        const share = Math.max(0, 1 + Math.log10(lamp.intensity / brightest) / 2);
        const radius = SMALLEST + (LARGEST - SMALLEST) * share;
        const name = `${lamp.kind[0].toUpperCase()}${lamp.kind.slice(1)} ${k + 1}`;
        return (
          <g
            key={lamp.id}
            class={`lamp${lamp === chosen ? " chosen" : ""}${outside ? " outside" : ""}`}
            transform={`translate(${at[0]} ${at[1]})`}
            style={{ color: hexOf(lamp.color) }}
          >
            <circle class="halo" r={2 * radius} />
            <circle class="bulb" r={radius} />
            {lamp.kind !== "point" && <text y={radius + 13}>{name}</text>}
            <circle
              class="reach"
              {...handle(lamp, "position")}
              aria-label={`${name}: drag it, or arrow keys; with Shift along the view`}
            >
              <title>{`${name}, intensity ${lamp.intensity.toPrecision(3)}: drag; with Shift along the view`}</title>
            </circle>
            {lamp === chosen && (
              <g
                transform={`translate(${at[0] < 2 * BESIDE ? BESIDE : -BESIDE} ${at[1] < 2 * BESIDE ? BESIDE : -BESIDE})`}
              >
                <path class="arrows" d="M 0 -11 L 5 -4 H -5 Z M 0 11 L 5 4 H -5 Z" />
                <circle
                  class="reach depth"
                  {...handle(lamp, "position", true)}
                  aria-label={`${name}: drag up, away from here, or down`}
                >
                  <title>Drag up: farther away; down: nearer</title>
                </circle>
              </g>
            )}
          </g>
        );
      })}
    </svg>
  );
}

interface OutlineProps {
  lamp: LampLight;
  now: CameraJson;
  offset: Vec3;
  shrink: number;
}

/** How large it is, and what a spot reaches. */
function Outlines({ lamp, now, offset, shrink }: OutlineProps) {
  const lines = outlines(lamp).map((line) => line.map((point) => project(now, sub(point, offset))));
  return (
    <>
      {lines
        .filter((line) => line.every(([, , z]) => z > 1e-6))
        .map((line, k) => (
          <polyline key={k} class="outline" points={line.map(([x, y]) => `${x * shrink},${y * shrink}`).join(" ")} />
        ))}
    </>
  );
}

interface AimProps {
  lamp: LampLight;
  screen: (point: readonly number[]) => readonly [number, number] | null;
  [handler: string]: unknown;
}

/** Where it looks to. */
function Aim({ lamp, screen, ...handlers }: AimProps) {
  const [from, to] = [screen(lamp.position), screen(lamp.target)];
  if (!to) return null;
  return (
    <g>
      {from && <line class="outline" x1={from[0]} y1={from[1]} x2={to[0]} y2={to[1]} />}
      <g transform={`translate(${to[0]} ${to[1]})`}>
        <path class="cross" d="M -7 0 H 7 M 0 -7 V 7" />
        <circle class="reach" {...handlers} aria-label="Where it looks to: drag it, or arrow keys">
          <title>Where it looks to: drag; with Shift along the view</title>
        </circle>
      </g>
    </g>
  );
}
