/** The asset inside a self-contained page: what splatpainter/server/html_viewer.py packed, as one snapshot. */

import type { Frame } from "../net/frames";
import { fromHalf } from "../splats/half";
import { decodeRotation } from "../splats/texels";
import type { CameraJson, Vec3 } from "../view/camera";

/** The JSON beside the Gaussians. */
export interface Scene {
  name: string;
  count: number;
  /** Per Gaussian and channel: 1, 4, 9 or 16. */
  coefficients: number;
  antialiased: boolean;
  center: Vec3;
  radius: number;
  up: Vec3;
  camera: CameraJson;
  /** Turn until somebody takes hold of it. */
  turning: boolean;
}

/** `planes` of a table with rows of `width` bytes: all first bytes, all second ones, ...; back to rows. */
export function unplaned(planes: Uint8Array, count: number, width: number): ArrayBuffer {
  const rows = new Uint8Array(count * width);
  for (let k = 0; k < width; k++) {
    const plane = planes.subarray(k * count, (k + 1) * count);
    for (let i = 0, at = k; i < count; i++, at += width) rows[at] = plane[i];
  }
  return rows.buffer;
}

/** The Gaussians as a frame that the viewer shows. Throws where there are too few or too many bytes. */
export function readGaussians(data: Uint8Array, { count, coefficients }: Scene): Frame {
  const widths = [12, 2, 6, 4, 6, 4 * (coefficients - 1)];
  const expected = count * widths.reduce((sum, width) => sum + width, 0);
  if (data.length !== expected) throw new Error(`expected ${expected} bytes of Gaussians, got ${data.length}`);
  let at = 0;
  const tables = widths.map((width) => unplaned(data.subarray(at, (at += width * count)), count, width));
  const [means, opacities, scales, rotations, base, codes] = tables;
  const logScales = new Uint16Array(scales);
  const words = new Uint32Array(rotations);
  const quats = new Float32Array(count * 4);
  for (let k = 0; k < count; k++) quats.set(decodeRotation(words[k]), k * 4);
  const gaussians = {
    count,
    shape: {
      means: new Float32Array(means),
      scales: Float32Array.from(logScales, (h) => Math.exp(fromHalf(h))),
      quats,
    },
    opacities: Float32Array.from(new Uint16Array(opacities), fromHalf),
    sh: new Float32Array(0),
    coefficients,
    packedColors: { base: new Uint16Array(base), codes: new Uint32Array(codes) },
  };
  return { snapshot: true, preview: false, from: 0, to: 0, total: count, indices: null, gaussians };
}
