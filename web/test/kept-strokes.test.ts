import { describe, expect, it } from "vitest";

import { KeptStrokes, type KeptStroke, type Locks, type Shelf } from "../src/paint/kept-strokes";

/** A browser's database that all its pages share. */
function sharedShelf(): Shelf & { records: Map<string, KeptStroke> } {
  const records = new Map<string, KeptStroke>();
  return {
    records,
    put: async (one) => void records.set(one.id, one),
    delete: async (id) => void records.delete(id),
    all: async () => [...records.values()],
    take: async (from, to) => {
      const strokes = [...records.values()].filter(({ page }) => page === from).map((one) => ({ ...one, page: to }));
      for (const one of strokes) records.set(one.id, one);
      return strokes;
    },
  };
}

/** Locks of several pages; `end` lets go of what a page holds. */
function sharedLocks() {
  const held = new Map<string, Promise<unknown>>();
  const ends = new Map<string, () => void>();
  const request = (async (name: string, work: () => Promise<unknown>) => {
    const before = held.get(name) ?? Promise.resolve();
    const gone = new Promise<void>((resolve) => ends.has(name) || ends.set(name, resolve));
    const done = before.then(() => Promise.race([work(), gone]));
    held.set(name, done);
    return done;
  }) as LockManager["request"];
  return { locks: { request } as Locks, end: (page: string) => ends.get(`splatpainter page ${page}`)!() };
}

const stroke = (id: string, drawn: number) => ({ id, drawn, name: "Brush" }) as unknown as Omit<KeptStroke, "page">;
const settled = () => new Promise((resolve) => setTimeout(resolve));

describe("strokes that are kept", () => {
  it("are taken over when the page that drew them is gone, in drawing order, by one page", async () => {
    const [shelf, { locks, end }] = [sharedShelf(), sharedLocks()];
    const first = new KeptStrokes(shelf, locks, "first");
    await first.keep(stroke("b", 2));
    await first.keep(stroke("a", 1));
    const got: Record<string, string[]> = { second: [], third: [] };
    for (const page of ["second", "third"])
      await new KeptStrokes(shelf, locks, page).takeOver((all) => got[page].push(...all.map(({ id }) => id)));
    await settled();
    expect(got).toEqual({ second: [], third: [] }); // the first page still waits for its project itself
    end("first");
    await settled();
    expect(got).toEqual({ second: ["a", "b"], third: [] });
    expect(shelf.records.get("a")?.page).toBe("second");
  });

  it("come back to their tab where the browser has no locks", async () => {
    const shelf = sharedShelf();
    await new KeptStrokes(shelf, null, "tab").keep(stroke("a", 1));
    await new KeptStrokes(shelf, null, "other").keep(stroke("b", 1));
    const got: string[] = [];
    await new KeptStrokes(shelf, null, "tab").takeOver((all) => got.push(...all.map(({ id }) => id)));
    expect(got).toEqual(["a"]);
  });

  it("live as long as the page where the browser keeps nothing", async () => {
    const full: Shelf = { ...sharedShelf(), put: () => Promise.reject(new Error("no room")) };
    expect(await new KeptStrokes(full, null, "tab").keep(stroke("a", 1))).toBe(false);
  });
});
