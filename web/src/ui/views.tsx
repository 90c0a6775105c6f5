/** Views: conflicts between them, export for editing elsewhere, bookmarks, where to look next, turntable. */

import { signal } from "@preact/signals";

import type { BookmarkInfo, ConflictInfo } from "../messages";
import { camera, readOnly, state, toast, view } from "../state/store";
import { during, withUnderWay } from "../state/under-way";
import { go } from "../editor/camera-moves";
import { run } from "../editor/editor";
import { setUp, shownUp } from "../state/shown-up";
import { AXES } from "../state/up-axis";
import { fromCamera, type CameraJson, type Vec3 } from "../view/camera";
import { exportView, ViewExportDialog } from "./export";
import { turnOver } from "./header";
import { covered } from "./server-renders";
import { Button, Choice } from "./parts";
import { TurntableDialog } from "./turntable";

const POLICIES = [
  ["latest", "the upper one"],
  ["first", "the lower one"],
  ["blend", "a blend"],
] as const;
const naming = signal("");
const exporting = signal(false);
const filming = signal(false);

export const goTo = (to: unknown): void => {
  const center = (state.value?.asset.center ?? [0, 0, 0]) as Vec3;
  go(fromCamera(to as CameraJson, center));
};

async function nextView(): Promise<void> {
  if (!camera.value) return;
  const answer = await run("coverage", { camera: camera.value }, "Looking for the largest unseen area");
  if (!answer) return;
  covered.value = { seen: answer.seen, predicted: answer.predicted, next: answer.next_view as CameraJson | null };
  if (answer.next_view) goTo(answer.next_view);
  else toast("info", "Edited views show all that changed.");
}

export function Views() {
  const now = state.value;
  if (!now) return null;
  const seen = covered.value;
  return (
    <div class="views">
      {now.conflicts.length > 0 && (
        <>
          <h3>Conflicts</h3>
          {now.conflicts.map((one) => (
            <ConflictRow key={nameOf(one)} one={withUnderWay(nameOf(one), one)} />
          ))}
        </>
      )}
      <h3>Edit in another program</h3>
      <p class="row">
        <Button
          label="Download the view as a PNG with its camera"
          icon="camera"
          text="Download PNG"
          onClick={() => void exportView("download")}
        />
        {now.folder && (
          <Button
            label={`Save it to the folder ${now.folder}`}
            text="Save to folder"
            onClick={() => void exportView("folder")}
          />
        )}
        <Button
          label="Export the view with its size, background and passes chosen"
          text="More..."
          onClick={() => (exporting.value = true)}
        />
      </p>
      <p class="quiet">Edit it in any program, then drop it onto this window.</p>
      {exporting.value && <ViewExportDialog onClose={() => (exporting.value = false)} />}
      <h3>Bookmarks</h3>
      <AddBookmark />
      <ul class="list">
        {now.bookmarks.map((one) => (
          <BookmarkRow key={one.id} one={one} />
        ))}
      </ul>
      <h3>Which way is up</h3>
      <p class="row">
        <Button
          icon="turn"
          label="Turn the asset over on the screen"
          text="Turn over"
          disabled={readOnly.value}
          onClick={turnOver}
        />
        <Choice
          label="Up"
          value={shownUp.value ?? "-y"}
          options={AXES.map((axis) => [axis, axis] as const)}
          disabled={readOnly.value}
          onChange={(up) => void setUp(up, "Turn")}
        />
      </p>
      <p class="quiet">{now.asset.axes && `The file's axes: ${now.asset.axes}.`}</p>
      <h3>Coverage</h3>
      <p class="row">
        <Button
          label="Show the largest unseen area"
          icon="next"
          text="Largest unseen area"
          onClick={() => void nextView()}
        />
        <Button
          label="Green: seen by an edited view; red: predicted"
          icon="coverage"
          text="Overlay"
          pressed={view.value.coverage}
          onClick={() => (view.value = { ...view.value, coverage: !view.value.coverage })}
        />
      </p>
      {seen && (
        <p class="quiet">
          {seen.seen.toLocaleString()} Gaussians seen in edited views, {seen.predicted.toLocaleString()} predicted
        </p>
      )}
      {filming.value && <TurntableDialog onClose={() => (filming.value = false)} />}
      <h3>Turntable</h3>
      <p class="row">
        <Button
          label="One turn around the asset as an MP4 or an animated WebP"
          icon="film"
          text="Turntable..."
          onClick={() => (filming.value = true)}
        />
      </p>
    </div>
  );
}

function AddBookmark() {
  const add = () => {
    if (!camera.value) return;
    const name = naming.value.trim() || `View ${(state.value?.bookmarks.length ?? 0) + 1}`;
    naming.value = "";
    void run("bookmark.add", { name, camera: camera.value }).then((answer) => answer ?? (naming.value ||= name));
  };
  return (
    <p class="row">
      <input
        type="text"
        aria-label="Name of the bookmark"
        placeholder="Name of this view"
        value={naming.value}
        onInput={(event) => (naming.value = event.currentTarget.value)}
        onKeyDown={(event) => {
          event.stopPropagation();
          if (event.key === "Enter") (add(), event.currentTarget.blur());
        }}
      />
      <Button icon="plus" label="Bookmark this view" disabled={readOnly.value} onClick={add} />
    </p>
  );
}

function BookmarkRow({ one }: { one: BookmarkInfo }) {
  return (
    <li>
      <button type="button" onClick={() => goTo(one.camera)}>
        {one.name}
      </button>
      <Button
        icon="bin"
        label={`Delete ${one.name}`}
        disabled={readOnly.value}
        onClick={() => void run("bookmark.delete", { bookmark: one.id })}
      />
    </li>
  );
}

const nameOf = ({ lower, upper }: ConflictInfo): string => `conflict ${lower} ${upper}`;

function ConflictRow({ one }: { one: ConflictInfo }) {
  return (
    <div class="conflict">
      <p>
        <b>{one.upper_name}</b> overwrites {one.gaussians.toLocaleString()}{" "}
        {one.gaussians === 1 ? "Gaussian" : "Gaussians"} of <b>{one.lower_name}</b> (
        {one.share < 0.01 ? "under 1" : Math.round(one.share * 100)} %), painted from another view.
      </p>
      <Choice
        label="Show"
        value={one.policy}
        options={POLICIES}
        disabled={readOnly.value}
        onChange={(policy) =>
          void during(
            nameOf(one),
            (said: ConflictInfo) => ({ ...said, policy }),
            run("conflict.set", { lower: one.lower, upper: one.upper, policy }, "Conflict"),
          )
        }
      />
    </div>
  );
}
