import { expect, test } from "vitest";

import { alongAxis, boxHandles, handleAt, withFace, type Box } from "../src/paint/crop-box";
import { state } from "../src/state/store";
import { lookAt, project, toCamera, type Vec3 } from "../src/view/camera";

const view = toCamera(lookAt([2, -1.5, -4], [0, 0, 0], [0, -1, 0], 45), 400, 300, [0, 0, 0]);
const box: Box = { low: [-1, -1, -1], high: [1, 1, 1] };

test("a handle lies on the middle of each face, and is found there", () => {
  const handles = boxHandles(box, view);
  expect(handles).toHaveLength(6);
  for (const { at, axis, side, x, y } of handles) {
    expect(at).toEqual([0, 1, 2].map((k) => (k === axis ? box[side][axis] : 0)));
    const [px, py] = project(view, at);
    expect([x, y]).toEqual([px, py]);
    expect(handleAt(box, view, x + 3, y - 3)).toMatchObject({ axis, side });
  }
  expect(handleAt(box, view, 2, 2)).toBeNull();
});

test("a drag to where a point of the axis is seen goes to that point", () => {
  const from: Vec3 = [1, 0, 0];
  for (const to of [-0.5, 0.3, 1.7]) {
    const [x, y] = project(view, [to, 0, 0]);
    expect(alongAxis(view, from, [1, 0, 0], x, y)).toBeCloseTo(to - 1, 9);
  }
  const ahead = toCamera(lookAt([0, 0, -4], [0, 0, 0], [0, -1, 0], 45), 400, 300, [0, 0, 0]);
  expect(alongAxis(ahead, [0, 0, 1], [0, 0, 1], 200, 150)).toBeNull();
});

test("a face stays on its side of the other one, and near the asset", () => {
  state.value = { asset: { center: [0, 0, 0], radius: 2 } } as never;
  expect(withFace(box, { axis: 1, side: "low" }, 0.25)).toEqual({ low: [-1, 0.25, -1], high: [1, 1, 1] });
  expect(withFace(box, { axis: 1, side: "low" }, 9).low[1]).toBeCloseTo(0.98);
  expect(withFace(box, { axis: 2, side: "high" }, 99).high[2]).toBe(3);
  expect(box).toEqual({ low: [-1, -1, -1], high: [1, 1, 1] });
  state.value = null;
});
