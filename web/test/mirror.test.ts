import { describe, expect, it } from "vitest";

import { adjusted, mirrored, outlineOf, planeAt } from "../src/paint/mirror";
import { dot, type Vec3 } from "../src/view/camera";

const UP: Vec3 = [0, -1, 0];
const close = (a: Vec3, b: Vec3) => a.forEach((v, k) => expect(v).toBeCloseTo(b[k], 9));

describe("a plane of symmetry", () => {
  it("brings points to the other side and back", () => {
    const plane = planeAt([1, 2, -1], [0.3, 0, 0.2]);
    const there = mirrored(plane, [1, 2, 3]);
    expect(dot(plane.normal, there) - plane.offset).toBeCloseTo(-(dot(plane.normal, [1, 2, 3]) - plane.offset), 9);
    close(mirrored(plane, there), [1, 2, 3]);
    close(mirrored(planeAt([1, 0, 0], [0.5, 9, 9]), [2, 1, 1]), [-1, 1, 1]);
  });

  it("is moved along its normal and turned about the asset", () => {
    const plane = planeAt([1, 0, 0], [0, 0, 0]);
    const center: Vec3 = [0.2, 0.1, 0.4];
    expect(adjusted(plane, center, UP, 0, 0, 0)).toEqual({ normal: [1, 0, 0], offset: expect.closeTo(0) });
    expect(adjusted(plane, center, UP, 0.3, 0, 0).offset).toBeCloseTo(0.3, 9);
    const turned = adjusted(plane, center, UP, 0, 90, 0);
    expect(Math.abs(turned.normal[2])).toBeCloseTo(1, 9);
    expect(turned.offset).toBeCloseTo(turned.normal[2] * 0.4, 9); // through the same middle
    const leaning = adjusted(plane, center, UP, 0, 0, 30);
    expect(Math.abs(leaning.normal[1])).toBeCloseTo(0.5, 9);
    expect(leaning.normal[2]).toBeCloseTo(0, 9);
  });

  it("is shown as a circle in it", () => {
    const plane = planeAt([0.2, -0.5, 1], [1, 0, 0]);
    for (const point of outlineOf(plane, [1, 1, 1], 2)) expect(dot(plane.normal, point)).toBeCloseTo(plane.offset, 9);
  });
});
