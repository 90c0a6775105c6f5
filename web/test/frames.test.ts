import { describe, expect, it } from "vitest";

import {
  FRAME_COLORS_ONLY,
  FRAME_FORMAT,
  FRAME_MAGIC,
  FRAME_PACKED,
  FRAME_PREVIEW,
  FRAME_SNAPSHOT,
} from "../src/messages";
import { parseFrame } from "../src/net/frames";
import { makeFrame } from "./make_frame";

describe("frames", () => {
  it("reads a delta array after array", () => {
    const frame = parseFrame(makeFrame(0, 4, 5, 10, [7, 9], 4));
    expect([frame.snapshot, frame.preview, frame.from, frame.to, frame.total]).toEqual([false, false, 4, 5, 10]);
    expect([...frame.indices!]).toEqual([7, 9]);
    expect([...frame.gaussians.shape!.means]).toEqual([0, 1, 2, 3, 4, 5]);
    expect(frame.gaussians.shape!.scales[0]).toBe(6);
    expect(frame.gaussians.shape!.quats[0]).toBe(12);
    expect([...frame.gaussians.opacities]).toEqual([20, 21]);
    expect(frame.gaussians.sh.length).toBe(24);
    expect(frame.gaussians.sh[23]).toBe(45);
  });

  it("reads snapshots and previews of colours", () => {
    const all = parseFrame(makeFrame(FRAME_SNAPSHOT, 0, 3, 2, [0, 1], 1));
    expect(all.indices).toBeNull();
    expect(all.gaussians.count).toBe(2);
    const colors = parseFrame(makeFrame(FRAME_PREVIEW | FRAME_COLORS_ONLY, 3, 3, 2, [1], 1));
    expect(colors.preview).toBe(true);
    expect(colors.gaussians.shape).toBeNull();
    expect([...colors.gaussians.opacities]).toEqual([0]);
  });

  it("reads packed colours of some Gaussians and of all", () => {
    const head = (total: number, count: number, bands: number) => [
      FRAME_MAGIC,
      FRAME_FORMAT,
      FRAME_PREVIEW | FRAME_PACKED,
      3,
      3,
      total,
      count,
      bands,
    ];
    const some = parseFrame(new Uint32Array([...head(9, 1, 2), 7, 0x3800_3400, 0x3c00, 0xabcdef12]).buffer);
    expect([...some.indices!]).toEqual([7]);
    expect([...some.gaussians.packedColors!.base]).toEqual([0x3400, 0x3800, 0x3c00]);
    expect([...some.gaussians.packedColors!.codes]).toEqual([0xabcdef12]);
    expect(some.gaussians.shape).toBeNull();
    const all = parseFrame(new Uint32Array([...head(2, 2, 1), 1, 2, 3]).buffer);
    expect(all.indices).toBeNull();
    expect(all.preview && !all.snapshot).toBe(true);
    expect(all.gaussians.packedColors!.codes.length).toBe(0);
    expect(() => parseFrame(new Uint32Array([...head(2, 2, 1), 1, 2]).buffer)).toThrow("bytes");
  });

  it("refuses what is no frame, saying why", () => {
    expect(() => parseFrame(new ArrayBuffer(8))).toThrow("less than a header");
    const broken = (at: number, value: number) => {
      const buffer = makeFrame(0, 0, 1, 4, [1], 1);
      new Uint32Array(buffer)[at] = value;
      return buffer;
    };
    expect(() => parseFrame(broken(0, 1))).toThrow("magic");
    expect(() => parseFrame(broken(1, 9))).toThrow("reload the page");
    expect(() => parseFrame(broken(6, 2))).toThrow("bytes");
    expect(() => parseFrame(broken(8, 4))).toThrow("Gaussian 4 of 4");
  });
});
