/** What the state says, in one word. */

import { computed } from "@preact/signals";

import { storageProblem } from "./storage";
import { drawn, opening, pendingStrokes, saving, state, status, swapped, working } from "./store";

/** A load of so many Gaussians takes long enough to be shown. */
export const LOADING_GAUSSIANS = 50_000;

export type Activity = "Waiting" | "Saving" | "Working" | "Loading" | "Drawing" | "Saved";

/** What is under way, the most important first: what could be lost, what was asked for, what is not seen yet. */
export const activity = computed<Activity>(() => {
  const { behind, total, version } = drawn.value;
  if (pendingStrokes.value > 0 && (swapped.value || storageProblem.value)) return "Waiting"; // for the user's answer
  if (pendingStrokes.value > 0 || saving.value > 0) return "Saving";
  if (working.value > 0) return "Working";
  if (state.value === null || opening.value > 0 || total >= LOADING_GAUSSIANS) return "Loading";
  return behind || version !== state.value.version ? "Drawing" : "Saved";
});

/** What is open: until the server has told of it, it is on its way; a page that was stopped before that has nothing. */
export const openAsset = computed<string>(() => {
  if (state.value) return `${state.value.asset.gaussians.toLocaleString()} Gaussians`;
  return status.value === "stopped" ? "Nothing open" : "Opening the asset";
});
