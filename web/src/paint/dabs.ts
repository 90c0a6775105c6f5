/**
 * A stroke as dabs: where along the pen's path they fall, how each is sized and turned by pressure, jitter and the
 * surface, and the pixels that it covers. Pure; the same path with the same seed is the same picture.
 */

import { random, spread } from "./random";
import { clip, falloff, NOTHING, union, type Mask, type Point, type Rect } from "./raster";
import { coverOf, type TipImage } from "./tips";

/** Columns of [a, b; c, d]: pixels of the view that the tip's u and v axes reach (the rim of the unit circle). */
export type Frame = readonly [a: number, b: number, c: number, d: number];

/** How the dabs of one stroke look. Lengths in pixels of the view. */
export interface Brush {
  /** The tip's axes at a pixel for a brush of full size that is not turned. */
  frame: (x: number, y: number) => Frame;
  /** null: round, by its hardness. */
  tip: TipImage | null;
  hardness: number;
  flow: number;
  pressureSize: boolean;
  pressureFlow: boolean;
  /** Degrees, clockwise on the view. */
  angle: number;
  /** Of the v axis, 0..1: a flat brush. */
  roundness: number;
  /** Whether dabs turn with the path. */
  alongPath: boolean;
  /** Between two dabs, as a share of the brush's diameter. */
  spacing: number;
  /** Shares, 0..1: by how much a dab may be smaller, fainter, turned (1: any way), and beside the path (1: a diameter). */
  sizeJitter: number;
  opacityJitter: number;
  angleJitter: number;
  scatter: number;
  seed: number;
}

/** One dab. */
export interface Dab {
  x: number;
  y: number;
  frame: Frame;
  flow: number;
}

/** A pen that is not pressed at all still marks: its share of the size. */
const MIN_PRESSURE = 0.1;
/** Smallest radius of a dab, pixels. */
const MIN_RADIUS_PX = 0.5;
/** Between dabs, pixels. */
const MIN_STEP_PX = 0.5;
const SIZE = 1;
const OPACITY = 2;
const ANGLE = 3;
const SIDEWAYS = 4;

/** A frame that is round on the screen. */
export const roundFrame = (radius: number): Frame => [radius, 0, 0, radius];

/** Radius of a disc of the same area. */
export const meanRadius = ([a, b, c, d]: Frame): number => Math.sqrt(Math.abs(a * d - b * c));

/** The frame scaled, turned by degrees within its own plane, and flattened. */
export function shaped([a, b, c, d]: Frame, scale: number, degrees: number, roundness: number): Frame {
  const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  const v = scale * Math.max(0.02, roundness);
  return [scale * (a * cos + b * sin), v * (b * cos - a * sin), scale * (c * cos + d * sin), v * (d * cos - c * sin)];
}

const press = (on: boolean, pressure: number): number => (on ? MIN_PRESSURE + (1 - MIN_PRESSURE) * pressure : 1);

/** The dab of a brush at a point of its path. index: of the dab, from 0; heading: of the path, degrees. */
export function dabAt(brush: Brush, at: Point, index: number, heading: number): Dab {
  const { seed } = brush;
  const full = brush.frame(at.x, at.y);
  const smaller = 1 - brush.sizeJitter * random(seed, index, SIZE);
  const radius = meanRadius(full);
  const scale = Math.max(MIN_RADIUS_PX / radius, press(brush.pressureSize, at.pressure) * smaller);
  const turned = brush.angle + (brush.alongPath ? heading : 0) + 180 * brush.angleJitter * spread(seed, index, ANGLE);
  const flow =
    brush.flow * press(brush.pressureFlow, at.pressure) * (1 - brush.opacityJitter * random(seed, index, OPACITY));
  let { x, y } = at;
  if (brush.scatter > 0) {
    const aside = 2 * brush.scatter * spread(seed, index, SIDEWAYS);
    const away = (heading * Math.PI) / 180 + Math.PI / 2;
    const [u, v] = [aside * Math.cos(away), aside * Math.sin(away)];
    x += full[0] * u + full[1] * v;
    y += full[2] * u + full[3] * v;
  }
  return { x, y, frame: shaped(full, scale, turned, brush.roundness), flow };
}

/** Add a dab to the mask: c += (1 - c) * flow * cover. Pixel centres lie at +0.5. Returns the pixels that it reached. */
export function stamp(mask: Mask, { x, y, frame, flow }: Dab, tip: TipImage | null, hardness: number): Rect {
  const [a, b, c, d] = frame;
  const determinant = a * d - b * c;
  const radius = Math.sqrt(Math.abs(determinant));
  if (!(radius > 1e-3)) return NOTHING;
  const soft = 1; // a tip that is smaller than a pixel still reaches its neighbours
  const [reachX, reachY] = tip
    ? [Math.abs(a) + Math.abs(b) + soft, Math.abs(c) + Math.abs(d) + soft]
    : [Math.hypot(a, b) + soft, Math.hypot(c, d) + soft];
  const rect = clip(
    {
      x: Math.floor(x - reachX),
      y: Math.floor(y - reachY),
      width: Math.ceil(2 * reachX) + 2,
      height: Math.ceil(2 * reachY) + 2,
    },
    mask,
  );
  // the shorter half axis decides how soft an edge of one pixel is
  const longest = Math.sqrt(
    (a * a + b * b + c * c + d * d + Math.hypot(a * a + c * c - b * b - d * d, 2 * (a * b + c * d))) / 2,
  );
  const least = Math.max(Math.abs(determinant) / longest, 1e-3);
  for (let j = rect.y; j < rect.y + rect.height; j++) {
    for (let i = rect.x; i < rect.x + rect.width; i++) {
      const [dx, dy] = [i + 0.5 - x, j + 0.5 - y];
      const u = (d * dx - b * dy) / determinant;
      const v = (a * dy - c * dx) / determinant;
      const cover =
        flow *
        (tip ? coverOf(tip, u, v, radius) : falloff(Math.hypot(u, v) * least, { radius: least, hardness, flow: 1 }));
      if (cover > 0) {
        const at = j * mask.width + i;
        mask.data[at] += (1 - mask.data[at]) * cover;
      }
    }
  }
  return rect;
}

/** Dabs along a path that comes in pieces. */
export class DabPath {
  private last: Point | null = null;
  private left = 0;
  private count = 0;
  /** The first dab of a brush that turns with the path, until it has a direction. */
  private waiting = false;
  private heading = 0;

  constructor(
    private readonly mask: Mask,
    private readonly brush: Brush,
  ) {}

  /** Start there. Returns the pixels reached, as all of these do. */
  down(at: Point): Rect {
    [this.last, this.left, this.count] = [at, 0, 0];
    this.waiting = this.brush.alongPath || this.brush.scatter > 0;
    return this.waiting ? NOTHING : this.put(at);
  }

  /** Evenly spaced dabs from where it was; the pressure is interpolated. */
  move(to: Point): Rect {
    const from = this.last;
    if (!from) return NOTHING;
    const length = Math.hypot(to.x - from.x, to.y - from.y);
    if (length < 1e-9) return NOTHING;
    this.heading = (Math.atan2(to.y - from.y, to.x - from.x) * 180) / Math.PI;
    let rect = NOTHING;
    if (this.waiting) {
      this.waiting = false;
      rect = this.put(from);
    }
    let at = -this.left;
    for (;;) {
      const here = between(from, to, Math.max(0, Math.min(1, at / length)));
      const step = this.step(here);
      if (at + step > length) break;
      at += step;
      rect = union(rect, this.put(between(from, to, at / length)));
    }
    this.left = length - at;
    this.last = to;
    return rect;
  }

  /** The end: a click leaves a dab, too. */
  up(): Rect {
    const rect = this.waiting && this.last ? this.put(this.last) : NOTHING;
    this.last = null;
    this.waiting = false;
    return rect;
  }

  private step(at: Point): number {
    const { frame, pressureSize, roundness, spacing, alongPath } = this.brush;
    const radius = meanRadius(frame(at.x, at.y)) * press(pressureSize, at.pressure);
    const across = alongPath ? 1 : Math.sqrt(Math.max(0.02, roundness));
    return Math.max(MIN_STEP_PX, 2 * radius * across * spacing);
  }

  private put(at: Point): Rect {
    return stamp(this.mask, dabAt(this.brush, at, this.count++, this.heading), this.brush.tip, this.brush.hardness);
  }
}

function between(from: Point, to: Point, t: number): Point {
  return {
    x: from.x + (to.x - from.x) * t,
    y: from.y + (to.y - from.y) * t,
    pressure: from.pressure + (to.pressure - from.pressure) * t,
  };
}

/**
 * A steady hand: the brush hangs on a string of `length` pixels and moves only when it is pulled, so how often the pen
 * reports does not matter. At the end it goes to where the pen is.
 */
export class Stabiliser {
  private at: Point | null = null;

  constructor(private readonly length: number) {}

  down(pen: Point): Point {
    return (this.at = pen);
  }

  /** Where the brush goes; null: the string is slack. */
  move(pen: Point): Point | null {
    if (!this.at) return null;
    const away = Math.hypot(pen.x - this.at.x, pen.y - this.at.y);
    if (away <= this.length) return null;
    const t = 1 - this.length / away;
    const { x, y } = between(this.at, pen, t);
    return (this.at = { x, y, pressure: pen.pressure });
  }

  /** The brush, to be shown on its string. */
  get brush(): Point | null {
    return this.at;
  }
}
