import { describe, expect, it } from "vitest";

import { blend, luma, withLuma } from "../src/paint/colors";
import { likeColor, soften } from "../src/paint/flood";
import { heal, membrane } from "../src/paint/heal";
import { sourceNear } from "../src/paint/surroundings";
import { limitsToSend } from "../src/paint/limits";
import { base64, compose, over, shifted, solid } from "../src/paint/patch";
import { clip, dab, emptyMask, falloff, segment, union } from "../src/paint/raster";
import { combine, invert, isEmpty, outline, polygon, rectangle } from "../src/paint/selection-masks";

const hard = { radius: 5, hardness: 1, flow: 1 };
const sum = (values: Float32Array) => values.reduce((a, b) => a + b, 0);
const picture = (width: number, height: number, color: (x: number, y: number) => number[]) => {
  const data = new Uint8ClampedArray(width * height * 4).fill(255);
  for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) data.set(color(x, y), (y * width + x) * 4);
  return { width, height, data };
};

describe("dabs", () => {
  it("cover a disc of the tip's area", () => {
    const mask = emptyMask(64, 64);
    dab(mask, 30.3, 31.7, { radius: 20, hardness: 1, flow: 1 });
    expect(sum(mask.data)).toBeGreaterThan(Math.PI * 19 ** 2);
    expect(sum(mask.data)).toBeLessThan(Math.PI * 20 ** 2);
    expect(mask.data[31 * 64 + 30]).toBe(1);
  });

  it("fade monotonously when soft", () => {
    const tip = { radius: 20, hardness: 0.2, flow: 1 };
    const values = Array.from({ length: 22 }, (_, d) => falloff(d, tip));
    expect(values.slice(1).every((v, k) => v <= values[k])).toBe(true);
    expect([values[0], values[4], values[20]]).toEqual([1, 1, 0]);
  });

  it("build up with flow and never pass full cover", () => {
    const mask = emptyMask(20, 20);
    dab(mask, 10, 10, { ...hard, flow: 0.5 });
    expect(mask.data[10 * 20 + 10]).toBeCloseTo(0.5, 6);
    dab(mask, 10, 10, { ...hard, flow: 0.5 });
    expect(mask.data[10 * 20 + 10]).toBeCloseTo(0.75, 6);
  });

  it("report the pixels that they reach, clipped to the view", () => {
    const mask = emptyMask(20, 20);
    const rect = dab(mask, 1, 19, hard);
    for (let k = 0; k < 400; k++) {
      const [x, y] = [k % 20, Math.floor(k / 20)];
      if (mask.data[k] > 0)
        expect(x >= rect.x && x < rect.x + rect.width && y >= rect.y && y < rect.y + rect.height).toBe(true);
    }
    expect(clip(rect, mask)).toEqual(rect);
    expect(dab(mask, -50, 5, hard).width).toBe(0);
  });
});

describe("strokes", () => {
  it("leave the same dabs however the path is cut into events", () => {
    const tip = () => ({ radius: 6, hardness: 0.5, flow: 0.3 });
    const at = (x: number) => ({ x, y: 20, pressure: 1 });
    const whole = emptyMask(100, 40);
    segment(whole, at(10), at(90), tip, 0);
    const parts = emptyMask(100, 40);
    let left = 0;
    for (let k = 0; k < 100; k++) left = segment(parts, at(10 + 0.8 * k), at(10.8 + 0.8 * k), tip, left).left;
    const worst = whole.data.reduce((most, value, k) => Math.max(most, Math.abs(value - parts.data[k])), 0);
    expect(worst).toBeLessThan(1e-3);
  });

  it("grow with pressure", () => {
    const mask = emptyMask(120, 60);
    segment(
      mask,
      { x: 10, y: 30, pressure: 0.1 },
      { x: 110, y: 30, pressure: 1 },
      (p) => ({ radius: 20 * p, hardness: 1, flow: 1 }),
      0,
    );
    const height = (x: number) =>
      Array.from({ length: 60 }, (_, y) => mask.data[y * 120 + x]).filter((v) => v > 0.5).length;
    expect(height(95)).toBeGreaterThan(2 * height(40));
  });

  it("joins rectangles", () => {
    expect(union({ x: 1, y: 2, width: 3, height: 4 }, { x: 8, y: 0, width: 1, height: 1 })).toEqual({
      x: 1,
      y: 0,
      width: 8,
      height: 6,
    });
  });
});

describe("colours", () => {
  it("keep the luminance in colour mode", () => {
    for (const base of [
      [10, 20, 30],
      [200, 210, 180],
      [250, 250, 250],
      [0, 0, 0],
      [128, 90, 240],
    ] as [number, number, number][]) {
      for (const color of [
        [255, 0, 0],
        [0, 0, 255],
        [90, 200, 40],
      ] as [number, number, number][]) {
        const mixed = withLuma(color, base);
        expect(luma(...mixed)).toBeCloseTo(luma(...base), 6);
        mixed.forEach((v) => expect(v >= -1e-6 && v <= 255 + 1e-6).toBe(true));
      }
    }
  });

  it("blend as the modes say", () => {
    expect(blend("darken", [10, 200, 30], [20, 100, 40])).toEqual([10, 100, 30]);
    expect(blend("lighten", [10, 200, 30], [20, 100, 40])).toEqual([20, 200, 40]);
    expect(blend("normal", [1, 2, 3], [9, 9, 9])).toEqual([1, 2, 3]);
  });
});

describe("regions of like colour", () => {
  const twoRooms = picture(9, 5, (x, y) => (x === 4 ? [0, 0, 0] : [200, 100, y]));

  it("stop at borders when contiguous and do not else", () => {
    expect(sum(likeColor(twoRooms, 0, 0, 0.05, true).data)).toBe(4 * 5);
    expect(sum(likeColor(twoRooms, 0, 0, 0.05, false).data)).toBe(8 * 5);
    expect(sum(likeColor(twoRooms, 0, 0, 1, true).data)).toBe(45);
    expect(sum(likeColor(twoRooms, -1, 0, 1, true).data)).toBe(0);
  });

  it("match a plain search on noise", () => {
    let seed = 7;
    const noise = picture(40, 30, () => Array(3).fill((seed = (seed * 48271) % 2147483647) % 3 === 0 ? 0 : 255));
    const mask = likeColor(noise, 20, 15, 0.1, true);
    const seen = new Set([15 * 40 + 20]);
    const queue = [...seen];
    const value = noise.data[queue[0] * 4];
    while (queue.length) {
      const k = queue.pop()!;
      for (const next of [k % 40 ? k - 1 : -1, k % 40 < 39 ? k + 1 : -1, k - 40, k + 40]) {
        if (next >= 0 && next < 1200 && !seen.has(next) && noise.data[next * 4] === value)
          (seen.add(next), queue.push(next));
      }
    }
    expect([...mask.data.keys()].filter((k) => mask.data[k])).toEqual([...seen].sort((a, b) => a - b));
  });

  it("soften without losing cover inside", () => {
    const mask = rectangle(40, 40, { x: 10, y: 10, width: 20, height: 20 });
    const soft = soften(mask, 2);
    expect(soft.data[20 * 40 + 20]).toBeCloseTo(1, 5);
    expect(sum(soft.data)).toBeCloseTo(sum(mask.data), 2);
    expect(soft.data[20 * 40 + 9]).toBeGreaterThan(0);
  });
});

describe("selections", () => {
  it("fill polygons as rectangles where they are", () => {
    const box = polygon(20, 20, [3, 4, 12, 4, 12, 15, 3, 15]);
    expect(box.data).toEqual(rectangle(20, 20, { x: 3, y: 4, width: 9, height: 11 }).data);
    const triangle = polygon(100, 100, [10, 10, 90, 10, 10, 90]);
    expect(Math.abs(sum(triangle.data) - 3200)).toBeLessThan(90);
  });

  it("add, subtract, invert", () => {
    const a = rectangle(10, 10, { x: 0, y: 0, width: 5, height: 10 });
    const b = rectangle(10, 10, { x: 3, y: 0, width: 4, height: 10 });
    expect(sum(combine(a, b, "add").data)).toBe(70);
    expect(sum(combine(a, b, "subtract").data)).toBe(30);
    expect(combine(a, b, "replace")).toBe(b);
    expect(isEmpty(combine(null, b, "subtract"))).toBe(true);
    expect(sum(invert(a).data)).toBe(50);
  });

  it("outlines with straight lines", () => {
    const lines = outline(rectangle(10, 10, { x: 2, y: 3, width: 4, height: 5 }));
    expect(lines.length).toBe(16); // four sides
    expect(new Set(lines.filter((_, k) => k % 2 === 0))).toEqual(new Set([2, 6]));
  });
});

describe("patches", () => {
  const base = picture(4, 1, (x) => [x * 10, 0, 0]);
  const mask = { width: 4, height: 1, data: new Float32Array([0, 0.5, 1, 1]) };
  const rect = { x: 0, y: 0, width: 4, height: 1 };

  it("carry colour and straight alpha, within opacity and selection", () => {
    const selection = { width: 4, height: 1, data: new Float32Array([1, 1, 1, 0]) };
    const patch = compose(
      rect,
      mask,
      selection,
      0.5,
      solid([9, 8, 7], "normal", () => null),
    );
    expect([...patch]).toEqual([0, 0, 0, 0, 9, 8, 7, 64, 9, 8, 7, 128, 0, 0, 0, 0]);
  });

  it("lie over the view as the browser would lay them", () => {
    const shown = over(
      rect,
      compose(
        rect,
        mask,
        null,
        1,
        solid([110, 0, 0], "normal", () => null),
      ),
      base,
    );
    expect([shown[0 + 3], shown[4], shown[7], shown[8]]).toEqual([0, 60, 255, 110]);
  });

  it("clone from beside, holding the border", () => {
    const patch = compose(
      rect,
      { ...mask, data: new Float32Array(4).fill(1) },
      null,
      1,
      shifted(2, 0, () => base),
    );
    expect([patch[0], patch[4], patch[8], patch[12]]).toEqual([0, 0, 0, 10]);
  });

  it("become base64", () => {
    const bytes = new Uint8ClampedArray(100_000).map((_, k) => k);
    expect(Uint8ClampedArray.from(atob(base64(bytes)), (c) => c.charCodeAt(0))).toEqual(bytes);
  });
});

describe("healing", () => {
  it("solves Laplace's equation: a linear border gives a linear inside", () => {
    const [w, h] = [24, 18];
    const inside = new Uint8Array(w * h);
    for (let y = 1; y < h - 1; y++) inside.fill(1, y * w + 1, y * w + w - 1);
    const truth = Float32Array.from({ length: w * h }, (_, k) => 3 * (k % w) - 2 * Math.floor(k / w));
    const values = truth.map((v, k) => (inside[k] ? 0 : v));
    membrane(values, inside, w, h);
    expect(Math.max(...values.map((v, k) => Math.abs(v - truth[k])))).toBeLessThan(0.01);
  });

  it("takes the detail of the source and the colour of the place", () => {
    // left half dark, right half bright, the same stripes on both; a blot on the bright side
    const stripes = (x: number, y: number) => (x < 30 ? 60 : 180) + (y % 4 < 2 ? 10 : -10);
    const clean = picture(60, 30, (x, y) => Array(3).fill(stripes(x, y)));
    const blotted = picture(60, 30, (x, y) => Array(3).fill(Math.hypot(x - 45, y - 15) < 5 ? 0 : stripes(x, y)));
    const mask = emptyMask(60, 30);
    dab(mask, 45, 15, { radius: 8, hardness: 1, flow: 1 });
    const { rect, data } = heal(blotted, mask, { x: 36, y: 6, width: 18, height: 18 }, (x, y) => (y * 60 + x - 30) * 4);
    let worst = 0;
    for (let y = 0; y < rect.height; y++) {
      for (let x = 0; x < rect.width; x++) {
        const at = ((rect.y + y) * 60 + rect.x + x) * 4;
        if (mask.data[at / 4] > 0) worst = Math.max(worst, Math.abs(data[(y * rect.width + x) * 4] - clean.data[at]));
      }
    }
    expect(worst).toBeLessThan(4); // the border is averaged over five rows of stripes of four
  });

  it("leaves no holes in dark leather: folds of a bright source are no texture there", () => {
    const grain = (x: number, y: number) => ((x * 7 + y * 13) % 5) - 2;
    const dark = (x: number, y: number) => [14, 15, 18].map((v) => v + grain(x, y));
    const fold = (x: number) => 90 + 80 * Math.sin(x / 6); // wide and bright
    const pixels = picture(160, 80, (x, y) => (x < 80 ? [0, 1, 2].map(() => fold(x) + 3 * grain(x, y)) : dark(x, y)));
    const mask = emptyMask(160, 80);
    dab(mask, 120, 40, { radius: 22, hardness: 1, flow: 1 });
    const extent = { x: 96, y: 16, width: 48, height: 48 };
    const { rect, data } = heal(pixels, mask, extent, (x, y) => (y * 160 + x - 80) * 4);
    for (let y = 0; y < rect.height; y++)
      for (let x = 0; x < rect.width; x++) {
        if (mask.data[(rect.y + y) * 160 + rect.x + x] === 0) continue;
        const [r, g, b] = data.subarray((y * rect.width + x) * 4);
        expect(r).toBeGreaterThan(5);
        expect(r).toBeLessThan(40);
        expect(b - r).toBeGreaterThan(1);
        expect(b - r).toBeLessThan(8);
        expect(Math.abs(g - r)).toBeLessThan(5);
      }
  });

  it("looks away from where nothing of the asset is, at the border and in the source", () => {
    const stripes = (_: number, y: number) => Array(3).fill(120 + (y % 4 < 2 ? 8 : -8));
    const emptiness = [27, 29, 33];
    const pixels = picture(120, 40, (x, y) => (x > 70 || (x < 20 && y > 20) ? emptiness : stripes(x, y)));
    const isEmpty = (at: number) => pixels.data[at] === 27;
    const mask = emptyMask(120, 40);
    dab(mask, 62, 20, { radius: 9, hardness: 1, flow: 1 });
    const extent = { x: 52, y: 10, width: 20, height: 20 };
    const { rect, data } = heal(pixels, mask, extent, (x, y) => (y * 120 + x - 40) * 4, isEmpty);
    for (let k = 0; k < rect.width * rect.height; k++) {
      const [x, y] = [rect.x + (k % rect.width), rect.y + Math.floor(k / rect.width)];
      if (mask.data[y * 120 + x] > 0 && !isEmpty((y * 120 + x) * 4))
        expect(Math.abs(data[k * 4] - 120)).toBeLessThan(16);
    }
    expect(sourceNear(pixels, mask, extent, isEmpty)).not.toBeNull();
  });

  it("finds a source of the same kind beside the region, on the asset", () => {
    const pixels = picture(200, 120, (x, y) => (y < 60 ? [200, 40, 40] : [30, 30, x > 150 ? 220 : 90]));
    const mask = emptyMask(200, 120);
    dab(mask, 100, 95, { radius: 10, hardness: 1, flow: 1 });
    const extent = { x: 89, y: 84, width: 22, height: 22 };
    const [dx, dy] = sourceNear(pixels, mask, extent, () => false)!;
    expect(95 - dy - 11).toBeGreaterThan(60); // not the red half
    expect(100 - dx + 11).toBeLessThan(151); // nor the blue end
    expect(Math.max(Math.abs(dx), Math.abs(dy))).toBeGreaterThanOrEqual(22); // nor the region itself
    const striped = picture(200, 120, (x, y) => (Math.hypot(x - 100, y - 95) < 16 ? [9, 9, 9] : [240, 240, 240]));
    expect(sourceNear(striped, mask, extent, () => false)).toBeNull(); // nothing like its border: no texture
    const plain = heal(striped, mask, extent, () => -1);
    const middle = ((95 - plain.rect.y) * plain.rect.width + 100 - plain.rect.x) * 4;
    expect([...plain.data.subarray(middle, middle + 3)]).toEqual([9, 9, 9]);
    const alone = (at: number) => !mask.data[at / 4];
    expect(sourceNear(pixels, mask, extent, alone)).toBeNull();
  });
});

describe("limits", () => {
  it("are sent as whole numbers in the ranges that the server takes", () => {
    expect(limitsToSend({ angle: 79.6, depthEdge: 2.2 })).toEqual({ angle_limit: 80, depth_edge_limit: 2 });
    expect(limitsToSend({ angle: 400, depthEdge: 99 })).toEqual({ angle_limit: 90, depth_edge_limit: 16 });
    expect(limitsToSend({ angle: -1, depthEdge: -1 })).toEqual({ angle_limit: 0, depth_edge_limit: 0 });
  });
});
