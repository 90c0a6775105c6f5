import { afterAll, beforeEach, describe, expect, it, vi } from "vitest";

import { AGAIN_MS, RELOAD_MS, watchGraphics } from "../src/state/graphics";
import { graphicsLost, working } from "../src/state/store";

let stored: Record<string, string>;
let now: number;

/** A page whose view is lost once. */
function lost(): { reloads: number; prevented: boolean } {
  graphicsLost.value = null;
  const seen = { reloads: 0, prevented: false };
  const canvas = new EventTarget();
  const storage = { getItem: (key: string) => stored[key] ?? null, setItem: (k: string, v: string) => (stored[k] = v) };
  watchGraphics(canvas, { storage, reload: () => void seen.reloads++, now: () => now });
  const event = new Event("webglcontextlost", { cancelable: true });
  canvas.dispatchEvent(event);
  seen.prevented = event.defaultPrevented;
  return seen;
}

afterAll(() => {
  vi.useRealTimers();
});

beforeEach(() => {
  vi.useFakeTimers();
  stored = {};
  now = 1e12;
});

describe("a lost view", () => {
  it("leaves a card, and the page reloads after two seconds", () => {
    const seen = lost();
    expect(seen.prevented).toBe(true);
    expect(graphicsLost.value).toEqual({ again: false });
    vi.advanceTimersByTime(RELOAD_MS - 1);
    expect(seen.reloads).toBe(0);
    vi.advanceTimersByTime(1);
    expect(seen.reloads).toBe(1);
    expect(graphicsLost.value).not.toBe(null);
  });

  it("while a film is made is reloaded once that is there", () => {
    working.value = 2;
    const seen = lost();
    vi.advanceTimersByTime(60_000);
    working.value = 1;
    vi.advanceTimersByTime(60_000);
    expect(seen.reloads).toBe(0);
    working.value = 0;
    vi.advanceTimersByTime(RELOAD_MS - 1);
    expect(seen.reloads).toBe(0); // its download begins
    vi.advanceTimersByTime(1);
    expect(seen.reloads).toBe(1);
    vi.advanceTimersByTime(60_000);
    expect(seen.reloads).toBe(1);
  });

  it("that comes back at once does not reload again and again", () => {
    lost();
    now += RELOAD_MS + 3000;
    const seen = lost();
    expect(graphicsLost.value).toEqual({ again: true });
    vi.advanceTimersByTime(10 * RELOAD_MS);
    expect(seen.reloads).toBe(0);
    now += AGAIN_MS + RELOAD_MS + 1;
    const later = lost();
    vi.advanceTimersByTime(RELOAD_MS);
    expect(later.reloads).toBe(1);
  });
});
