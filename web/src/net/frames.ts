/** The binary frames of splats: snapshots and deltas. Little endian; layout in splatpainter/server/frames.py. */

import { FRAME_COLORS_ONLY, FRAME_FORMAT, FRAME_MAGIC, FRAME_PACKED, FRAME_PREVIEW, FRAME_SNAPSHOT } from "../messages";
import type { Gaussians } from "../splats/texels";

const HEADER = 8;

export interface Frame {
  snapshot: boolean;
  /** Shown until the next frame names these Gaussians; changes no version. */
  preview: boolean;
  /** The version that a delta starts from. */
  from: number;
  to: number;
  /** Gaussians of the asset afterwards. */
  total: number;
  /** [gaussians.count] those that changed or were appended; null: all of them, in order (as in a snapshot). */
  indices: Uint32Array | null;
  gaussians: Gaussians;
}

/** Parse one frame without copying. Throws an Error that says what is wrong. */
export function parseFrame(buffer: ArrayBuffer): Frame {
  if (buffer.byteLength < HEADER * 4) throw new Error(`splat frame: ${buffer.byteLength} bytes are less than a header`);
  const header = new Uint32Array(buffer, 0, HEADER);
  const [magic, format, flags, from, to, total, count, coefficients] = header;
  if (magic !== FRAME_MAGIC)
    throw new Error(`splat frame: expected magic ${FRAME_MAGIC.toString(16)}, got ${magic.toString(16)}`);
  if (format !== FRAME_FORMAT)
    throw new Error(`splat frame: expected format ${FRAME_FORMAT}, got ${format}; reload the page`);
  const snapshot = (flags & FRAME_SNAPSHOT) !== 0;
  const preview = (flags & FRAME_PREVIEW) !== 0;
  const packed = (flags & FRAME_PACKED) !== 0;
  const named = packed ? count !== total : !snapshot;
  const shapes = (flags & FRAME_COLORS_ONLY) === 0 && !packed;
  const floatsEach = (shapes ? 3 + 3 + 4 : 0) + 1 + coefficients * 3;
  const colorWords = packed ? Math.ceil((count * 3) / 2) + count * (coefficients - 1) : count * floatsEach;
  const words = HEADER + (named ? count : 0) + colorWords;
  if (buffer.byteLength !== words * 4)
    throw new Error(`splat frame: expected ${words * 4} bytes, got ${buffer.byteLength}`);
  if (snapshot && count !== total) throw new Error(`splat frame: a snapshot of ${count} Gaussians of ${total}`);
  let at = HEADER * 4;
  const floats = (n: number) => {
    const array = new Float32Array(buffer, at, n);
    at += n * 4;
    return array;
  };
  let indices: Uint32Array | null = null;
  if (named) {
    indices = new Uint32Array(buffer, at, count);
    at += count * 4;
    for (let k = 0; k < count; k++)
      if (indices[k] >= total) throw new Error(`splat frame: Gaussian ${indices[k]} of ${total}`);
  }
  if (packed) {
    const base = new Uint16Array(buffer, at, count * 3);
    const codes = new Uint32Array(buffer, at + Math.ceil((count * 3) / 2) * 4, count * (coefficients - 1));
    const empty = new Float32Array(0);
    const gaussians = { count, shape: null, opacities: empty, sh: empty, coefficients, packedColors: { base, codes } };
    return { snapshot, preview, from, to, total, indices, gaussians };
  }
  const shape = shapes ? { means: floats(count * 3), scales: floats(count * 3), quats: floats(count * 4) } : null;
  const opacities = floats(count);
  const sh = floats(count * coefficients * 3);
  return { snapshot, preview, from, to, total, indices, gaussians: { count, shape, opacities, sh, coefficients } };
}
