import { expect, test } from "vitest";

import { AXES, axisName, OPPOSITE } from "../src/state/up-axis";

test("axes have names, and an opposite that leads back", () => {
  expect(axisName([0, -1, 0])).toBe("-y");
  expect(axisName([0, 0, 1])).toBe("+z");
  expect(axisName([0, 0, 0])).toBe(null);
  expect(axisName(undefined)).toBe(null);
  expect(new Set(AXES).size).toBe(6);
  for (const axis of AXES) expect(OPPOSITE[OPPOSITE[axis]]).toBe(axis);
});
