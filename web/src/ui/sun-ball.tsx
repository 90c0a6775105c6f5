/** A ball on which a sun is dragged: where it is bright the light comes from. Arrow keys move it, too. */

import { useRef } from "preact/hooks";

import { ballPoint, nudged, shownPoint, spokenPlace, sunAt, type SunPlace } from "../lights/sun-ball";

interface Props {
  label: string;
  sun: SunPlace;
  /** Of the light, #rrggbb. */
  color: string;
  /** Azimuth of the view, degrees: the ball is seen from there. */
  viewAzimuth?: number;
  disabled?: boolean;
  onInput: (place: SunPlace) => void;
  /** When let go. */
  onChange?: (place: SunPlace) => void;
}

/** Radius of the ball in the drawing's units, of which the box has 100. */
const RADIUS = 44;
const KEY_DEGREES = 5;
const FINE_DEGREES = 1;
const STEPS: Record<string, readonly [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

export function SunBall({ label, sun, color, viewAzimuth = 0, disabled, onInput, onChange }: Props) {
  const box = useRef<HTMLDivElement>(null);
  const held = useRef(false);
  const point = ballPoint(sun, viewAzimuth);
  const { x, y, behind } = shownPoint(point);
  const placeOf = (event: PointerEvent): SunPlace => {
    const { left, top, width, height } = box.current!.getBoundingClientRect();
    const unit = (width * RADIUS) / 100;
    return sunAt(
      { x: (event.clientX - left - width / 2) / unit, y: -(event.clientY - top - height / 2) / unit },
      viewAzimuth,
    );
  };
  const drag = (event: PointerEvent) => {
    if (!held.current) return;
    if (event.buttons === 0) return void (held.current = false); // it went up unseen
    onInput(placeOf(event));
  };
  const key = (event: KeyboardEvent) => {
    const step = STEPS[event.key];
    if (!step || disabled) return;
    event.preventDefault();
    event.stopPropagation();
    const by = event.shiftKey ? FINE_DEGREES : KEY_DEGREES;
    const place = nudged(sun, by * step[0], by * step[1]);
    onInput(place);
    onChange?.(place);
  };
  const shine = `sun-shine-${label.replace(/\W+/g, "-")}`;
  const [cx, cy] = [50 + RADIUS * x, 50 - RADIUS * y];
  return (
    <div
      ref={box}
      class="sun-ball"
      role="slider"
      tabIndex={disabled ? -1 : 0}
      aria-label={label}
      aria-disabled={disabled}
      aria-valuemin={-180}
      aria-valuemax={180}
      aria-valuenow={Math.round(sun.azimuth)}
      aria-valuetext={spokenPlace(sun)}
      onKeyDown={key}
      onPointerDown={(event) => {
        if (disabled || event.button !== 0) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        held.current = true;
        onInput(placeOf(event));
      }}
      onPointerMove={drag}
      onPointerUp={(event) => {
        if (!held.current) return;
        held.current = false;
        onChange?.(placeOf(event));
      }}
      onPointerCancel={() => (held.current = false)}
    >
      <svg viewBox="0 0 100 100" aria-hidden="true">
        <radialGradient id={shine} cx={cx} cy={cy} r={1.7 * RADIUS} gradientUnits="userSpaceOnUse">
          <stop offset="0" stop-color={behind ? "#3a3d43" : color} />
          <stop offset="0.45" stop-color={behind ? "#2c2e33" : "#84878d"} />
          <stop offset="1" stop-color="#1a1b1e" />
        </radialGradient>
        <circle class="ball" cx="50" cy="50" r={RADIUS} fill={`url(#${shine})`} />
        {behind && <circle class="rim" cx="50" cy="50" r={RADIUS} stroke={color} />}
        <path class="horizon" d={`M ${50 - RADIUS} 50 H ${50 + RADIUS}`} />
        <circle class={`sun${behind ? " behind" : ""}`} cx={cx} cy={cy} r="6" fill={behind ? "none" : color} />
      </svg>
    </div>
  );
}
