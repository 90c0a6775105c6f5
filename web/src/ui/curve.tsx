/** A tone curve: points to drag, a click adds one, a double click takes one away. */

import { useRef } from "preact/hooks";

type Point = [number, number];
const MIN_POINT_DISTANCE = 0.02;
const WIDTH = 270;
const HEIGHT = 120;

/** Keep points ascending and inside; the end points stay at 0 and 1. */
export function movePoint(points: Point[], index: number, to: Point): Point[] {
  const clamp = (v: number, low: number, high: number) => Math.max(low, Math.min(high, v));
  const last = points.length - 1;
  const x =
    index === 0
      ? 0
      : index === last
        ? 1
        : clamp(to[0], points[index - 1][0] + MIN_POINT_DISTANCE, points[index + 1][0] - MIN_POINT_DISTANCE);
  return points.map((point, k) => (k === index ? [x, clamp(to[1], 0, 1)] : point));
}

export function Curve({ points, onChange }: { points: Point[]; onChange: (points: Point[]) => void }) {
  const box = useRef<SVGSVGElement>(null);
  const dragged = useRef<number | null>(null);
  const all: Point[] = points.length
    ? points
    : [
        [0, 0],
        [1, 1],
      ];
  const done = (next: Point[]) => onChange(next.length === 2 && next[0][1] === 0 && next[1][1] === 1 ? [] : next);
  const at = (event: PointerEvent): Point => {
    const frame = box.current!.getBoundingClientRect();
    return [(event.clientX - frame.left) / frame.width, 1 - (event.clientY - frame.top) / frame.height];
  };
  const down = (event: PointerEvent) => {
    const here = at(event);
    const near = all.findIndex(([x, y]) => Math.hypot(x - here[0], y - here[1]) < 0.06);
    box.current!.setPointerCapture(event.pointerId);
    if (near >= 0) return void (dragged.current = near);
    if (all.length >= 16) return;
    const next = [...all, here].sort((a, b) => a[0] - b[0]);
    dragged.current = next.indexOf(here);
    done(movePoint(next, dragged.current, here));
  };
  const label = "Tone curve; arrow keys move the point in focus";
  return (
    <svg
      ref={box}
      class="curve"
      viewBox={`0 0 ${WIDTH} ${HEIGHT}`}
      preserveAspectRatio="none"
      role="group"
      aria-label={label}
      onPointerDown={down}
      onPointerMove={(event) => dragged.current !== null && done(movePoint(all, dragged.current, at(event)))}
      onPointerUp={() => (dragged.current = null)}
    >
      <path class="curve-grid" d="M67.5 0V120M135 0V120M202.5 0V120M0 30H270M0 60H270M0 90H270M0 120L270 0" />
      <polyline points={all.map(([x, y]) => `${x * WIDTH},${(1 - y) * HEIGHT}`).join(" ")} />
      {all.map(([x, y], k) => (
        <circle
          key={k}
          cx={x * WIDTH}
          cy={(1 - y) * HEIGHT}
          r="5"
          tabIndex={0}
          role="slider"
          aria-label={`Point ${k + 1}`}
          aria-valuenow={Math.round(y * 100)}
          aria-valuemin={0}
          aria-valuemax={100}
          onDblClick={() => k > 0 && k < all.length - 1 && done(all.filter((_, other) => other !== k))}
          onKeyDown={(event) => {
            const step = { ArrowUp: [0, 0.02], ArrowDown: [0, -0.02], ArrowLeft: [-0.02, 0], ArrowRight: [0.02, 0] }[
              event.key
            ];
            if (!step) return;
            event.preventDefault();
            event.stopPropagation();
            done(movePoint(all, k, [x + step[0], y + step[1]]));
          }}
        />
      ))}
    </svg>
  );
}
