import { expect, it } from "vitest";

import { parseFrame, type Frame } from "../src/net/frames";
import { Intake, type Target } from "../src/splats/intake";
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

/** An intake whose clock advances by `each` milliseconds whenever it is read, and whose pauses end when told. */
function setUp(each: number) {
  let time = 0;
  const order: Frame[] = [];
  const pauses: (() => void)[] = [];
  const intake = new Intake<Table>(
    (_, frame) => order.push(frame),
    (go) => pauses.push(go),
    () => (time += each),
  );
  return { intake, order, pauses };
}

it("finishes small frames at once", () => {
  const { intake, order, pauses } = setUp(0);
  const table = new Table();
  const frame = frameOf(3000);
  intake.add(table, frame);
  expect(table.rows).toEqual(Array.from({ length: 3000 }, (_, k) => k));
  expect([table.shown, order, pauses]).toEqual([3000, [frame], []]);
});

it("pauses in large ones, shows them whole, and keeps the order", async () => {
  const { intake, order, pauses } = setUp(5);
  const table = new Table();
  const [large, small] = [frameOf(10_000), frameOf(10)];
  intake.add(table, large);
  intake.add(table, small);
  let idle = false;
  const waiting = intake.idle().then(() => (idle = true));
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
  const { intake, order, pauses } = setUp(5);
  const [old, next] = [new Table(), new Table()];
  intake.add(old, frameOf(10_000));
  expect(intake.drop()).toEqual([old]);
  const frame = frameOf(5);
  intake.add(next, frame);
  while (pauses.length) pauses.shift()!();
  expect([old.shown, next.shown, order]).toEqual([0, 5, [frame]]);
});
