/** Gaussians as they arrive, and their encoding into the textures that Spark's ExtSplats reads. */

import { toHalf } from "./half";
import { encodeSh, MAX_DRAWN_SH } from "./sh";

/** Y_00; base colour = 0.5 + SH_C0 * sh[0]. */
export const SH_C0 = 0.28209479177387814;

/** `count` Gaussians, activated values, one after the other (see splatpainter.splats.Splats). */
export interface Gaussians {
  count: number;
  /** null: only colours and opacities are given; the shapes stay. */
  shape: Shape | null;
  /** [count] 0..1. */
  opacities: Float32Array;
  /** [count * coefficients * 3]. */
  sh: Float32Array;
  /** (degree + 1)^2. */
  coefficients: number;
  /** Colours as texels hold them, in place of `sh`; without a shape also in place of the opacities. */
  packedColors?: PackedColors;
}

export interface PackedColors {
  /** [count * 3] half floats, the base colours. */
  base: Uint16Array;
  /** [count * (coefficients - 1)], see sh.ts; none: they stay. */
  codes: Uint32Array;
}

export interface Shape {
  /** [count * 3] world units. */
  means: Float32Array;
  /** [count * 3] standard deviations, > 0. */
  scales: Float32Array;
  /** [count * 4] w, x, y, z. */
  quats: Float32Array;
}

/**
 * The texels of a table of splats: 4 x 32 bit per Gaussian in each array.
 * `geometry`: x, y, z, opacity. `appearance`: r g | b sx | sy sz | rotation. `sh`: 0, 1, 2 or 4 arrays for degree 0 to 3.
 */
export interface Texels {
  geometry: Uint32Array;
  appearance: Uint32Array;
  sh: Uint32Array[];
}

const float = new Float32Array(1);
const bits = new Uint32Array(float.buffer);

/** How many arrays of SH texels a table of that many coefficients has. */
export function shArrays(coefficients: number): number {
  return coefficients >= 16 ? 4 : coefficients >= 9 ? 2 : coefficients >= 4 ? 1 : 0;
}

export function allocate(capacity: number, coefficients: number): Texels {
  const array = () => new Uint32Array(capacity * 4);
  return { geometry: array(), appearance: array(), sh: Array.from({ length: shArrays(coefficients) }, array) };
}

/** Write Gaussian `source` of `gaussians` as number `target` of `texels`. One that cannot be drawn gets opacity 0. */
export function encodeGaussian(texels: Texels, target: number, gaussians: Gaussians, source: number): void {
  const at = target * 4;
  const { geometry, appearance } = texels;
  const { packedColors, shape } = gaussians;
  if (shape || !packedColors) {
    const drawable = shape ? encodeShape(texels, at, shape, source) : true;
    const opacity = gaussians.opacities[source];
    geometry[at + 3] = drawable ? toHalf(opacity > 1 ? 1 : opacity) : 0; // above 1 means something else to Spark
  }
  if (packedColors) return copyColors(texels, at, packedColors, source, gaussians.coefficients - 1);

  const c = source * gaussians.coefficients * 3;
  const { sh } = gaussians;
  appearance[at] = toHalf(0.5 + SH_C0 * sh[c]) | (toHalf(0.5 + SH_C0 * sh[c + 1]) << 16);
  appearance[at + 1] = (appearance[at + 1] & 0xffff0000) | toHalf(0.5 + SH_C0 * sh[c + 2]);
  encodeHarmonics(texels.sh, at, sh, c + 3, Math.min(gaussians.coefficients - 1, MAX_DRAWN_SH));
}

/** Colours that need no encoding; a Gaussian that cannot be drawn keeps its opacity of 0. */
function copyColors(
  { appearance, sh }: Texels,
  at: number,
  { base, codes }: PackedColors,
  source: number,
  count: number,
): void {
  const c = source * 3;
  appearance[at] = base[c] | (base[c + 1] << 16);
  appearance[at + 1] = (appearance[at + 1] & 0xffff0000) | base[c + 2];
  const stored = Math.min(count, sh.length * 4);
  for (let k = 0; k < stored; k++) sh[k >> 2][at + (k & 3)] = codes[source * count + k];
}

/** Position, scales and rotation. Returns whether they can be drawn; zeros are written if not. */
function encodeShape(
  { geometry, appearance }: Texels,
  at: number,
  { means, scales, quats }: Shape,
  source: number,
): boolean {
  const k = source * 3;
  const q = source * 4;
  const [sx, sy, sz] = [scales[k], scales[k + 1], scales[k + 2]];
  const [w, x, y, z] = [quats[q], quats[q + 1], quats[q + 2], quats[q + 3]];
  const norm = Math.sqrt(w * w + x * x + y * y + z * z); // Math.hypot is many times slower
  const finite = Number.isFinite(means[k] + means[k + 1] + means[k + 2] + sx + sy + sz + norm);
  const drawable = finite && sx > 0 && sy > 0 && sz > 0 && norm > 0;
  for (let axis = 0; axis < 3; axis++) {
    float[0] = drawable ? means[k + axis] : 0;
    geometry[at + axis] = bits[0];
  }
  appearance[at + 1] = drawable ? toHalf(Math.log(sx)) << 16 : 0;
  appearance[at + 2] = drawable ? toHalf(Math.log(sy)) | (toHalf(Math.log(sz)) << 16) : 0;
  appearance[at + 3] = drawable ? encodeRotation(w / norm, x / norm, y / norm, z / norm) : 0;
  return drawable;
}

/** Coefficient k of PLY order lies at: array 0 words 0-3 for k 0-3, array 1 for 4-7, array 2 for 8-11, array 3 for 12-14. */
function encodeHarmonics(arrays: Uint32Array[], at: number, sh: Float32Array, from: number, count: number): void {
  const stored = Math.min(count, arrays.length * 4);
  for (let k = 0; k < stored; k++) {
    const c = from + k * 3;
    arrays[k >> 2][at + (k & 3)] = encodeSh(sh[c], sh[c + 1], sh[c + 2]);
  }
}

/** A unit quaternion as axis (octahedral, 10 + 10 bit) and angle (12 bit over 0..pi). */
export function encodeRotation(w: number, x: number, y: number, z: number): number {
  if (w < 0) [w, x, y, z] = [-w, -x, -y, -z];
  const sine = Math.sqrt(x * x + y * y + z * z);
  const angle = 2 * Math.atan2(sine, w);
  if (sine < 1e-6) [x, y, z] = [1, 0, 0];
  const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
  let u = x / sum;
  let v = y / sum;
  if (z < 0) [u, v] = [(1 - Math.abs(v)) * (u >= 0 ? 1 : -1), (1 - Math.abs(u)) * (v >= 0 ? 1 : -1)];
  const code =
    (Math.round((angle / Math.PI) * 4095) << 20) |
    (Math.round((v * 0.5 + 0.5) * 1023) << 10) |
    Math.round((u * 0.5 + 0.5) * 1023);
  return code >>> 0;
}

/** The quaternion [w, x, y, z] that the shader reads from it. */
export function decodeRotation(code: number): [number, number, number, number] {
  let x = ((code & 1023) / 1023) * 2 - 1;
  let y = (((code >>> 10) & 1023) / 1023) * 2 - 1;
  const z = 1 - Math.abs(x) - Math.abs(y);
  const t = Math.max(-z, 0);
  x += x >= 0 ? -t : t;
  y += y >= 0 ? -t : t;
  const norm = Math.hypot(x, y, z);
  const half = ((code >>> 20) / 4095) * Math.PI * 0.5;
  const s = Math.sin(half) / norm;
  return [Math.cos(half), x * s, y * s, z * s];
}
