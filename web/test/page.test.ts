import { expect, test } from "vitest";

import { readGaussians, unplaned, type Scene } from "../src/page/scene";
import { fromHalf, toHalf } from "../src/splats/half";
import { allocate, encodeGaussian, encodeRotation } from "../src/splats/texels";

const planes = (bytes: Uint8Array, count: number): number[] => {
  const width = bytes.length / count;
  return Array.from({ length: bytes.length }, (_, at) => bytes[(at % count) * width + Math.floor(at / count)]);
};

test("planes become rows again", () => {
  const rows = Uint8Array.from({ length: 12 }, (_, k) => k);
  expect([...new Uint8Array(unplaned(Uint8Array.from(planes(rows, 3)), 3, 4))]).toEqual([...rows]);
});

test("packed Gaussians become the texels that they were", () => {
  const means = new Float32Array([1, 2, 3, -4, 5.5, 6]);
  const opacities = Uint16Array.of(toHalf(0.5), toHalf(0.25));
  const scales = Uint16Array.from([0.1, 0.2, 0.3, 1, 2, 3], (scale) => toHalf(Math.log(scale)));
  const rotations = Uint32Array.of(encodeRotation(1, 0, 0, 0), encodeRotation(0.6, 0, 0.8, 0));
  const base = Uint16Array.from([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], toHalf);
  const codes = Uint32Array.from({ length: 6 }, (_, k) => 0x80000000 + k);
  const arrays = [means, opacities, scales, rotations, base, codes];
  const data = arrays.flatMap((array) => planes(new Uint8Array(array.buffer), 2));
  const scene = { count: 2, coefficients: 4 } as Scene;
  const { gaussians, total, snapshot } = readGaussians(Uint8Array.from(data), scene);
  expect([total, snapshot]).toEqual([2, true]);
  const texels = allocate(2, 4);
  for (let k = 0; k < 2; k++) encodeGaussian(texels, k, gaussians, k);
  expect([...new Float32Array(texels.geometry.buffer)].filter((_, k) => k % 4 < 3)).toEqual([...means]);
  for (let k = 0; k < 2; k++) {
    const at = k * 4;
    expect(texels.geometry[at + 3] & 0xffff).toBe(opacities[k]);
    expect(texels.appearance[at]).toBe((base[k * 3] | (base[k * 3 + 1] << 16)) >>> 0);
    expect(texels.appearance[at + 1] & 0xffff).toBe(base[k * 3 + 2]);
    expect(fromHalf(texels.appearance[at + 1] >>> 16)).toBeCloseTo(fromHalf(scales[k * 3]), 2);
    expect(texels.appearance[at + 3]).toBe(rotations[k]);
    expect([...texels.sh[0].subarray(at, at + 3)]).toEqual([...codes.subarray(k * 3, k * 3 + 3)]);
  }
});

test("a page with too few bytes says so", () => {
  expect(() => readGaussians(new Uint8Array(10), { count: 2, coefficients: 1 } as Scene)).toThrow("expected 60 bytes");
});
