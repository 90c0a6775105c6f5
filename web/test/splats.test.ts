import { describe, expect, it } from "vitest";

import { fromHalf, toHalf } from "../src/splats/half";
import {
  allocate,
  decodeRotation,
  encodeRotation,
  encodeGaussian,
  SH_C0,
  shArrays,
  type Gaussians,
} from "../src/splats/texels";
import { decodeSh, encodeSh } from "../src/splats/sh";

/** A generator of numbers 0..1 that is the same every time (Park and Miller, CACM 1988). */
function random(seed: number): () => number {
  let state = seed;
  return () => (state = (state * 48271) % 2147483647) / 2147483647;
}

describe("half floats", () => {
  it("gives back every half float that is finite", () => {
    const finite = Array.from({ length: 0x10000 }, (_, bits) => bits).filter((bits) => (bits & 0x7c00) !== 0x7c00);
    expect(finite.filter((bits) => toHalf(fromHalf(bits)) !== bits)).toEqual([]);
  });

  it("rounds to the nearest, ties to even", () => {
    const next = random(1);
    for (let k = 0; k < 500; k++) {
      const value = (next() - 0.5) * 2 ** (Math.floor(next() * 30) - 14);
      const half = toHalf(value);
      const own = Math.abs(fromHalf(half) - value);
      expect(own).toBeLessThanOrEqual(Math.abs(fromHalf(half + 1) - value));
      if (half & 0x7fff) expect(own).toBeLessThanOrEqual(Math.abs(fromHalf(half - 1) - value));
    }
    expect(toHalf(1 + 2 ** -11)).toBe(toHalf(1)); // halfway: to even
    expect(toHalf(1 + 3 * 2 ** -11)).toBe(toHalf(1 + 2 ** -9));
  });

  it("clamps what does not fit and droppedImages NaN", () => {
    expect(fromHalf(toHalf(1e9))).toBe(65504);
    expect(fromHalf(toHalf(-Infinity))).toBe(-65504);
    expect(toHalf(NaN)).toBe(0);
  });
});

describe("spherical harmonics", () => {
  it("keeps every channel within half a step of the shared exponent", () => {
    const next = random(2);
    for (let k = 0; k < 500; k++) {
      const size = 2 ** (next() * 12 - 8);
      const rgb = [next(), next(), next()].map((v) => (v * 2 - 1) * size);
      const step = 2 ** Math.ceil(Math.log2(Math.max(...rgb.map(Math.abs)))) / 255;
      decodeSh(encodeSh(rgb[0], rgb[1], rgb[2])).forEach((value, c) =>
        expect(Math.abs(value - rgb[c])).toBeLessThanOrEqual(step * 0.5001),
      );
    }
  });

  it("does not cut the largest channel to a power of two", () => {
    expect(decodeSh(encodeSh(0.75, -0.3, 0))[0]).toBeCloseTo(0.75, 2); // Spark's own encoder makes 0.5 of it
  });

  it("maps zero and what is too small to zero", () => {
    expect(encodeSh(0, 0, 0)).toBe(0);
    expect(decodeSh(encodeSh(1e-9, -1e-9, 0)).map(Math.abs)).toEqual([0, 0, 0]);
  });
});

describe("Gaussians", () => {
  const one = (over: Partial<Gaussians> = {}): Gaussians => ({
    count: 1,
    shape: {
      means: new Float32Array([1, -2, 3.5]),
      scales: new Float32Array([0.1, 0.02, 1.5]),
      quats: new Float32Array([0.5, -0.5, 0.5, 0.5]),
    },
    opacities: new Float32Array([0.75]),
    sh: new Float32Array(48).map((_, k) => (k % 5) * 0.1 - 0.2),
    coefficients: 16,
    ...over,
  });

  it("turns rotations into 32 bits and back within the angle's step", () => {
    const next = random(3);
    for (let k = 0; k < 1000; k++) {
      const q = [next() - 0.5, next() - 0.5, next() - 0.5, next() - 0.5];
      const norm = Math.hypot(...q);
      const unit = q.map((v) => v / norm) as [number, number, number, number];
      const back = decodeRotation(encodeRotation(...unit));
      const cosine = Math.abs(back.reduce((sum, v, c) => sum + v * unit[c], 0));
      expect(2 * Math.acos(Math.min(1, cosine))).toBeLessThan(0.009); // radians: twice the axis grid of 1/1023
    }
  });

  it("writes position exactly and the rest as the shader reads it", () => {
    const texels = allocate(8, 16);
    encodeGaussian(texels, 3, one(), 0);
    expect([...new Float32Array(texels.geometry.buffer, 3 * 16, 3)]).toEqual([1, -2, 3.5]);
    expect(fromHalf(texels.geometry[15])).toBe(0.75);
    const [rg, bx, yz] = texels.appearance.subarray(12, 15);
    expect(fromHalf(rg & 0xffff)).toBeCloseTo(0.5 - 0.2 * SH_C0, 3);
    expect(Math.exp(fromHalf(bx >>> 16))).toBeCloseTo(0.1, 3);
    expect(Math.exp(fromHalf(yz & 0xffff))).toBeCloseTo(0.02, 4);
    expect(Math.exp(fromHalf(yz >>> 16))).toBeCloseTo(1.5, 2);
    // coefficient k of PLY order: word k & 3 of array k >> 2
    expect(decodeSh(texels.sh[1][3 * 4 + 1])[0]).toBeCloseTo(one().sh[(5 + 1) * 3], 2);
    expect(decodeSh(texels.sh[3][3 * 4 + 2])[2]).toBeCloseTo(one().sh[(14 + 1) * 3 + 2], 2);
  });

  it("takes packedColors as they are, as if they had come as floats", () => {
    const [floats, tinted] = [allocate(2, 4), allocate(2, 4)];
    const sh = new Float32Array([0.3, -1.2, 0, 0.75, -0.3, 0.1, 1e-9, 0, 0, -0.01, 0.02, 0.004]);
    for (const texels of [floats, tinted])
      encodeGaussian(texels, 1, one({ coefficients: 4, sh: new Float32Array(12) }), 0);
    encodeGaussian(floats, 1, one({ shape: null, coefficients: 4, sh }), 0);
    // the same numbers as in tests/server/test_frames.py
    const packedColors = {
      base: new Uint16Array([0x38ad, 0x312b, 0x3800]),
      codes: new Uint32Array([0x7a1a4dbf, 0, 0x5121a352]),
    };
    encodeGaussian(tinted, 1, one({ shape: null, coefficients: 4, packedColors }), 0);
    expect(tinted).toEqual(floats);
    const { base } = packedColors;
    encodeGaussian(
      tinted,
      1,
      one({ shape: null, coefficients: 1, packedColors: { base, codes: new Uint32Array(0) } }),
      0,
    );
    expect(tinted).toEqual(floats);
  });

  it("changes colours alone without touching the shape", () => {
    const texels = allocate(2, 4);
    encodeGaussian(texels, 1, one({ coefficients: 4, sh: new Float32Array(12) }), 0);
    const before = [...texels.geometry.slice(4, 7), texels.appearance[5] >>> 16, ...texels.appearance.slice(6, 8)];
    encodeGaussian(texels, 1, one({ shape: null, coefficients: 4, sh: new Float32Array(12).fill(1) }), 0);
    expect([...texels.geometry.slice(4, 7), texels.appearance[5] >>> 16, ...texels.appearance.slice(6, 8)]).toEqual(
      before,
    );
    expect(fromHalf(texels.appearance[5] & 0xffff)).toBeCloseTo(0.5 + SH_C0, 3);
  });

  it("hides Gaussians that cannot be drawn", () => {
    for (const shape of [
      { means: [NaN, 0, 0] },
      { scales: [0, 1, 1] },
      { quats: [0, 0, 0, 0] },
      { scales: [1, -1, 1] },
    ]) {
      const texels = allocate(1, 1);
      const parts = Object.fromEntries(Object.entries(shape).map(([key, values]) => [key, new Float32Array(values)]));
      encodeGaussian(
        texels,
        0,
        one({ shape: { ...one().shape!, ...parts }, coefficients: 1, sh: new Float32Array(3) }),
        0,
      );
      expect(texels.geometry[3]).toBe(0);
      expect(new Float32Array(texels.geometry.buffer).every(Number.isFinite)).toBe(true);
    }
  });

  it("has as many arrays as the degree needs", () => {
    expect([1, 4, 9, 16, 25].map(shArrays)).toEqual([0, 1, 2, 4, 4]);
  });
});
