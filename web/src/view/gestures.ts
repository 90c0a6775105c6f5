/** From pointers, wheel and keys to the camera: orbit, pan, dolly, pinch. Knows poses, no tools. */

import { dolly, orbit, pan, type Pose, type Vec3 } from "./camera";

export type Drag = "orbit" | "pan";

export interface Moves {
  pose: () => Pose | null;
  go: (pose: Pose) => void;
  up: () => Vec3;
  /** World units: how near one may come. */
  nearest: () => number;
  /** Height of the view on the screen, CSS pixels. */
  height: () => number;
}

/** Radians per pixel: a drag over 400 pixels turns by half a circle. */
const RADIANS_PER_PIXEL = Math.PI / 400;
const DOLLY_PER_PIXEL = 0.0012;

export class Gestures {
  private pointers = new Map<number, { x: number; y: number }>();
  private mode: Drag = "orbit";

  constructor(private readonly moves: Moves) {}

  /** How many fingers or buttons move the camera now. */
  get busy(): boolean {
    return this.pointers.size > 0;
  }

  down(event: PointerEvent, mode: Drag): void {
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.mode = mode;
  }

  move(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    const pose = this.moves.pose();
    if (!before || !pose) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (other) {
      const reach = (p: { x: number; y: number }) => Math.hypot(p.x - other.x, p.y - other.y) || 1;
      const closer = dolly(pose, reach(before) / reach(now), this.moves.nearest());
      this.moves.go(pan(closer, dx / 2, dy / 2, this.moves.height()));
    } else if (this.mode === "pan") {
      this.moves.go(pan(pose, dx, dy, this.moves.height()));
    } else {
      this.turn(dx * RADIANS_PER_PIXEL, dy * RADIANS_PER_PIXEL);
    }
  }

  up(event: PointerEvent): void {
    this.pointers.delete(event.pointerId);
  }

  wheel(event: WheelEvent): void {
    const pose = this.moves.pose();
    const lines = event.deltaMode === 1 ? 16 : 1;
    if (pose) this.moves.go(dolly(pose, Math.exp(event.deltaY * lines * DOLLY_PER_PIXEL), this.moves.nearest()));
  }

  /** Drag to the right: the asset turns with the hand. */
  turn(right: number, down: number): void {
    const pose = this.moves.pose();
    if (pose) this.moves.go(orbit(pose, -right, down, this.moves.up()));
  }
}
