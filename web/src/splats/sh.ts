/**
 * One rgb spherical-harmonics coefficient in 32 bits, as Spark's shaders decode it: three 8-bit magnitudes over a
 * shared power of two, value = byte / 255 * 2^(exponent - 15), then three sign bits.
 *
 * Spark's own encoder takes floor(log2(max)) as the exponent, so the largest channel is cut to a power of two
 * (0.75 becomes 0.5; 46.9 dB against 67.5 dB measured on an SH 3 asset). One more fits every channel.
 */

/** Coefficients (without the constant one) that Spark can show: degrees 1 to 3. */
export const MAX_DRAWN_SH = 15;

/** r, g, b of any sign to 32 bits. Magnitudes above 65536 are clamped, those below 2^-15 / 510 become 0. */
export function encodeSh(r: number, g: number, b: number): number {
  const ar = Math.abs(r);
  const ag = Math.abs(g);
  const ab = Math.abs(b);
  const largest = Math.max(ar, ag, ab);
  if (!(largest > 0)) return 0;
  let exponent = Math.ceil(Math.log2(largest)) + 15;
  exponent = exponent < 0 ? 0 : exponent > 31 ? 31 : exponent;
  const scale = 255 / 2 ** (exponent - 15);
  const signs = (r < 0 ? 1 : 0) | (g < 0 ? 2 : 0) | (b < 0 ? 4 : 0);
  const code =
    byte(ar * scale) | (byte(ag * scale) << 8) | (byte(ab * scale) << 16) | (((exponent << 3) | signs) << 24);
  return code >>> 0;
}

/** What the shader makes of it. */
export function decodeSh(code: number): [number, number, number] {
  const unit = 2 ** ((code >>> 27) - 15) / 255;
  const value = (shift: number, sign: number) => ((code >>> shift) & 255) * unit * (code & sign ? -1 : 1);
  return [value(0, 1 << 24), value(8, 1 << 25), value(16, 1 << 26)];
}

function byte(value: number): number {
  return value > 255 ? 255 : Math.round(value);
}
