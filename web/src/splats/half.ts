/** IEEE 754 half floats as 16-bit integers, rounded to nearest even; values beyond 65504 are clamped. */

const float = new Float32Array(1);
const bits = new Uint32Array(float.buffer);

/** The half float nearest to `value`, as 16 bits. NaN becomes 0: a texture must not hold one. */
export function toHalf(value: number): number {
  if (value !== value) return 0;
  float[0] = value > 65504 ? 65504 : value < -65504 ? -65504 : value;
  const x = bits[0];
  const sign = (x >>> 16) & 0x8000;
  const exponent = (x >>> 23) & 0xff;
  if (exponent < 103) return sign; // below half of the smallest subnormal
  let mantissa = x & 0x7fffff;
  if (exponent < 113) {
    mantissa |= 0x800000;
    const shift = 126 - exponent;
    return sign | roundShift(mantissa, shift);
  }
  return sign + roundShift(((exponent - 112) << 23) | mantissa, 13); // a carry runs into the exponent, as it should
}

/** The number that 16 bits of a half float stand for. */
export function fromHalf(half: number): number {
  const sign = half & 0x8000 ? -1 : 1;
  const exponent = (half >>> 10) & 0x1f;
  const mantissa = half & 0x3ff;
  if (exponent === 0) return sign * mantissa * 2 ** -24;
  if (exponent === 31) return mantissa ? NaN : sign * Infinity;
  return sign * (1 + mantissa / 1024) * 2 ** (exponent - 15);
}

function roundShift(value: number, shift: number): number {
  const truncated = value >>> shift;
  const rest = value & ((1 << shift) - 1);
  const half = 1 << (shift - 1);
  return rest > half || (rest === half && truncated & 1) ? truncated + 1 : truncated;
}
