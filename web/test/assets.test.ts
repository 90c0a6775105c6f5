import { expect, test } from "vitest";

import { grown, matrixOf, turned, turnOf } from "../src/state/assets";

const close = (a: readonly number[], b: readonly number[]) =>
  a.forEach((value, k) => expect(value).toBeCloseTo(b[k], 6));

test("angles about x, y, z and back", () => {
  close(turnOf(matrixOf([20, -75, 130])), [20, -75, 130]);
  const upright = matrixOf([0, 0, 90]);
  close(upright.flat(), [0, -1, 0, 1, 0, 0, 0, 0, 1]);
  const locked = matrixOf([25, 90, 0]);
  close(matrixOf(turnOf(locked)).flat(), locked.flat());
});

test("turning and growing keep the middle where it is", () => {
  const stand = { move: [1, 2, 3], turn: [10, 20, 30], scale: 2 };
  const local = [0.3, -0.1, 0.2];
  const at = (one: typeof stand) =>
    matrixOf(one.turn).map(
      (row, k) => one.scale * (row[0] * local[0] + row[1] * local[1] + row[2] * local[2]) + one.move[k],
    );
  const center = at(stand) as [number, number, number];
  const after = turned(stand, 1, 40, center);
  close(at(after), center);
  close(turnOf(matrixOf(after.turn)), after.turn);
  close(turned(after, 1, -40, center).turn, stand.turn);
  const larger = grown(stand, 1.5, center);
  expect(larger.scale).toBe(3);
  close(at(larger), center);
});
