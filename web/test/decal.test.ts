import { describe, expect, it } from "vitest";

import {
  anchorAt,
  anchorPixel,
  angleOf,
  decalBounds,
  decalHandles,
  decalMap,
  drawDecal,
  upAt,
  type Anchor,
} from "../src/paint/decal";
import { SurfaceView } from "../src/paint/surface-blocks";
import { cross, dot, lookAt, toCamera, unit, type CameraJson, type Vec3 } from "../src/view/camera";

const BLOCK = 4;

/** What a camera sees of a ball of radius 1 in the origin. */
function ball(camera: CameraJson): SurfaceView {
  const [columns, rows] = [Math.ceil(camera.width / BLOCK), Math.ceil(camera.height / BLOCK)];
  const data = new Float32Array(columns * rows * 4);
  const [right, down, forward] = camera.world_to_camera.slice(0, 3);
  const middle: Vec3 = [right[3], down[3], forward[3]];
  for (let k = 0; k < columns * rows; k++) {
    const [x, y] = [((k % columns) + 0.5) * BLOCK, (Math.floor(k / columns) + 0.5) * BLOCK];
    const ray: Vec3 = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1];
    const [a, b, c] = [dot(ray, ray), dot(ray, middle), dot(middle, middle) - 1];
    if (b * b < a * c) continue;
    const depth = (b - Math.sqrt(b * b - a * c)) / a;
    const normal = unit(ray.map((v, axis) => v * depth - middle[axis]) as Vec3);
    data.set([depth, ...normal], k * 4);
  }
  return new SurfaceView(camera, BLOCK, columns, rows, data);
}
const front = toCamera(lookAt([0, 0, -4], [0, 0, 0], [0, -1, 0], 35), 400, 320, [0, 0, 0]);
const side = toCamera(lookAt([2.4, -1.2, -3], [0, 0, 0], [0, -1, 0], 35), 400, 320, [0, 0, 0]);

describe("pictures on the surface", () => {
  it("have their middle under the pixel, and their up as the view has it", () => {
    for (const camera of [front, side]) {
      const anchor = anchorAt(ball(camera), 231, 140, 0, 0.01)!;
      expect(Math.hypot(...anchor.point)).toBeCloseTo(1, 2);
      const { x, y } = anchorPixel(camera, anchor);
      expect([x, y]).toEqual([expect.closeTo(231, 3), expect.closeTo(140, 3)]);
      expect(dot(anchor.up, anchor.normal)).toBeCloseTo(0, 6);
      const { corners, knob } = decalHandles(camera, anchor, 20, 10, 30);
      expect(knob[1]).toBeLessThan(y - 20);
      expect(corners[0][1]).toBeLessThan(corners[3][1]); // the upper corners are above
      expect(corners[0][0]).toBeLessThan(corners[1][0]); // and not mirrored
    }
    expect(anchorAt(ball(front), 3, 3, 0, 0.01)).toBeNull();
  });

  it("keep their angle, and tell it again on another view", () => {
    const anchor = anchorAt(ball(front), 200, 160, 0.7, 0.01)!;
    expect(angleOf(front, anchor)).toBeCloseTo(0.7, 6);
    const turned: Anchor = { ...anchor, up: upAt(side, anchor.normal, angleOf(side, anchor)) };
    turned.up.forEach((v, k) => expect(v).toBeCloseTo(anchor.up[k], 6));
    const { corners } = decalHandles(front, anchor, 30, 10, 30);
    const edge = Math.atan2(corners[1][1] - corners[0][1], corners[1][0] - corners[0][0]);
    expect(edge).toBeCloseTo(0.7, 2); // clockwise on the screen
  });

  it("measure lengths along the surface", () => {
    const view = ball(front);
    const anchor = anchorAt(view, 200, 160, 0, 0.01)!;
    const map = decalMap(view, anchor, 180);
    let seen = 0;
    for (let k = 0; k < view.columns * view.rows; k++) {
      const at = view.blockAt(k);
      if (!at) continue;
      const cosine = Math.max(-1, Math.min(1, -at.normal[2])); // the anchor faces the camera
      expect(Math.hypot(map[2 * k], map[2 * k + 1])).toBeCloseTo(Math.acos(cosine), 1);
      seen++;
    }
    expect(seen).toBeGreaterThan(500);
  });

  it("end at the wrap limit", () => {
    const view = ball(front);
    const anchor = anchorAt(view, 200, 160, 0, 0.01)!;
    const reach = (limit: number) => {
      const map = decalMap(view, anchor, limit);
      return Math.max(...Array.from(map).filter((v) => !Number.isNaN(v)));
    };
    expect(reach(30)).toBeLessThan(Math.PI / 6 + 0.02);
    expect(reach(30)).toBeGreaterThan(Math.PI / 6 - 0.06);
    expect(reach(180)).toBeGreaterThan(1);
  });

  it("show the picture the right way round, and nothing beside it", () => {
    const view = ball(front);
    const anchor = anchorAt(view, 200, 160, 0, 0.01)!;
    const map = decalMap(view, anchor, 180);
    const data = new Uint8ClampedArray(2 * 2 * 4);
    [
      [255, 0, 0],
      [0, 255, 0],
      [0, 0, 255],
      [255, 255, 0],
    ].forEach((rgb, k) => data.set([...rgb, 255], k * 4));
    const part = decalBounds(view, map, 0.3, 0.2)!;
    const out = drawDecal(view, map, { width: 2, height: 2, data }, [0.6, 0.4], part);
    const pixel = (x: number, y: number) => [...out.subarray(((y - part.y) * part.width + x - part.x) * 4).slice(0, 4)];
    expect(pixel(190, 150)).toEqual([255, 0, 0, 255]);
    expect(pixel(210, 150)).toEqual([0, 255, 0, 255]);
    expect(pixel(190, 170)).toEqual([0, 0, 255, 255]);
    expect(pixel(210, 170)).toEqual([255, 255, 0, 255]);
    expect(pixel(part.x, part.y)[3]).toBe(0);
    expect(decalBounds(view, new Float32Array(map.length).fill(NaN), 1, 1)).toBeNull();
  });

  it("do not jump to what stands behind", () => {
    const view = ball(front);
    const anchor = anchorAt(view, 200, 160, 0, 0.01)!;
    const behind = new Float32Array(view.columns * view.rows * 4);
    for (let k = 0; k < view.columns * view.rows; k++) {
      const at = view.blockAt(k);
      if (at) behind.set([at.point[2] + (k % view.columns > 60 ? 2 : 0), ...at.normal], 4 * k);
    }
    const map = decalMap(new SurfaceView(front, BLOCK, view.columns, view.rows, behind), anchor, 180);
    const row = Math.floor(160 / BLOCK) * view.columns;
    expect(map[2 * (row + 55)]).toBeGreaterThan(0);
    expect(map[2 * (row + 65)]).toBeNaN();
    expect(dot(cross(anchor.up, anchor.normal), [1, 0, 0])).toBeGreaterThan(0.9);
  });
});
