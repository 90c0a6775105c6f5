import { FRAME_COLORS_ONLY, FRAME_FORMAT, FRAME_MAGIC, FRAME_SNAPSHOT } from "../src/messages";

/** A frame whose floats count up from 0. */
export function makeFrame(
  flags: number,
  from: number,
  to: number,
  total: number,
  rows: number[],
  bands: number,
): ArrayBuffer {
  const shapes = flags & FRAME_COLORS_ONLY ? 0 : 10;
  const floats = rows.length * (shapes + 1 + 3 * bands);
  const indices = flags & FRAME_SNAPSHOT ? [] : rows;
  const buffer = new ArrayBuffer(4 * (8 + indices.length + floats));
  new Uint32Array(buffer).set([FRAME_MAGIC, FRAME_FORMAT, flags, from, to, total, rows.length, bands, ...indices]);
  new Float32Array(buffer, 4 * (8 + indices.length)).set(Array.from({ length: floats }, (_, k) => k));
  return buffer;
}
