import { beforeEach, describe, expect, it } from "vitest";

import { WRITING, type State } from "../src/messages";
import { activity, LOADING_GAUSSIANS, openAsset } from "../src/state/activity";
import { answerStorage, noteStorage } from "../src/state/storage";
import { drawn, opening, pendingStrokes, saving, state, status, swapped, working } from "../src/state/store";

const settled = { behind: false, written: 0, total: 0, version: 4 };

beforeEach(() => {
  state.value = { version: 4 } as State;
  drawn.value = settled;
  for (const count of [pendingStrokes, saving, working, opening]) count.value = 0;
});

describe("the state", () => {
  it("is Saved only where nothing is under way and the picture shows it", () => {
    expect(activity.value).toBe("Saved");
    drawn.value = { ...settled, behind: true };
    expect(activity.value).toBe("Drawing");
    drawn.value = settled;
    state.value = { version: 5 } as State; // its Gaussians have not come
    expect(activity.value).toBe("Drawing");
    drawn.value = { ...settled, version: 5 };
    expect(activity.value).toBe("Saved");
  });

  it("is Saving while a stroke or a command that writes has no answer, whatever else goes on", () => {
    for (const count of [pendingStrokes, saving]) {
      [count.value, working.value, opening.value] = [1, 1, 1];
      expect(activity.value).toBe("Saving");
      count.value = 0;
    }
  });

  it("is Waiting while strokes wait for an answer of the user", () => {
    pendingStrokes.value = 2;
    noteStorage("the disk is full", "");
    expect(activity.value).toBe("Waiting");
    answerStorage(true);
    expect(activity.value).toBe("Saving");
    swapped.value = { id: "one", name: "one", file: null, layers: 1, changed: 0, steps: 3, sha256: "" };
    expect(activity.value).toBe("Waiting");
    swapped.value = null;
  });

  it("is Working while a turntable renders, which changes nothing", () => {
    expect(["turntable", "export", "verify", "view.render"].filter((name) => WRITING.has(name as never))).toEqual([]);
    expect(["paint.end", "layer.set", "undo", "look.commit"].every((name) => WRITING.has(name as never))).toBe(true);
    working.value = 1;
    expect(activity.value).toBe("Working");
  });

  it("says of the asset what is true before it has come", () => {
    state.value = null;
    for (const one of ["connecting", "open", "lost"] as const) {
      status.value = one;
      expect(openAsset.value).toBe("Opening the asset");
    }
    status.value = "stopped";
    expect(openAsset.value).toBe("Nothing open");
    state.value = { version: 1, asset: { gaussians: 1234567 } } as State;
    expect(openAsset.value).toBe(`${(1234567).toLocaleString()} Gaussians`);
  });

  it("is Loading while an asset is on its way", () => {
    drawn.value = { behind: true, written: 10, total: LOADING_GAUSSIANS, version: 4 };
    expect(activity.value).toBe("Loading");
    drawn.value = settled;
    opening.value = 1;
    expect(activity.value).toBe("Loading");
    opening.value = 0;
    state.value = null;
    expect(activity.value).toBe("Loading");
  });
});
