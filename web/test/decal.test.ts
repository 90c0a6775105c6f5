import { describe, expect, it } from "vitest";

import {
  anchorAt,
  anchorPixel,
  angleOf,
  cardMap,
  decalBounds,
  decalHandles,
  drawDecal,
  upAt,
  type Anchor,
  type DecalMap,
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
      const anchor = anchorAt(ball(camera), 231, 140, 0, 0.01, null)!;
      expect(Math.hypot(...anchor.point)).toBeCloseTo(1, 2);
      const { x, y } = anchorPixel(camera, anchor);
      expect([x, y]).toEqual([expect.closeTo(231, 3), expect.closeTo(140, 3)]);
      expect(dot(anchor.up, anchor.normal)).toBeCloseTo(0, 6);
      const { corners, knob } = decalHandles(camera, anchor, 20, 10, 30);
      expect(knob[1]).toBeLessThan(y - 20);
      expect(corners[0][1]).toBeLessThan(corners[3][1]); // the upper corners are above
      expect(corners[0][0]).toBeLessThan(corners[1][0]); // and not mirrored
    }
    expect(anchorAt(ball(front), 3, 3, 0, 0.01, null)).toBeNull();
  });

  it("keep their angle, and tell it again on another view", () => {
    const anchor = anchorAt(ball(front), 200, 160, 0.7, 0.01, null)!;
    expect(angleOf(front, anchor, null)).toBeCloseTo(0.7, 6);
    const turned: Anchor = { ...anchor, up: upAt(side, anchor.normal, angleOf(side, anchor, null), null) };
    turned.up.forEach((v, k) => expect(v).toBeCloseTo(anchor.up[k], 6));
    const { corners } = decalHandles(front, anchor, 30, 10, 30);
    const edge = Math.atan2(corners[1][1] - corners[0][1], corners[1][0] - corners[0][0]);
    expect(edge).toBeCloseTo(0.7, 2); // clockwise on the screen
  });

  it("stand upright on the object, whichever way one looks at it", () => {
    const [level, above]: [Vec3, CameraJson] = [
      [0, -1, 0],
      toCamera(lookAt([2.4, -2.2, -3], [0, 0, 0], [0, -1, 0], 35), 400, 320, [0, 0, 0]),
    ];
    for (const [x, y] of [
      [150, 170],
      [240, 200],
    ]) {
      const anchor = anchorAt(ball(above), x, y, 0, 0.01, level)!;
      const right = cross(anchor.up, anchor.normal);
      expect(right[1]).toBeCloseTo(0, 6); // its lower edge is level
      expect(dot(anchor.up, level)).toBeGreaterThan(0.3);
      const leaning = anchorAt(ball(above), x, y, 0, 0.01, null)!;
      expect(Math.abs(cross(leaning.up, leaning.normal)[1])).toBeGreaterThan(0.02); // as the view has it, it would lean
    }
    const lid: Vec3 = unit([0.1, -1, 0]);
    expect(upAt(above, lid, 0, level)).toEqual(upAt(above, lid, 0, null)); // flat: as the view has it
  });

  it("are a flat card while they move", () => {
    const anchor = anchorAt(ball(side), 220, 150, 0.3, 0.01, null)!;
    const map = cardMap(side, anchor, [0.6, 0.4], 2);
    const right = cross(anchor.up, anchor.normal);
    let within = 0;
    for (let k = 0; k < map.columns * map.rows; k++) {
      const [u, v] = map.places.subarray(2 * k, 2 * k + 2);
      if (Number.isNaN(u)) continue;
      const at = anchor.point.map((p, axis) => p + u * right[axis] + v * anchor.up[axis]) as Vec3;
      const pixel = anchorPixel(side, { ...anchor, point: at });
      expect(pixel.x).toBeCloseTo(((k % map.columns) + 0.5) * 2, 2);
      expect(pixel.y).toBeCloseTo((Math.floor(k / map.columns) + 0.5) * 2, 2);
      within++;
    }
    expect(within).toBeGreaterThan(500);
    const away: Anchor = { ...anchor, normal: anchor.normal.map((v) => -v) as Vec3 };
    expect(decalBounds(cardMap(side, away, [0.6, 0.4], 2), side, 1, 1)).toBeNull();
  });

  it("show the picture the right way round, and nothing beside it", () => {
    const anchor = anchorAt(ball(front), 200, 160, 0, 0.01, null)!;
    const map: DecalMap = cardMap(front, anchor, [0.6, 0.4], 2);
    const data = new Uint8ClampedArray(2 * 2 * 4);
    [
      [255, 0, 0],
      [0, 255, 0],
      [0, 0, 255],
      [255, 255, 0],
    ].forEach((rgb, k) => data.set([...rgb, 255], k * 4));
    const part = decalBounds(map, front, 0.3, 0.2)!;
    const out = drawDecal(map, { width: 2, height: 2, data }, [0.6, 0.4], part);
    const pixel = (x: number, y: number) => [...out.subarray(((y - part.y) * part.width + x - part.x) * 4).slice(0, 4)];
    expect(pixel(190, 150)).toEqual([255, 0, 0, 255]);
    expect(pixel(210, 150)).toEqual([0, 255, 0, 255]);
    expect(pixel(190, 170)).toEqual([0, 0, 255, 255]);
    expect(pixel(210, 170)).toEqual([255, 255, 0, 255]);
    expect(pixel(part.x, part.y)[3]).toBe(0);
    const none = { ...map, places: new Float32Array(map.places.length).fill(NaN) };
    expect(decalBounds(none, front, 1, 1)).toBeNull();
  });
});
