/** The binary frames of splats: snapshots and deltas. Little endian; layout in splatpainter/studio/frames.py. */

import { FRAME_COLORS_ONLY, FRAME_FORMAT, FRAME_MAGIC, FRAME_PREVIEW, FRAME_SNAPSHOT } from "../messages";
import type { Rows } from "../splats/rows";

const HEADER = 8;

export interface Frame {
  snapshot: boolean;
  /** Shown until the next frame names these rows; changes no version. */
  preview: boolean;
  /** The version that a delta starts from. */
  from: number;
  to: number;
  /** Rows of the whole asset afterwards. */
  total: number;
  /** [rows.count] the rows that changed or were appended; null in a snapshot: all of them, in order. */
  indices: Uint32Array | null;
  rows: Rows;
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
  const shapes = (flags & FRAME_COLORS_ONLY) === 0;
  const words = HEADER + count * ((snapshot ? 0 : 1) + (shapes ? 3 + 3 + 4 : 0) + 1 + coefficients * 3);
  if (buffer.byteLength !== words * 4)
    throw new Error(`splat frame: expected ${words * 4} bytes, got ${buffer.byteLength}`);
  if (snapshot && count !== total) throw new Error(`splat frame: a snapshot of ${count} rows of ${total}`);
  let at = HEADER * 4;
  const floats = (n: number) => {
    const array = new Float32Array(buffer, at, n);
    at += n * 4;
    return array;
  };
  let indices: Uint32Array | null = null;
  if (!snapshot) {
    indices = new Uint32Array(buffer, at, count);
    at += count * 4;
    for (let k = 0; k < count; k++)
      if (indices[k] >= total) throw new Error(`splat frame: row ${indices[k]} of ${total}`);
  }
  const shape = shapes ? { means: floats(count * 3), scales: floats(count * 3), quats: floats(count * 4) } : null;
  const opacities = floats(count);
  const sh = floats(count * coefficients * 3);
  return { snapshot, preview, from, to, total, indices, rows: { count, shape, opacities, sh, coefficients } };
}
