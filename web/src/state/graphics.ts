/** The graphics card can take the view away at any time: what is said then, and the reload that gets it back. */

import { graphicsLost, working } from "./store";

/** Browsers give a page that lost its context at once another one that is lost again; after so long they give a new one. */
export const RELOAD_MS = 2000;
/** A second loss within so long after such a reload: reloading does not help, and is left to the user. */
export const AGAIN_MS = 20_000;
const KEY = "splatpainter.graphics-lost";

/** Show the card, and reload after two seconds, unless that was just done; a film or a file that is being made is waited
 * for, as its download would be lost. */
export function watchGraphics(
  canvas: EventTarget,
  page: { storage: Pick<Storage, "getItem" | "setItem">; reload: () => void; now: () => number } = {
    storage: sessionStorage,
    reload: () => location.reload(),
    now: () => Date.now(),
  },
): void {
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault(); // else it never comes back
    if (graphicsLost.value) return;
    const before = Number(page.storage.getItem(KEY) ?? -Infinity);
    const again = page.now() - before < AGAIN_MS + RELOAD_MS;
    page.storage.setItem(KEY, String(page.now()));
    graphicsLost.value = { again };
    if (!again) setTimeout(reloadOnceDone, RELOAD_MS);
  });

  function reloadOnceDone(): void {
    if (working.value === 0) return page.reload();
    const stop = working.subscribe((count) => {
      if (count > 0) return;
      queueMicrotask(() => stop());
      setTimeout(reloadOnceDone, RELOAD_MS); // its download begins after it is done
    });
  }
}
