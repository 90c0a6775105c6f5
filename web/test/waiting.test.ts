import { beforeEach, describe, expect, it } from "vitest";

import type { State } from "../src/messages";
import { state, status } from "../src/state/store";
import { giveUpWaiting, leftNow, noteLeft, projectIsBack, projectOf, waitingElsewhere } from "../src/state/waiting";

/** A state of a project in which `steps` were done. */
const of = (id: string, steps = 3, sha256 = "a"): State =>
  ({
    project: { id, name: id, file: null },
    asset: { sha256 },
    layers: [],
    history: Array(steps).fill({}),
  }) as unknown as State;

/** What a promise resolved with so far; null: it has not. */
async function soFar<T>(promise: Promise<T>): Promise<T | null> {
  return Promise.race([promise, Promise.resolve(null)]); // no clock: other tests may hold it
}

beforeEach(() => {
  giveUpWaiting();
  status.value = "open";
  state.value = of("one");
});

describe("what waits for its project", () => {
  it("goes on where that is open, and waits while another one is", async () => {
    expect(await projectIsBack("one")).toBe(true);
    state.value = of("two");
    const back = projectIsBack("one");
    expect(await soFar(back)).toBe(null);
    expect(waitingElsewhere.value).toBe("one");
    state.value = of("one");
    expect(await back).toBe(true);
    expect(waitingElsewhere.value).toBe(null);
  });

  it("waits for the connection as well, and asks nothing before it is there", async () => {
    status.value = "lost";
    const back = projectIsBack("one");
    expect(await soFar(back)).toBe(null);
    expect(waitingElsewhere.value).toBe(null);
    status.value = "open";
    expect(await back).toBe(true);
  });

  it("is given up with all that is still to come, until that project is open again", async () => {
    state.value = of("two");
    const first = projectIsBack("one");
    giveUpWaiting();
    expect(await first).toBe(false);
    expect(await projectIsBack("one")).toBe(false); // the next of the same queue
    state.value = of("one");
    state.value = of("two");
    expect(await soFar(projectIsBack("one"))).toBe(null);
  });

  it("goes into the project that took the place of one in which nothing was done, over the same asset only", async () => {
    noteLeft(leftNow(of("empty", 1)), of("fresh", 1));
    state.value = of("fresh", 1);
    expect(await projectIsBack("empty")).toBe(true);
    noteLeft(leftNow(of("painted", 2)), of("fresh", 1));
    expect(await soFar(projectIsBack("painted"))).toBe(null);
    noteLeft(leftNow(of("other", 1, "b")), of("fresh", 1));
    expect(await soFar(projectIsBack("other"))).toBe(null);
  });

  it("is known by the name of its project, shown or left", () => {
    expect(projectOf("one")?.name).toBe("one");
    expect(projectOf("left")).toBe(null);
    noteLeft({ ...leftNow(of("left", 4)), name: "vase.ply" }, of("one"));
    expect(projectOf("left")).toMatchObject({ name: "vase.ply", steps: 4 });
  });
});
