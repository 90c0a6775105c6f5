import { describe, expect, it } from "vitest";

import { BUILT_IN_PRESETS, parsePresets, PLAIN, presetsText } from "../src/paint/brush-settings";
import { luma, type Rgb } from "../src/paint/colors";
import { dabAt, DabPath, meanRadius, roundFrame, shaped, Stabiliser, stamp, type Brush } from "../src/paint/dabs";
import { compose, solid } from "../src/paint/patch";
import { random } from "../src/paint/random";
import { dab, emptyMask, segment } from "../src/paint/raster";
import { localMean, shaded } from "../src/paint/shading";
import { facingFrame, frameOnSurface, SurfaceView } from "../src/paint/surface-blocks";
import {
  builtInTip,
  BUILT_IN_TIPS,
  coverOf,
  grainAt,
  TEXTURE_PX,
  TEXTURES,
  textureTile,
  tipOfPicture,
  TIP_PX,
  withHalves,
  type BuiltInTip,
  type Texture,
} from "../src/paint/tips";
import { parseColors } from "../src/state/remembered";
import type { CameraJson } from "../src/view/camera";

const brushOf = (part: Partial<Brush> = {}): Brush => ({
  ...PLAIN,
  frame: () => roundFrame(6),
  tip: null,
  hardness: 0.7,
  flow: 1,
  pressureSize: false,
  pressureFlow: false,
  seed: 7,
  ...part,
});
const at = (x: number, y: number, pressure = 1) => ({ x, y, pressure });
const sum = (values: Float32Array) => values.reduce((a, b) => a + b, 0);
const draw = (brush: Brush, points: [number, number][], size = 120) => {
  const mask = emptyMask(size, size);
  const path = new DabPath(mask, brush);
  path.down(at(...points[0]));
  for (const point of points.slice(1)) path.move(at(...point));
  path.up();
  return mask;
};
const camera: CameraJson = {
  version: 1,
  width: 400,
  height: 300,
  fx: 500,
  fy: 500,
  cx: 200,
  cy: 150,
  world_to_camera: [
    [1, 0, 0, 0],
    [0, 1, 0, 0],
    [0, 0, 1, 0],
    [0, 0, 0, 1],
  ],
  background: [0, 0, 0],
};

describe("dabs of the brush", () => {
  it("are those of a plain round brush where nothing else is set", () => {
    const tip = { radius: 6, hardness: 0.7, flow: 1 };
    const expected = emptyMask(120, 120);
    dab(expected, 20, 30, tip);
    segment(expected, at(20, 30), at(90, 71), () => tip, 0);
    const mask = draw(brushOf(), [
      [20, 30],
      [90, 71],
    ]);
    const worst = mask.data.reduce((most, v, k) => Math.max(most, Math.abs(v - expected.data[k])), 0);
    expect(worst).toBeLessThan(1e-4);
  });

  it("replay exactly with the same seed, and differ with another", () => {
    const jitter = { sizeJitter: 0.8, opacityJitter: 0.5, angleJitter: 1, scatter: 0.7, tip: builtInTip("chalk") };
    const path: [number, number][] = [
      [20, 60],
      [50, 40],
      [100, 80],
    ];
    const first = draw(brushOf(jitter), path);
    expect(draw(brushOf(jitter), path).data).toEqual(first.data);
    expect(draw(brushOf({ ...jitter, seed: 8 }), path).data).not.toEqual(first.data);
  });

  it("do not depend on how the path is cut into events", () => {
    const brush = brushOf({ sizeJitter: 0.8, scatter: 0.4, spacing: 0.4 });
    const cut = Array.from({ length: 51 }, (_, k): [number, number] => [20 + 1.4 * k, 60]);
    const parts = draw(brush, cut).data;
    const one = draw(brush, [
      [20, 60],
      [90, 60],
    ]).data;
    expect(Math.max(...parts.map((v, k) => Math.abs(v - one[k])))).toBeLessThan(1e-3);
  });

  it("keep their spacing", () => {
    const brush = brushOf({ spacing: 2, frame: () => roundFrame(4), hardness: 1 });
    const mask = draw(brush, [
      [10, 60],
      [100, 60],
    ]);
    const row = Array.from({ length: 120 }, (_, x) => mask.data[60 * 120 + x] > 0.5);
    const starts = row.flatMap((on, x) => (on && !row[x - 1] ? [x] : []));
    expect(starts.slice(1).map((x, k) => x - starts[k])).toEqual(Array(starts.length - 1).fill(16));
  });

  it("are flattened, turned and follow the path", () => {
    const flat = emptyMask(80, 80);
    stamp(flat, { x: 40, y: 40, frame: shaped(roundFrame(20), 1, 90, 0.25), flow: 1 }, null, 1);
    const extent = (from: (k: number) => number) =>
      Array.from({ length: 80 }, (_, k) => flat.data[from(k)]).filter((v) => v > 0.5).length;
    expect(extent((k) => k * 80 + 40)).toBeGreaterThan(34); // upright
    expect(extent((k) => 40 * 80 + k)).toBeLessThan(13);
    const brush = brushOf({ alongPath: true, roundness: 0.2 });
    expect(dabAt(brush, at(0, 0), 0, 90).frame[2]).toBeCloseTo(6); // its long axis lies along y
    expect(sum(draw(brush, [[60, 60]]).data)).toBeGreaterThan(8); // a click leaves a dab, too
  });

  it("shrink, fade and scatter within their limits", () => {
    const brush = brushOf({ sizeJitter: 0.5, opacityJitter: 0.4, scatter: 0.5 });
    const dabs = Array.from({ length: 200 }, (_, k) => dabAt(brush, at(50, 50), k, 0));
    const radii = dabs.map((one) => meanRadius(one.frame));
    expect(Math.min(...radii)).toBeGreaterThanOrEqual(3);
    expect(Math.max(...radii) - Math.min(...radii)).toBeGreaterThan(2.5);
    expect(Math.min(...dabs.map((one) => one.flow))).toBeGreaterThanOrEqual(0.6);
    expect(Math.max(...dabs.map((one) => Math.abs(one.y - 50)))).toBeLessThanOrEqual(6 + 1e-9);
    expect(Math.max(...dabs.map((one) => Math.abs(one.x - 50)))).toBeLessThan(1e-9); // beside the path
  });

  it("have random numbers that are even and not alike", () => {
    const values = Array.from({ length: 4000 }, (_, k) => random(3, k, k % 3));
    expect(values.reduce((a, b) => a + b) / values.length).toBeCloseTo(0.5, 1);
    expect(new Set(values).size).toBeGreaterThan(3990);
    const products = values.slice(1).map((v, k) => (v - 0.5) * (values[k] - 0.5));
    expect(Math.abs(products.reduce((a, b) => a + b) / products.length)).toBeLessThan(0.01);
  });
});

describe("a steady hand", () => {
  it("is pulled on a string, however often the pen reports", () => {
    const end = (steps: number) => {
      const hand = new Stabiliser(20);
      hand.down(at(0, 0));
      for (let k = 1; k <= steps; k++) hand.move(at((100 * k) / steps, 0));
      return hand.brush!;
    };
    expect(end(7).x).toBeCloseTo(80);
    expect(end(400).x).toBeCloseTo(80);
  });

  it("takes the tremble out", () => {
    const hand = new Stabiliser(20);
    hand.down(at(0, 0));
    const heights = Array.from({ length: 100 }, (_, k) => hand.move(at(2 * k, k % 2 ? 6 : -6))?.y ?? 0);
    expect(Math.max(...heights.slice(20).map(Math.abs))).toBeLessThan(3);
  });
});

describe("tips and textures", () => {
  it("cover a part of the circle and fade to nothing at the rim", () => {
    for (const name of Object.keys(BUILT_IN_TIPS) as BuiltInTip[]) {
      const tip = builtInTip(name);
      if (!tip) continue;
      const share = sum(tip.data) / tip.data.length;
      expect(share, name).toBeGreaterThan(0.08);
      expect(share, name).toBeLessThan(0.95);
      expect(Math.max(...tip.data), name).toBeGreaterThan(0.9);
      for (let k = 0; k < TIP_PX; k++) expect(tip.data[k] + tip.data[k * TIP_PX], name).toBeLessThan(0.05);
    }
  });

  it("are as dark small as large", () => {
    const tip = builtInTip("spray")!;
    const cover = (radius: number) => {
      const mask = emptyMask(300, 300);
      stamp(mask, { x: 150.3, y: 150.2, frame: roundFrame(radius), flow: 1 }, tip, 1);
      return sum(mask.data) / (4 * radius * radius);
    };
    expect(cover(6) / cover(100)).toBeGreaterThan(0.85);
    expect(cover(6) / cover(100)).toBeLessThan(1.15);
  });

  it("come from pictures: what is dark, or what is opaque", () => {
    const data = new Uint8ClampedArray(64 * 32 * 4).fill(255);
    for (let y = 8; y < 24; y++) for (let x = 16; x < 48; x++) data.set([0, 0, 0, 255], (y * 64 + x) * 4);
    const dark = withHalves(TIP_PX, tipOfPicture({ width: 64, height: 32, data }));
    expect(coverOf(dark, 0, 0, 40)).toBeCloseTo(1);
    expect(coverOf(dark, 0, 0.4, 40)).toBeCloseTo(0);
    expect(coverOf(dark, 0, 0.8, 40)).toBe(0); // beyond the wide picture
    for (let k = 0; k < 64 * 32; k++) data[k * 4 + 3] = k % 64 < 32 ? 255 : 0;
    const opaque = withHalves(TIP_PX, tipOfPicture({ width: 64, height: 32, data }));
    expect(coverOf(opaque, -0.5, 0, 40)).toBeCloseTo(1);
    expect(coverOf(opaque, 0.5, 0, 40)).toBeCloseTo(0);
  });

  it("repeat without a seam", () => {
    for (const name of Object.keys(TEXTURES) as Texture[]) {
      const tile = textureTile(name);
      if (!tile) continue;
      const step = (a: number, b: number) => {
        let total = 0;
        for (let y = 0; y < TEXTURE_PX; y++) total += Math.abs(tile[y * TEXTURE_PX + a] - tile[y * TEXTURE_PX + b]);
        return total;
      };
      const inside = Array.from({ length: TEXTURE_PX - 1 }, (_, x) => step(x, x + 1));
      expect(step(TEXTURE_PX - 1, 0), name).toBeLessThanOrEqual(1.3 * Math.max(...inside) + 1e-6);
      expect(grainAt(tile, 3, 5, 1, 0.5)).toBeGreaterThanOrEqual(0.5);
      expect(grainAt(tile, 3, 5, 1, 1)).toBeCloseTo(grainAt(tile, 3 + TEXTURE_PX, 5 - TEXTURE_PX, 1, 1), 5);
    }
  });

  it("take from the paint of a stroke what the texture holds back", () => {
    const mask = emptyMask(4, 1);
    mask.data.fill(1);
    const rgba = compose(
      { x: 0, y: 0, width: 4, height: 1 },
      mask,
      null,
      1,
      solid([9, 8, 7], "normal", () => null),
      (x) => x / 4,
    );
    expect([3, 7, 11, 15].map((k) => rgba[k])).toEqual([0, 64, 128, 191]);
  });
});

describe("keep shading", () => {
  const base = (light: number): Rgb => [light, light, light];

  it("makes paint as much lighter or darker as the surface is than around", () => {
    const red: Rgb = [200, 60, 40];
    expect(shaded(red, base(100), 100, 1)).toEqual(red);
    expect(luma(...shaded(red, base(140), 100, 1))).toBeGreaterThan(luma(...red) + 20);
    expect(luma(...shaded(red, base(60), 100, 1))).toBeLessThan(luma(...red) - 20);
    expect(luma(...shaded(red, base(140), 100, 0.5))).toBeLessThan(luma(...shaded(red, base(140), 100, 1)));
    expect(shaded(red, base(140), 100, 0)).toBe(red);
  });

  it("leaves black black and white on a dark surface white", () => {
    expect(luma(...shaded([0, 0, 0], base(200), 100, 1))).toBe(0);
    expect(luma(...shaded([255, 255, 255], base(20), 20, 1))).toBeCloseTo(255);
    expect(luma(...shaded([255, 255, 255], base(10), 20, 1))).toBeGreaterThan(240); // the creases of dark leather
  });

  it("tells shading from the asset's pixels, not from the background's", () => {
    const data = new Uint8ClampedArray(20 * 20 * 4).fill(255);
    for (let k = 0; k < 400; k++) data.set(k % 20 < 10 ? [16, 17, 18] : [100, 100, 100], k * 4);
    const mean = localMean({ width: 20, height: 20, data }, [16, 17, 18], 6);
    expect(mean[10 * 20 + 10]).toBeCloseTo(100);
    expect(mean[10 * 20 + 1]).toBeCloseTo(luma(16, 17, 18)); // nothing of the asset is near
  });
});

describe("brushes on the surface", () => {
  const plane = (normal: [number, number, number]) => {
    const length = Math.hypot(...normal);
    const n = normal.map((v) => v / length);
    const [columns, rows, block] = [50, 38, 8];
    const data = new Float32Array(columns * rows * 4);
    for (let j = 0; j < rows; j++)
      for (let i = 0; i < columns; i++) {
        const ray = [((i + 0.5) * block - 200) / 500, ((j + 0.5) * block - 150) / 500, 1];
        const depth = (2 * n[2]) / (n[0] * ray[0] + n[1] * ray[1] + n[2]);
        data.set([depth, ...n], (j * columns + i) * 4);
      }
    return new SurfaceView(camera, block, columns, rows, data);
  };

  it("find the depth of a slanted plane exactly between the blocks", () => {
    const view = plane([0.4, 0.2, -1]);
    for (const [x, y] of [
      [201.3, 149.2],
      [77, 211],
      [300.5, 40.1],
    ]) {
      const ray = view.ray(x, y);
      const expected = -2 / (0.4 * ray[0] + 0.2 * ray[1] - 1);
      expect(view.at(x, y)!.point[2]).toBeCloseTo(expected, 4);
    }
    expect(new SurfaceView(camera, 8, 50, 38, new Float32Array(50 * 38 * 4)).at(10, 10)).toBeNull();
  });

  it("are foreshortened by the slant, in world units", () => {
    const front = plane([0, 0, -1]).at(200, 150)!;
    expect(frameOnSurface(camera, front, 0.1)).toEqual([25, expect.closeTo(0), expect.closeTo(0), 25]);
    expect(facingFrame(camera, 2, 0.1)).toEqual([25, 0, 0, 25]);
    const slanted = plane([Math.sin(Math.PI / 3), 0, -Math.cos(Math.PI / 3)]).at(200, 150)!;
    const [a, b, c, d] = frameOnSurface(camera, slanted, 0.1);
    expect(Math.hypot(a, c)).toBeCloseTo(12.5, 1); // 60 degrees: half as wide
    expect(Math.hypot(b, d)).toBeCloseTo(25, 1);
    expect(a * d - b * c).toBeGreaterThan(0); // not mirrored
  });

  it("stay wide enough to be seen at an outline", () => {
    const edge = {
      point: [0, 0, 2] as [number, number, number],
      normal: [0.999, 0, -0.04] as [number, number, number],
    };
    const [a, b, c, d] = frameOnSurface(camera, edge, 0.1);
    expect((a * d - b * c) / 625).toBeGreaterThan(0.2);
  });
});

describe("kept brushes", () => {
  it("come back from their file as they were", () => {
    const picture = Uint8Array.from({ length: TIP_PX * TIP_PX }, (_, k) => k % 251);
    const mine = { ...BUILT_IN_PRESETS[4], name: "Mine", engine: { ...PLAIN, tip: "picture" as const, picture } };
    const all = [...BUILT_IN_PRESETS, mine];
    expect(parsePresets(presetsText(all))).toEqual(all);
  });

  it.each([
    ["nonsense", "JSON"],
    ["{}", "saved"],
    ['{"format":"splatpainter.brushes","version":1,"brushes":[{"name":""}]}', "name"],
    ['{"format":"splatpainter.brushes","version":1,"brushes":[{"name":"a","size":1e9}]}', "size"],
    ['{"format":"splatpainter.brushes","version":1,"brushes":[{"name":"a","size":9,"engine":{"tip":"x"}}]}', "tip"],
    [
      '{"format":"splatpainter.brushes","version":1,"brushes":[{"name":"a","size":9,"engine":{"tip":"picture"}}]}',
      "96",
    ],
    [
      '{"format":"splatpainter.brushes","version":1,"brushes":[{"name":"a","size":9,"engine":{"spacing":null}}]}',
      "spacing",
    ],
  ])("say in one line what is wrong with %s", (text, word) => {
    expect(() => parsePresets(text)).toThrow(word);
  });

  it("and swatches are taken as far as they make sense", () => {
    expect(parseColors('["#102030", 5, "red", "#102030", "#ffffff"]')).toEqual(["#102030", "#ffffff"]);
    expect(parseColors("{")).toEqual([]);
    expect(parseColors(null)).toEqual([]);
  });
});
