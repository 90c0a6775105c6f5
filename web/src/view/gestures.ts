/**
 * From pointers, wheel and held keys to the camera: orbit about the point that was clicked, slide with the surface under
 * the hand, zoom to the cursor, pinch, fly, focus. Knows poses, no tools.
 */

import {
  focusOn,
  look,
  orbitAbout,
  pan,
  rayOf,
  step,
  target,
  zoomTo,
  type Pose,
  type Vec3,
  add,
  scale,
} from "./camera";

export type Drag = "orbit" | "pan" | "dolly";

export interface Moves {
  pose: () => Pose | null;
  go: (pose: Pose) => void;
  /** Go there smoothly. */
  glide: (pose: Pose) => void;
  up: () => Vec3;
  /** World units: how near one may come. */
  nearest: () => number;
  /** World units: the asset's radius. */
  extent: () => number;
  /** Of the view on the screen, CSS pixels. */
  frame: () => { left: number; top: number; width: number; height: number };
  /** The surface along a ray; null where there is none. */
  hit: (eye: Vec3, direction: Vec3) => Vec3 | null;
}

interface Finger {
  x: number;
  y: number;
}

/** Radians per pixel: a drag over 400 pixels turns by half a circle. */
const RADIANS_PER_PIXEL = Math.PI / 400;
const DOLLY_PER_PIXEL = 0.0012;
const DRAG_DOLLY_PER_PIXEL = 0.005;
/** Two presses are a double click within so much time and so few pixels. */
const DOUBLE_MS = 400;
const DOUBLE_PX = 8;
/** Radii of the asset per second; the wheel changes it while flying. */
const FLY_SPEED = 0.6;
const FLY_FASTER = 4;
/** Turns of the wheel within so much time are towards the same point. */
const WHEEL_MS = 250;
/** Of the way to a point that a double click goes. */
const FOCUS_SHARE = 0.55;

export const FLY_KEYS: readonly string[] = ["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE"];

export class Gestures {
  private readonly pointers = new Map<number, Finger>();
  private mode: Drag = "orbit";
  private pivot: Vec3 | null = null;
  private button = -1;
  private last = { time: 0, x: 0, y: 0, button: -1 };
  private wheeling: { time: number; x: number; y: number; point: Vec3 } | null = null;
  private readonly held = new Set<string>();
  private speed = FLY_SPEED;
  private flying = 0;
  private flew = false;
  private faster = false;

  constructor(private readonly moves: Moves) {}

  /** How many fingers or buttons move the camera now. */
  get busy(): boolean {
    return this.pointers.size > 0;
  }

  down(event: PointerEvent, mode: Drag): void {
    const at = { x: event.clientX, y: event.clientY };
    const { last } = this;
    const twice =
      event.timeStamp - last.time < DOUBLE_MS &&
      event.button === last.button &&
      Math.hypot(at.x - last.x, at.y - last.y) < DOUBLE_PX;
    this.last = { time: twice ? 0 : event.timeStamp, ...at, button: event.button };
    this.pointers.set(event.pointerId, at);
    this.mode = mode;
    this.button = event.button;
    this.flew = false;
    const pose = this.moves.pose();
    if (!pose) return;
    if (twice && this.pointers.size === 1) return this.focus(at.x, at.y);
    const [first, second] = [...this.pointers.values()];
    const middle = second ? { x: (first.x + second.x) / 2, y: (first.y + second.y) / 2 } : at;
    this.pivot = this.surface(middle);
  }

  move(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    const pose = this.moves.pose();
    if (!before || !pose) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (dx === 0 && dy === 0) return;
    if (other) {
      const reach = (p: Finger) => Math.hypot(p.x - other.x, p.y - other.y) || 1;
      const middle = { x: (now.x + other.x) / 2, y: (now.y + other.y) / 2 };
      const closer = zoomTo(pose, this.ahead(middle), reach(before) / reach(now), this.moves.nearest());
      this.moves.go(this.slide(closer, dx / 2, dy / 2));
    } else if (this.mode === "pan") {
      this.moves.go(this.slide(pose, dx, dy));
    } else if (this.mode === "dolly") {
      const factor = Math.exp((dy - dx) * DRAG_DOLLY_PER_PIXEL);
      this.moves.go(zoomTo(pose, this.pivot ?? target(pose), factor, this.moves.nearest()));
    } else if (this.flying || this.flew) {
      this.moves.go(look(pose, -dx * RADIANS_PER_PIXEL, dy * RADIANS_PER_PIXEL, this.moves.up()));
    } else {
      this.turn(dx * RADIANS_PER_PIXEL, dy * RADIANS_PER_PIXEL, this.pivot);
    }
  }

  /** The pointer moved while the camera must stay. */
  rest(event: PointerEvent): void {
    if (this.pointers.has(event.pointerId)) this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  up(event: PointerEvent): void {
    if (!this.pointers.delete(event.pointerId)) return;
    if (this.pointers.size === 0) this.stop();
    else this.pivot = this.surface([...this.pointers.values()][0]); // one of two fingers is left
  }

  wheel(event: WheelEvent): void {
    const pose = this.moves.pose();
    const lines = event.deltaMode === 1 ? 16 : 1;
    if (!pose) return;
    if (this.flying) {
      this.speed = Math.max(0.02, Math.min(20, this.speed * Math.exp(-event.deltaY * lines * DOLLY_PER_PIXEL)));
      return;
    }
    const { wheeling } = this;
    const same =
      wheeling &&
      event.timeStamp - wheeling.time < WHEEL_MS &&
      wheeling.x === event.clientX &&
      wheeling.y === event.clientY;
    const at = { x: event.clientX, y: event.clientY };
    const point = same ? wheeling.point : (this.surface(at) ?? this.ahead(at));
    this.wheeling = { time: event.timeStamp, ...at, point };
    const fine = event.ctrlKey ? 6 : 1; // a trackpad's pinch
    const factor = Math.exp(event.deltaY * lines * fine * DOLLY_PER_PIXEL);
    this.moves.go(zoomTo(pose, point, factor, this.moves.nearest()));
  }

  /** Nearer (factor < 1) or farther by keys, about the middle. */
  zoom(factor: number): void {
    const pose = this.moves.pose();
    if (pose) this.moves.go(zoomTo(pose, target(pose), factor, this.moves.nearest()));
  }

  /** Drag to the right: the asset turns with the hand. pivot: null: the target. */
  turn(right: number, down: number, pivot: Vec3 | null = null): void {
    const pose = this.moves.pose();
    if (pose) this.moves.go(orbitAbout(pose, pivot ?? target(pose), -right, down, this.moves.up()));
  }

  /** Look at the surface at a point of the screen, from nearer; nothing there: nothing happens. */
  focus(x: number, y: number): void {
    const pose = this.moves.pose();
    const point = this.surface({ x, y });
    if (!pose || !point) return;
    const distance = Math.hypot(...add(point, scale(pose.eye, -1)));
    this.moves.glide(focusOn(pose, point, Math.max(this.moves.nearest(), distance * FOCUS_SHARE)));
  }

  /** A key of FLY_KEYS or Shift went down or up; returns whether it flies: the right button is held. */
  fly(code: string, down: boolean): boolean {
    if (code.startsWith("Shift")) {
      this.faster = down;
      return false;
    }
    if (!down) {
      this.held.delete(code);
      return this.flew;
    }
    if (!FLY_KEYS.includes(code) || this.pointers.size === 0 || this.button !== 2) return false;
    this.held.add(code);
    this.flew = true;
    if (!this.flying) {
      let before = performance.now();
      const frame = (now: number) => {
        this.flying = this.held.size ? requestAnimationFrame(frame) : 0;
        this.flyStep(Math.min(0.1, Math.max(0, now - before) / 1000));
        before = now;
      };
      this.flying = requestAnimationFrame(frame);
    }
    return true;
  }

  private flyStep(seconds: number): void {
    const pose = this.moves.pose();
    if (!pose || !this.held.size) return;
    const axis = (plus: string, minus: string) => Number(this.held.has(plus)) - Number(this.held.has(minus));
    const by = this.speed * this.moves.extent() * seconds * (this.faster ? FLY_FASTER : 1);
    this.moves.go(step(pose, [axis("KeyD", "KeyA") * by, axis("KeyQ", "KeyE") * by, axis("KeyW", "KeyS") * by]));
  }

  /** Whatever is held is let go. */
  stop(): void {
    this.pointers.clear();
    this.held.clear();
    cancelAnimationFrame(this.flying);
    this.flying = 0;
    this.flew = this.faster = false;
    this.button = -1;
    this.pivot = null;
  }

  private ray({ x, y }: Finger): Vec3 | null {
    const pose = this.moves.pose();
    const { left, top, width, height } = this.moves.frame();
    return pose && rayOf(pose, (2 * (x - left)) / width - 1, (2 * (y - top)) / height - 1, width / height);
  }

  /** The surface at a point of the screen; null: none there. */
  private surface(at: Finger): Vec3 | null {
    const pose = this.moves.pose();
    const ray = this.ray(at);
    return pose && ray && this.moves.hit(pose.eye, ray);
  }

  /** The surface that was clicked or, without one, the target's plane at a point of the screen. */
  private ahead(at: Finger): Vec3 {
    const pose = this.moves.pose()!;
    const ray = this.ray(at)!;
    const cosine = ray[0] * pose.forward[0] + ray[1] * pose.forward[1] + ray[2] * pose.forward[2];
    return add(pose.eye, scale(ray, this.depth(pose) / cosine));
  }

  private depth(pose: Pose): number {
    if (!this.pivot) return pose.distance;
    const away = add(this.pivot, scale(pose.eye, -1));
    const depth = away[0] * pose.forward[0] + away[1] * pose.forward[1] + away[2] * pose.forward[2];
    return depth > 0 ? depth : pose.distance;
  }

  /** What was clicked moves with the hand. */
  private slide(pose: Pose, dx: number, dy: number): Pose {
    const moved = pan({ ...pose, distance: this.depth(pose) }, dx, dy, this.moves.frame().height);
    return { ...moved, distance: pose.distance };
  }
}
