/** How the latest edit looks from the side, asked for when nothing else is going on. */

import { effect, signal } from "@preact/signals";

import { jobs, state, working } from "./store";
import { editor } from "../editor/editor";

/** Of one layer and version; psnr: dB, null: nothing to compare. */
export const aside = signal<{ layer: string; version: number; psnr: number | null; low: boolean } | null>(null);
const IDLE_MS = 1500;

export function followAside(): void {
  let timer: ReturnType<typeof setTimeout>;
  effect(() => {
    const now = state.value;
    const layer = now?.latest_edit?.layer;
    const busy = working.value > 0 || jobs.value.length > 0;
    clearTimeout(timer);
    if (!now || !layer || busy || now.project.read_only) return;
    const { version } = now;
    if (aside.peek()?.layer === layer && aside.peek()?.version === version) return;
    timer = setTimeout(() => {
      editor.link.do("aside", { layer }).then(
        ({ psnr, low }) => (aside.value = { layer, version, psnr, low }),
        () => {}, // the layer is gone, or the connection: there is nothing to say of it
      );
    }, IDLE_MS);
  });
}
