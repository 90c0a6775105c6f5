/** What a new state of the server changes on the page: another project, another asset, a layer that is gone. */

import { batch } from "@preact/signals";

import type { AssetInfo, State, StateEvent } from "../messages";
import type { Link } from "../net/connection";
import { opening, pose, selectedLayer, state, swapped, toast, type LeftProject } from "../state/store";
import { axisName } from "../state/up-axis";
import { leftNow, noteChange, noteLeft, nothingDone, projectOf, waitingElsewhere } from "../state/waiting";
import type { Vec3 } from "../view/camera";
import type { Viewer } from "../view/viewer";
import { go, homePose } from "./camera-moves";

type Shown = { viewer: Viewer; link: Link };

/** The whole state from an event that says only what of the long lists is new. */
export function withHistory({ state: present, history, bookmarks }: StateEvent): State {
  const before = state.value!; // the greeting came first
  const { dropped = 0, kept = before.history.length, steps = [] } = history ?? {};
  return {
    ...present,
    history: [...before.history.slice(dropped, dropped + kept), ...steps],
    bookmarks: bookmarks ?? before.bookmarks,
  };
}

/** What waits for a project that was left must be asked about, whoever opened the other one. */
export function askAboutWaiting(): void {
  const project = waitingElsewhere.value;
  if (project !== null && swapped.value === null) swapped.value = projectOf(project);
}

export function adoptState(editor: Shown, next: State): void {
  const before = state.value;
  const another = before !== null && before.session !== next.session;
  const left = another ? leftNow(before) : null;
  if (left) noteLeft(left, next);
  if (!another && before && before.version !== next.version) noteChange();
  editor.link.enter(next.session); // first: what the new state sets off is meant for it
  // with the question, or what is in hand of the project that was left would be taken for this one's
  batch(() => {
    state.value = next; // what waits for this project goes on
    if (left) askAboutLeft(left, next);
  });
  chooseLayer(before, next);
  const { asset } = next;
  if (before?.session === next.session) {
    if (axisName(before.asset.up) !== axisName(asset.up)) resetView(editor, asset);
    return;
  }
  showAsset(editor, before, next);
}

/** Another project is shown: whether the user is to be asked about the one that was left. */
function askAboutLeft(left: LeftProject, { project }: State): void {
  const same = left.id !== "" && left.id === project.id;
  const expected = opening.value > 0 || (swapped.value !== null && swapped.value.id === project.id);
  swapped.value = same || expected || nothingDone(left) ? null : left;
}

/** Where the chosen layer was undone, deleted or merged: go on with what lies there now. */
function chooseLayer(before: State | null, next: State): void {
  const chosen = selectedLayer.value;
  if (chosen !== null && !next.layers.some((one) => one.id === chosen)) {
    const at = before?.session === next.session ? before.layers.findIndex((one) => one.id === chosen) : Infinity;
    selectedLayer.value = next.layers[Math.min(at, next.layers.length - 1)]?.id ?? null;
  } else if (before?.session !== next.session) selectedLayer.value = next.layers.at(-1)?.id ?? null;
}

/** The asset of another project, and what is to be known of it. */
function showAsset(editor: Shown, before: State | null, { asset }: State): void {
  // the same asset again, as after a crash of the server: nobody moved, so the view stays
  const stays = before?.asset.sha256 === asset.sha256 && axisName(before.asset.up) === axisName(asset.up) && pose.value;
  editor.viewer.extent = asset.radius;
  editor.viewer.setAntialiased(asset.antialiased);
  document.title = `${asset.name} – SplatPainter`;
  if (!stays) resetView(editor, asset);
  for (const doubt of asset.doubts) toast("warning", `${asset.name}: ${doubt}`);
  if (!asset.axes_stated)
    toast(
      "info",
      `${asset.name} does not say which way is up: opened as ${asset.axes.split(",")[0]}.`,
      "Upside down? The arrows at the top turn it over; the project remembers it.",
    );
}

/** The grid under the asset and the eye before it, with its up direction up. */
function resetView({ viewer }: Shown, asset: AssetInfo): void {
  viewer.grid.setGround(asset.center as Vec3, asset.radius, asset.up as Vec3);
  go(homePose(asset));
}
