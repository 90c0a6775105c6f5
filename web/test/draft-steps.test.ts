import { describe, expect, it } from "vitest";

import { DraftSteps } from "../src/state/draft-steps";

describe("changes that are not applied yet", () => {
  it("go back one after the other, and come again", () => {
    const steps = new DraftSteps<string>();
    steps.note("first");
    steps.note("second"); // it stands at a third place now
    expect(steps.back("third")).toBe("second");
    expect(steps.back("second")).toBe("first");
    expect(steps.back("first")).toBeNull();
    expect(steps.again("first")).toBe("second");
    expect(steps.again("second")).toBe("third");
    expect(steps.again("third")).toBeNull();
    expect(steps.back("third")).toBe("second");
  });

  it("do not come again after another drag", () => {
    const steps = new DraftSteps<number>();
    steps.note(0);
    expect(steps.back(1)).toBe(0);
    expect(steps.canAgain).toBe(true);
    steps.note(0);
    expect(steps.canAgain).toBe(false);
    expect(steps.again(2)).toBeNull();
    expect(steps.back(2)).toBe(0);
  });

  it("leave a click and a drag that was taken back out", () => {
    const steps = new DraftSteps<number>();
    steps.note(0);
    steps.note(1);
    steps.dropLast();
    expect(steps.back(1)).toBe(0);
    steps.forget();
    expect([steps.back(0), steps.again(0), steps.canAgain]).toEqual([null, null, false]);
  });
});
