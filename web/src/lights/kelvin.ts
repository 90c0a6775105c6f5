/** The colour of a black body. */

/** Of the approximation below, kelvin. */
export const KELVIN_RANGE = [1667, 25_000] as const;
/** XYZ (D65) to linear sRGB, by rows. */
const XYZ_TO_RGB = [
  [3.2404542, -1.5371385, -0.4985314],
  [-0.969266, 1.8760108, 0.041556],
  [0.0556434, -0.2040259, 1.0572252],
];

/**
 * Linear sRGB of luminance 1 at a temperature in KELVIN_RANGE (Kim et al. 2002, US patent 7024034: cubic splines of the
 * Planckian locus), as lights/lamps.py has it. Negative channels are 0.
 */
export function kelvinColor(kelvin: number): [number, number, number] {
  const t = 1000 / Math.max(KELVIN_RANGE[0], Math.min(KELVIN_RANGE[1], kelvin));
  const x =
    kelvin <= 4000
      ? cubic(t, -0.2661239, -0.2343589, 0.8776956, 0.17991)
      : cubic(t, -3.0258469, 2.1070379, 0.2226347, 0.24039);
  const y =
    kelvin <= 2222
      ? cubic(x, -1.1063814, -1.3481102, 2.18555832, -0.20219683)
      : kelvin <= 4000
        ? cubic(x, -0.9549476, -1.37418593, 2.09137015, -0.16748867)
        : cubic(x, 3.081758, -5.8733867, 3.75112997, -0.37001483);
  const xyz = [x / y, 1, (1 - x - y) / y];
  return XYZ_TO_RGB.map((row) => Math.max(0, row[0] * xyz[0] + row[1] * xyz[1] + row[2] * xyz[2])) as [
    number,
    number,
    number,
  ];
}

const cubic = (v: number, a: number, b: number, c: number, d: number): number => ((a * v + b) * v + c) * v + d;
