import { expect, it } from "vitest";

import { parseFrame, type Frame } from "../src/net/frames";
import { UploadQueue, type Target } from "../src/splats/upload-queue";
import { FRAME_SNAPSHOT } from "../src/messages";
import { makeFrame } from "./make_frame";

const frameOf = (rows: number): Frame =>
  parseFrame(
    makeFrame(
      FRAME_SNAPSHOT,
      0,
      1,
      rows,
      Array.from({ length: rows }, (_, k) => k),
      1,
    ),
  );

class Table implements Target {
  readonly rows: number[] = [];
  shown = 0;
  write(_: Frame, from: number, to: number): void {
    for (let k = from; k < to; k++) this.rows.push(k);
  }
  finish(): void {
    this.shown = this.rows.length;
  }
}

/** An uploads whose clock advances by `each` milliseconds whenever it is read, and whose pauses end when told. */
function setUp(each: number) {
  let time = 0;
  const order: Frame[] = [];
  const pauses: (() => void)[] = [];
  const loads: { written: number; total: number }[] = [];
  const uploads: UploadQueue<Table> = new UploadQueue<Table>(
    (_, frame) => order.push(frame),
    (go) => pauses.push(go),
    () => (time += each),
    () => loads.push(uploads.load),
  );
  return { uploads, order, pauses, loads };
}

it("finishes small frames at once", () => {
  const { uploads, order, pauses } = setUp(0);
  const table = new Table();
  const frame = frameOf(3000);
  uploads.add(table, frame);
  expect(table.rows).toEqual(Array.from({ length: 3000 }, (_, k) => k));
  expect([table.shown, order, pauses]).toEqual([3000, [frame], []]);
});

it("pauses in large ones, shows them whole, and keeps the order", async () => {
  const { uploads, order, pauses } = setUp(5);
  const table = new Table();
  const [large, small] = [frameOf(10_000), frameOf(10)];
  uploads.add(table, large);
  uploads.add(table, small);
  let idle = false;
  const waiting = uploads.idle().then(() => (idle = true));
  for (let k = 0; pauses.length && k < 100; k++) {
    expect([table.shown, idle, pauses.length]).toEqual([order.length ? 10_000 : 0, false, 1]);
    pauses.shift()!();
  }
  expect(order).toEqual([large, small]);
  expect(table.rows.slice(0, 10_000)).toEqual(Array.from({ length: 10_000 }, (_, k) => k));
  await waiting;
  expect(idle).toBe(true);
});

it("forgets what a snapshot replaces", () => {
  const { uploads, order, pauses } = setUp(5);
  const [old, next] = [new Table(), new Table()];
  uploads.add(old, frameOf(10_000));
  expect(uploads.clear()).toEqual([old]);
  const frame = frameOf(5);
  uploads.add(next, frame);
  while (pauses.length) pauses.shift()!();
  expect([old.shown, next.shown, order]).toEqual([0, 5, [frame]]);
});

it("says how much of a large one is written, after each slice", () => {
  const { uploads, pauses, loads } = setUp(5);
  uploads.add(new Table(), frameOf(10_000));
  while (pauses.length) pauses.shift()!();
  expect(loads.length).toBeGreaterThan(2);
  expect(loads.every(({ total }) => total === 10_000)).toBe(true);
  for (let k = 1; k < loads.length; k++) expect(loads[k].written).toBeGreaterThan(loads[k - 1].written);
  expect(uploads.load).toEqual({ written: 0, total: 0 });
});
