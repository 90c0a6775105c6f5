/** What a brush presses on the view: built-in tips and textures, made by formulas, and pictures as tips. Pure. */

import { random } from "./random";

/** How much a tip covers, 0..1, on a square whose inscribed circle is the brush's size. */
export interface TipImage {
  size: number;
  data: Float32Array;
  /** The same at half the size, and so on: for dabs that are smaller. */
  half: TipImage | null;
}

/** Width and height of the built-in tips and of pictures as tips. */
export const TIP_PX = 96;
/** ... and of the textures, which repeat. */
export const TEXTURE_PX = 128;
/** What a picture's tip may be made of, pixels of its longer side. */
export const MAX_TIP_PICTURE_PX = 1024;

export const BUILT_IN_TIPS = {
  round: "Round",
  square: "Square",
  chalk: "Chalk",
  bristle: "Bristles",
  spray: "Spray",
  sponge: "Sponge",
  leaf: "Leaf",
  star: "Star",
} as const;
export type BuiltInTip = keyof typeof BUILT_IN_TIPS;

export const TEXTURES = {
  none: "None",
  paper: "Paper",
  canvas: "Canvas",
  grain: "Grain",
  scratches: "Scratches",
  halftone: "Dots",
} as const;
export type Texture = keyof typeof TEXTURES;

const clamp = (v: number): number => Math.max(0, Math.min(1, v));
const ramp = (v: number, from: number, to: number): number => {
  const t = clamp((v - from) / (to - from));
  return t * t * (3 - 2 * t);
};

/** Value noise 0..1 at (x, y) in cells, repeating every `period` cells (`down`: those of y). */
function noise(x: number, y: number, period: number, seed: number, down = period): number {
  const [ix, iy] = [Math.floor(x), Math.floor(y)];
  const [fx, fy] = [ramp(x - ix, 0, 1), ramp(y - iy, 0, 1)];
  const wrap = (v: number, cells: number) => ((v % cells) + cells) % cells;
  const at = (dx: number, dy: number) => random(seed, wrap(ix + dx, period) * 8191 + wrap(iy + dy, down));
  const top = at(0, 0) + (at(1, 0) - at(0, 0)) * fx;
  const low = at(0, 1) + (at(1, 1) - at(0, 1)) * fx;
  return top + (low - top) * fy;
}

/** A round spot of a tip: its centre, where its edge begins and ends, and its cover. */
interface Dot {
  u: number;
  v: number;
  outer: number;
  inner: number;
  cover: number;
}

const HAIRS = Array.from({ length: 46 }, (_, k): Dot => {
  const [angle, radius] = [2.39996 * k, 0.93 * Math.sqrt((k + 0.5) / 46)]; // sunflower seeds
  const hair = 0.035 + 0.055 * random(21, k);
  const cover = 0.35 + 0.65 * random(22, k);
  return { u: radius * Math.cos(angle), v: radius * Math.sin(angle), outer: hair + 0.03, inner: hair - 0.02, cover };
});
const DROPS = Array.from({ length: 150 }, (_, k): Dot => {
  const radius = 0.96 * random(31, k) ** 0.75;
  const angle = 2 * Math.PI * random(32, k);
  const drop = 0.012 + 0.03 * random(33, k) ** 3;
  return { u: radius * Math.cos(angle), v: radius * Math.sin(angle), outer: drop + 0.022, inner: drop, cover: 1 };
});

/** The densest of the dots at (u, v). */
function dots(spots: readonly Dot[], u: number, v: number): number {
  let densest = 0;
  for (const spot of spots) {
    const [du, dv] = [u - spot.u, v - spot.v];
    if (du * du + dv * dv >= spot.outer * spot.outer) continue; // ramp would be 0
    densest = Math.max(densest, spot.cover * ramp(Math.hypot(du, dv), spot.outer, spot.inner));
  }
  return densest;
}

/** Cover of a tip at (u, v), the circle of the brush being the unit circle. */
const SHAPES: Record<Exclude<BuiltInTip, "round">, (u: number, v: number) => number> = {
  square: (u, v) => ramp(Math.max(Math.abs(u), Math.abs(v)), 0.86, 0.8),
  chalk: (u, v) => {
    const r = Math.hypot(u, v);
    const rough = 0.6 * noise(8 * u + 20, 8 * v + 20, 64, 11) + 0.4 * noise(22 * u + 60, 22 * v + 60, 256, 12);
    return ramp(r, 1, 0.8) * ramp(rough, 0.36, 0.62);
  },
  bristle: (u, v) => dots(HAIRS, u, v),
  spray: (u, v) => dots(DROPS, u, v),
  sponge: (u, v) => {
    const r = Math.hypot(u, v);
    const holes = 0.55 * noise(5 * u + 20, 5 * v + 20, 64, 41) + 0.45 * noise(13 * u + 40, 13 * v + 40, 128, 42);
    return ramp(r + 0.35 * (holes - 0.5), 0.95, 0.78) * ramp(holes, 0.4, 0.54);
  },
  leaf: (u, v) => {
    const half = 0.44 * Math.cos((Math.PI / 2) * clamp(Math.abs(u) / 0.97)) ** 0.8;
    return ramp(Math.abs(v), half, half - 0.06) * (Math.abs(u) < 0.97 ? 1 : 0) * (Math.abs(v) < 0.018 ? 0.35 : 1);
  },
  star: (u, v) => {
    const angle = Math.atan2(u, -v);
    const part = Math.PI / 5;
    const turned = Math.abs(((((angle % (2 * part)) + 3 * part) % (2 * part)) - part) as number);
    const r = Math.hypot(u, v);
    // an edge from a point of the star to the corner between two
    const [tip, corner] = [0.9, 0.38];
    const [x, y] = [r * Math.cos(part - turned), r * Math.sin(part - turned)];
    const [ex, ey] = [corner * Math.cos(part) - tip, corner * Math.sin(part)];
    const away = (ex * y - ey * (x - tip)) / Math.hypot(ex, ey);
    return ramp(away, -0.04, 0.02);
  },
};

const tips = new Map<string, TipImage>();

/** A built-in tip; null for "round", which is a formula of its hardness. */
export function builtInTip(name: BuiltInTip): TipImage | null {
  if (name === "round") return null;
  const there = tips.get(name);
  if (there) return there;
  const data = new Float32Array(TIP_PX * TIP_PX);
  const [shape, at] = [SHAPES[name], (k: number) => ((k + 0.5) / TIP_PX) * 2 - 1];
  for (let j = 0; j < TIP_PX; j++) for (let i = 0; i < TIP_PX; i++) data[j * TIP_PX + i] = shape(at(i), at(j));
  const made = withHalves(TIP_PX, data);
  tips.set(name, made);
  return made;
}

/** A tip with its smaller versions, each the mean of 2 x 2 pixels. */
export function withHalves(size: number, data: Float32Array): TipImage {
  if (size < 8) return { size, data, half: null };
  const small = size >> 1;
  const means = new Float32Array(small * small);
  for (let j = 0; j < small; j++)
    for (let i = 0; i < small; i++) {
      const at = 2 * j * size + 2 * i;
      means[j * small + i] = (data[at] + data[at + 1] + data[at + size] + data[at + size + 1]) / 4;
    }
  return { size, data, half: withHalves(small, means) };
}

/**
 * A picture (RGBA, straight alpha) as a tip: what is opaque where it has transparency, else what is dark. Its longer
 * side becomes the brush's size.
 */
export function tipOfPicture({
  width,
  height,
  data,
}: {
  width: number;
  height: number;
  data: Uint8ClampedArray;
}): Float32Array {
  let transparent = false;
  for (let k = 3; k < data.length; k += 4) transparent ||= data[k] < 250;
  const longer = Math.max(width, height);
  const out = new Float32Array(TIP_PX * TIP_PX);
  const total = new Float32Array(TIP_PX * TIP_PX);
  // from the finer grid to the coarser one: every pixel of the picture counts
  const scale = TIP_PX / longer;
  const [left, top] = [(TIP_PX - width * scale) / 2, (TIP_PX - height * scale) / 2];
  const steps = Math.max(1, Math.ceil(scale));
  for (let y = 0; y < height * steps; y++)
    for (let x = 0; x < width * steps; x++) {
      const at = (Math.floor(y / steps) * width + Math.floor(x / steps)) * 4;
      const dark = 1 - (0.3 * data[at] + 0.59 * data[at + 1] + 0.11 * data[at + 2]) / 255;
      const [i, j] = [Math.floor(left + ((x + 0.5) / steps) * scale), Math.floor(top + ((y + 0.5) / steps) * scale)];
      if (i < 0 || j < 0 || i >= TIP_PX || j >= TIP_PX) continue;
      out[j * TIP_PX + i] += transparent ? data[at + 3] / 255 : dark;
      total[j * TIP_PX + i]++;
    }
  return out.map((v, k) => (total[k] > 0 ? clamp(v / total[k]) : 0));
}

/** Cover of a tip at (u, v), for a dab of `radius` pixels; 0 outside its square. */
export function coverOf(tip: TipImage, u: number, v: number, radius: number): number {
  let level = tip;
  while (level.half && level.size > 2.8 * radius) level = level.half;
  const { size, data } = level;
  const [x, y] = [((u + 1) / 2) * size - 0.5, ((v + 1) / 2) * size - 0.5];
  if (x <= -1 || y <= -1 || x >= size || y >= size) return 0;
  const [ix, iy] = [Math.floor(x), Math.floor(y)];
  const [fx, fy] = [x - ix, y - iy];
  const at = (i: number, j: number) => (i < 0 || j < 0 || i >= size || j >= size ? 0 : data[j * size + i]);
  const upper = at(ix, iy) * (1 - fx) + at(ix + 1, iy) * fx;
  const lower = at(ix, iy + 1) * (1 - fx) + at(ix + 1, iy + 1) * fx;
  return upper * (1 - fy) + lower * fy;
}

const WEAVE = (2 * Math.PI * 16) / TEXTURE_PX;
const GRAINS: Record<Exclude<Texture, "none">, (x: number, y: number) => number> = {
  paper: (x, y) => {
    const at = (cells: number, seed: number) => noise((x * cells) / TEXTURE_PX, (y * cells) / TEXTURE_PX, cells, seed);
    return ramp(0.45 * at(24, 51) + 0.35 * at(48, 52) + 0.2 * at(96, 53), 0.25, 0.7);
  },
  canvas: (x, y) => {
    const over = Math.sin(x * WEAVE + (Math.floor((y * 16) / TEXTURE_PX) % 2) * Math.PI) > 0;
    const across = Math.abs(Math.sin(((over ? x : y) * WEAVE) / 2));
    return 0.25 + 0.75 * across * (0.8 + 0.2 * noise(x / 2, y / 2, TEXTURE_PX / 2, 54));
  },
  grain: (x, y) => (random(55, Math.floor(x) * 8191 + Math.floor(y)) > 0.42 ? 1 : 0),
  scratches: (x, y) => {
    // lines at 45 degrees repeat with the tile
    const line = noise(((x + y) * 40) / TEXTURE_PX, ((x - y) * 2) / TEXTURE_PX, 40, 56, 2);
    return ramp(line, 0.3, 0.5);
  },
  halftone: (x, y) => {
    const cell = TEXTURE_PX / 16;
    const [dx, dy] = [(x % cell) - cell / 2, (y % cell) - cell / 2];
    return ramp(Math.hypot(dx, dy), cell * 0.46, cell * 0.3);
  },
};
const grains = new Map<string, Float32Array>();

/** [TEXTURE_PX²] of a texture, 0..1; null for "none". */
export function textureTile(name: Texture): Float32Array | null {
  if (name === "none") return null;
  const there = grains.get(name);
  if (there) return there;
  const tile = new Float32Array(TEXTURE_PX * TEXTURE_PX);
  const grain = GRAINS[name];
  for (let y = 0; y < TEXTURE_PX; y++)
    for (let x = 0; x < TEXTURE_PX; x++) tile[y * TEXTURE_PX + x] = grain(x + 0.5, y + 0.5);
  grains.set(name, tile);
  return tile;
}

/** How much a texture lets through at a pixel, 0..1. scale: pixels of the view per pixel of the texture; depth: 0..1. */
export function grainAt(tile: Float32Array, x: number, y: number, scale: number, depth: number): number {
  const wrap = (v: number) => ((v % TEXTURE_PX) + TEXTURE_PX) % TEXTURE_PX;
  const [u, v] = [(x + 0.5) / scale - 0.5, (y + 0.5) / scale - 0.5];
  const [iu, iv] = [Math.floor(u), Math.floor(v)];
  const [fu, fv] = [u - iu, v - iv];
  const at = (i: number, j: number) => tile[wrap(j) * TEXTURE_PX + wrap(i)];
  const upper = at(iu, iv) * (1 - fu) + at(iu + 1, iv) * fu;
  const lower = at(iu, iv + 1) * (1 - fu) + at(iu + 1, iv + 1) * fu;
  return 1 - depth * (1 - (upper * (1 - fv) + lower * fv));
}
