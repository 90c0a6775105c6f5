import { expect, test } from "vitest";

import { NewestOnly } from "../src/state/newest-only";

test("one at a time, the newest next, those in between never", async () => {
  const done: number[] = [];
  const gates: (() => void)[] = [];
  const work = new NewestOnly<number>(async (item) => {
    await new Promise<void>((resolve) => gates.push(resolve));
    done.push(item);
  });
  const first = work.add(1);
  const later = [2, 3, 4].map((item) => work.add(item));
  expect(gates.length).toBe(1); // 1 is under way, the others wait
  gates[0]();
  while (gates.length < 2) await Promise.resolve();
  gates[1]();
  await Promise.all([first, ...later]);
  expect(done).toEqual([1, 4]);
  const skipped = work.add(5);
  void work.add(6);
  work.skip();
  gates[2]();
  await skipped;
  expect(done).toEqual([1, 4, 5]);
});

test("a failure ends what is under way, and not what comes after", async () => {
  const work = new NewestOnly<boolean>((fails) => (fails ? Promise.reject(new Error("no")) : Promise.resolve()));
  await expect(work.add(true)).rejects.toThrow("no");
  await work.add(false);
});
