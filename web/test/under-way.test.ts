import { afterAll, beforeEach, describe, expect, it, vi } from "vitest";

import type { LayerInfo, SceneAssetInfo, State } from "../src/messages";

/** Commands that the server was sent, and their ends: null is a refusal. */
const server = { sent: [] as { fields: object; end: (answer: object | null) => void }[] };

// Files of tests share their modules: these are loaded anew for this one, with another editor.
vi.resetModules();
vi.doMock("../src/editor/editor", () => ({
  editor: {},
  run: (_name: string, fields: object) =>
    new Promise<object | null>((resolve) => server.sent.push({ fields, end: resolve })),
}));
const { assets, draggedAsset, setAsset } = await import("../src/state/assets");
const { dragged, duringLayer, isPending, moveLayer, setLayer, shownLayers } =
  await import("../src/state/pending-layers");
const { setUp, shownUp } = await import("../src/state/shown-up");
const { state } = await import("../src/state/store");
const { during, isUnderWay, withUnderWay } = await import("../src/state/under-way");
afterAll(() => {
  vi.doUnmock("../src/editor/editor");
  vi.resetModules();
});

const layer = (id: string, rest: Partial<LayerInfo> = {}) =>
  ({ id, name: id, opacity: 1, visible: true, blend: "normal", parameters: {}, mask: null, ...rest }) as LayerInfo;
const asset = (rest: Partial<SceneAssetInfo> = {}) =>
  ({
    id: "",
    name: "a",
    visible: true,
    move: [5, 0, 0],
    moved: [0, 0, 0],
    turn: [0, 0, 0],
    scale: 1,
    ...rest,
  }) as SceneAssetInfo;
const say = (rest: Partial<State>): void =>
  void (state.value = { layers: [], assets: [], asset: { up: [0, -1, 0] }, ...rest } as unknown as State);
/** End the first command that has not ended, as the server does: what it says comes first. */
async function end(says: Partial<State>, answer: object | null = {}): Promise<void> {
  say(says);
  server.sent.shift()!.end(answer);
  for (let k = 0; k < 8; k++) await Promise.resolve();
}

beforeEach(() => {
  expect(server.sent).toEqual([]);
  say({ layers: [layer("1"), layer("2")], assets: [asset()] });
});

describe("what is under way", () => {
  it("stands over what the server says, the newest last, until its own work has ended", async () => {
    const ends: (() => void)[] = [];
    const work = () => new Promise<void>((resolve) => ends.push(resolve));
    const all = [3, 4].map((value) => during("it", () => value, work()));
    expect([withUnderWay("it", 1), withUnderWay("another", 1)]).toEqual([4, 1]);
    ends[0]();
    await all[0];
    expect(withUnderWay("it", 3)).toBe(4);
    ends[1]();
    await all[1];
    expect([withUnderWay("it", 5), isUnderWay("it")]).toEqual([5, false]);
    await expect(during("it", () => 7, Promise.reject(new Error("no")))).rejects.toThrow("no");
    expect(withUnderWay("it", 5)).toBe(5);
  });
});

describe("layers", () => {
  const opacity = () => shownLayers.value[0].opacity;

  it("keep the newest of two changes while the answer to the first comes in", async () => {
    void setLayer("1", { opacity: 0.5 }, "");
    void setLayer("1", { opacity: 0.2 }, "");
    await end({ layers: [layer("1", { opacity: 0.5 })] });
    expect([opacity(), isPending("1")]).toEqual([0.2, true]);
    await end({ layers: [layer("1", { opacity: 0.5 })] }, null); // refused
    expect([opacity(), isPending("1")]).toEqual([0.5, false]);
  });

  it("stand where a drag is, also while the next drag waits for the one before", async () => {
    const first = dragged("1", "Opacity");
    void first({ opacity: 0.8 });
    void first({ opacity: 0.7 });
    const second = dragged("1", "Opacity");
    void second({ opacity: 0.3 });
    void second({ opacity: 0.1 });
    await end({ layers: [layer("1", { opacity: 0.8 })] });
    expect(opacity()).toBe(0.1);
    await end({ layers: [layer("1", { opacity: 0.3 })] });
    await end({ layers: [layer("1", { opacity: 0.7 })] });
    expect([opacity(), server.sent.length]).toEqual([0.1, 1]);
    await end({ layers: [layer("1", { opacity: 0.1 })] });
    expect([opacity(), isPending("1")]).toEqual([0.1, false]);
  });

  it("have the options that were set, beside those that were not", async () => {
    say({ layers: [layer("1", { parameters: { look: "grade", tint: 1 } })] });
    void setLayer("1", { parameters: { tint: 2 } }, "");
    expect(shownLayers.value[0].parameters).toEqual({ look: "grade", tint: 2 });
    await end({ layers: [layer("1", { parameters: { look: "grade", tint: 2 } })] });
  });

  it("are moved, masked and marked at once", async () => {
    const order = () => shownLayers.value.map(({ id }) => id);
    void moveLayer("1", 1, "");
    expect([order(), isPending("1"), isPending("2")]).toEqual([["2", "1"], true, false]);
    await end({ layers: [layer("2"), layer("1")] });
    expect([order(), isPending("1")]).toEqual([["2", "1"], false]);
    const mask = { enabled: false, shows: true, parts: 0 };
    void duringLayer("2", { mask }, new Promise(() => {}));
    expect(shownLayers.value[0].mask).toEqual(mask);
  });
});

describe("assets", () => {
  it("keep all of two numbers that were written one after the other", async () => {
    const write = (move: number[]) => void draggedAsset("")({ move });
    write([6, 0, 0]);
    const [{ move, moved }] = assets.value;
    expect([move, moved]).toEqual([
      [6, 0, 0],
      [1, 0, 0],
    ]);
    write([move[0], 2, 0]);
    await end({ assets: [asset({ move: [6, 0, 0], moved: [1, 0, 0] })] });
    expect(assets.value[0]).toMatchObject({ move: [6, 2, 0], moved: [1, 2, 0] });
    expect(server.sent[0].fields).toMatchObject({ move: [6, 2, 0] });
    await end({ assets: [asset({ move: [6, 2, 0], moved: [1, 2, 0] })] });
    expect(assets.value[0]).toMatchObject({ move: [6, 2, 0], moved: [1, 2, 0] });
  });

  it("send of a drag the newest, with all that it has changed", async () => {
    const send = draggedAsset("");
    void send({ move: [1, 0, 0] });
    void send({ turn: [0, 9, 0] });
    const last = send({ scale: 2 });
    await end({ assets: [asset({ move: [1, 0, 0] })] });
    expect(server.sent.map(({ fields }) => fields)).toMatchObject([{ move: [1, 0, 0], turn: [0, 9, 0], scale: 2 }]);
    expect(assets.value[0].scale).toBe(2);
    await end({ assets: [asset({ scale: 2 })] });
    await last;
  });

  it("have the name and the eye that were chosen last", async () => {
    void setAsset("", { visible: false }, "");
    void setAsset("", { name: "b" }, "");
    await end({ assets: [asset({ visible: false })] });
    expect(assets.value[0]).toMatchObject({ visible: false, name: "b" });
    await end({ assets: [asset({ visible: false })] }, null);
    expect(assets.value[0].name).toBe("a");
  });

  it("stand as they were turned last", async () => {
    void setUp("+z", "");
    void setUp("+x", "");
    await end({ asset: { up: [0, 0, 1] } as State["asset"] });
    expect(shownUp.value).toBe("+x");
    await end({ asset: { up: [1, 0, 0] } as State["asset"] });
    expect(shownUp.value).toBe("+x");
  });
});
