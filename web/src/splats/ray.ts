/**
 * What a ray meets first among Gaussians as texels hold them: where the light that comes along it has been halved.
 * Exact for each Gaussian's largest density along the ray; no neighbour is asked. Pure.
 */

import { fromHalf } from "./half";
import { decodeRotation, type Texels } from "./texels";

/** Standard deviations to which a Gaussian is looked at; what is drawn ends there too. */
const REACH = 3.33;
/** Of the candidates that lie nearest along the ray. */
const MAX_CANDIDATES = 4096;

const floats = (words: Uint32Array): Float32Array => new Float32Array(words.buffer, words.byteOffset, words.length);

/**
 * Distance along the ray at which half of the light is gone; null where the Gaussians do not stop as much.
 * origin, direction (unit): three numbers each. `count`: of Gaussians that are there.
 */
export function hitDistance(
  { geometry, appearance }: Texels,
  count: number,
  origin: readonly number[],
  direction: readonly number[],
): number | null {
  const position = floats(geometry);
  const [ox, oy, oz] = origin;
  const [dx, dy, dz] = direction;
  const near: { at: number; alpha: number }[] = [];
  for (let i = 0, k = 0; i < count; i++, k += 4) {
    const opacity = geometry[k + 3] & 0xffff;
    if (opacity === 0) continue;
    const [x, y, z] = [position[k] - ox, position[k + 1] - oy, position[k + 2] - oz];
    const along = x * dx + y * dy + z * dz;
    const across = x * x + y * y + z * z - along * along;
    const s = appearance[k + 1] >>> 16;
    const t = appearance[k + 2];
    const largest = Math.exp(Math.max(fromHalf(s), fromHalf(t & 0xffff), fromHalf(t >>> 16)));
    const reach = REACH * largest;
    if (along < -reach || across > reach * reach) continue;
    const hit = peak(appearance, k, [x, y, z], direction);
    if (hit.at <= 0 || hit.squared > REACH * REACH) continue;
    near.push({ at: hit.at, alpha: Math.min(0.999, fromHalf(opacity)) * Math.exp(-hit.squared / 2) });
  }
  near.sort((a, b) => a.at - b.at);
  let light = 1;
  for (const { at, alpha } of near.slice(0, MAX_CANDIDATES)) {
    light *= 1 - alpha;
    if (light < 0.5) return at;
  }
  return null;
}

/** Where a Gaussian whose mean lies at `mean` from the origin is densest on the ray, and how many deviations squared off. */
function peak(appearance: Uint32Array, k: number, mean: number[], direction: readonly number[]) {
  const scales = [appearance[k + 1] >>> 16, appearance[k + 2] & 0xffff, appearance[k + 2] >>> 16].map((half) =>
    Math.exp(fromHalf(half)),
  );
  const [w, x, y, z] = decodeRotation(appearance[k + 3]);
  const rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ]; // of the transposed rotation: world to the Gaussian's axes
  let dd = 0;
  let md = 0;
  let mm = 0;
  for (let axis = 0; axis < 3; axis++) {
    const row = rows[axis];
    const d = (row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2]) / scales[axis];
    const m = (row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2]) / scales[axis];
    dd += d * d;
    md += m * d;
    mm += m * m;
  }
  return { at: md / dd, squared: Math.max(0, mm - (md * md) / dd) };
}
