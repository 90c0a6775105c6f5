/** The bar at the top: project, undo, view settings, connection. */

import { signal } from "@preact/signals";

import { batchOpen } from "../state/batch";
import { activity } from "../state/activity";
import {
  canRedo,
  canUndo,
  help,
  panelsFolded,
  pendingStrokes,
  pose,
  readOnly,
  state,
  status,
  view,
} from "../state/store";
import { go } from "../editor/camera-moves";
import { selectionSent } from "../paint/selected";
import { editor, run } from "../editor/editor";
import { drafts } from "../state/draft-steps";
import { setUp, shownUp } from "../state/shown-up";
import { OPPOSITE } from "../state/up-axis";
import { frame, zoomLens, type Vec3 } from "../view/camera";
import { penInput } from "../tools/pen-input";
import { OverflowBar } from "./overflow-bar";
import { CommandButton } from "./command-button";
import { Button, Choice, Dialog, Slider } from "./parts";

/** Whether it is asked if a project may be edited that a note says is open on another computer. */
const noteOpen = signal(false);
export const filesOpen = signal<"open" | "save" | null>(null);

const BACKGROUNDS: readonly (readonly [string, string])[] = [
  ["#1b1d21", "Dark"],
  ["#000000", "Black"],
  ["#808080", "Grey"],
  ["#c9c9c9", "Light"],
  ["#ffffff", "White"],
];
const RESOLUTIONS: readonly (readonly [string, string])[] = [
  ["0.5", "Half"],
  ["1", "Screen"],
  ["2", "Double"],
];

const PROFILES: readonly (readonly [string, string])[] = [
  ["inria", "3DGS"],
  ["playcanvas", "PlayCanvas"],
];

const stepAt = (at: number): string => state.value?.history[state.value.cursor + at]?.label ?? "";
/** What the pen is at first, then what is not applied yet, then a stroke that is not being saved yet, then the newest step. */
export async function undo(): Promise<void> {
  if (penInput.takeBack()) return;
  const draft = drafts.find((one) => one.canBack());
  if (draft) return draft.back();
  if (editor.strokes.takeBackNewest()) return;
  await editor.strokes.committedAll; // one that is being saved is the newest step then
  await selectionSent(); // and so is a lasso that was just drawn
  await run("undo", {}, `Undo: ${state.value?.selection.undo ? "selection" : stepAt(0)}`);
}
export function redo(): void {
  const draft = drafts.find((one) => one.canAgain());
  if (draft) return draft.again();
  void run("redo", {}, `Redo: ${state.value?.selection.redo ? "selection" : stepAt(1)}`);
}

/** The whole asset in the window, seen from the same side. */
export function frameAll(): void {
  const asset = state.value?.asset;
  const now = pose.value;
  const stage = document.getElementById("stage");
  if (asset && now && stage) go(frame(now, asset.center as Vec3, asset.radius, stage.clientWidth / stage.clientHeight));
}

/** What is up becomes down. */
export function turnOver(): void {
  const up = shownUp.value;
  if (up) void setUp(OPPOSITE[up], "Turn over");
}

export function Header() {
  const now = state.value;
  const options = view.value;
  const set = (part: Partial<typeof options>) => (view.value = { ...view.value, ...part });
  return (
    <header class="header">
      <span class="brand" aria-hidden="true">
        <img src="/favicon.svg" width="20" height="20" alt="" />
      </span>
      <CommandButton
        icon="open"
        label="Open an asset or a project"
        command="file.open"
        text="Open"
        onClick={() => (filesOpen.value = "open")}
      />
      <CommandButton
        icon="share"
        label="Save and export"
        command="file.save"
        text="Save, export"
        disabled={!now}
        onClick={() => (filesOpen.value = "save")}
      />
      <CommandButton
        icon="batch"
        label="Batch: these layers on other assets, or variants of this one"
        command="file.batch"
        text="Batch..."
        disabled={!now}
        onClick={() => (batchOpen.value = true)}
      />
      <span class="title" title={now ? [...now.asset.doubts, ...now.asset.problems].join("\n") : undefined}>
        {now ? (now.project.file ?? now.asset.name) : ""}
      </span>
      {readOnly.value && (
        <em class="tag" title={now?.project.read_only_reason}>
          read only
        </em>
      )}
      {now?.project.is_free && (
        <button
          type="button"
          class="button primary"
          title="Nobody else has this project open any more: go on in it here, with the newest that was done in it"
          onClick={() => void run("project.take_over", {}, "Edit here")}
        >
          Edit here
        </button>
      )}
      {now?.project.noted_computer && (
        <button
          type="button"
          class="button"
          title={now.project.read_only_reason}
          onClick={() => (noteOpen.value = true)}
        >
          Edit here...
        </button>
      )}
      {noteOpen.value && now?.project.noted_computer && <NoteDialog computer={now.project.noted_computer} />}
      <CommandButton
        icon="undo"
        command="edit.undo"
        disabled={!canUndo.value && pendingStrokes.value === 0 && !drafts.some((one) => one.canBack())}
        onClick={() => void undo()}
      />
      <CommandButton
        icon="redo"
        command="edit.redo"
        disabled={!canRedo.value && !drafts.some((one) => one.canAgain())}
        onClick={redo}
      />
      <OverflowBar class="view-settings" label="View settings" more="More settings of the view" of="view">
        <Slider
          label="Lens"
          value={pose.value?.fov ?? 40}
          min={8}
          max={100}
          step={1}
          unit="°"
          onInput={(fov) => pose.value && go(zoomLens(pose.value, fov))}
        />
        <Choice
          label="Background"
          value={options.background}
          options={BACKGROUNDS}
          onChange={(background) => set({ background })}
        />
        <Choice
          label="Pixels"
          value={String(options.resolution)}
          options={RESOLUTIONS}
          onChange={(value) => set({ resolution: Number(value) })}
        />
        <CommandButton icon="frame" command="view.all" onClick={frameAll} />
        <Button
          icon="turn"
          label="Upside down? Turn the asset over on the screen (saved in the project; the asset does not change)"
          disabled={!now || readOnly.value}
          onClick={turnOver}
        />
        <CommandButton
          icon="grid"
          command="view.grid"
          pressed={options.grid}
          onClick={() => set({ grid: !options.grid })}
        />
        <CommandButton
          icon="lens"
          command="view.truecolor"
          pressed={options.trueColor}
          onClick={() => set({ trueColor: !options.trueColor })}
        />
        {options.trueColor && (
          <Choice
            label="Rendered like"
            value={options.profile}
            options={PROFILES}
            onChange={(profile) => set({ profile: profile as typeof options.profile })}
          />
        )}
        <CommandButton
          icon="compare"
          command="view.compare"
          pressed={options.compare}
          onClick={() => set({ compare: !options.compare })}
        />
        <CommandButton
          icon="coverage"
          command="view.coverage"
          pressed={options.coverage}
          onClick={() => set({ coverage: !options.coverage })}
        />
        <CommandButton icon="help" command="help" onClick={() => (help.value = true)} />
      </OverflowBar>
      <Connection />
      <Button
        icon="panels"
        label={panelsFolded.value ? "Show the panels" : "Fold the panels away"}
        pressed={!panelsFolded.value}
        onClick={() => (panelsFolded.value = !panelsFolded.value)}
      />
    </header>
  );
}

function Connection() {
  const words = {
    connecting: "Connecting",
    open: "Connected",
    lost: "Connection lost, trying again",
    stopped: "Stopped",
  }[status.value];
  const now = activity.value;
  const otherWindows = (state.value?.clients ?? 1) - 1;
  return (
    <span
      class={`connection ${status.value}${now === "Saved" ? "" : " busy"}`}
      role="status"
      title={otherWindows > 0 ? `${words}; ${otherWindows} more window${otherWindows > 1 ? "s" : ""}` : words}
    >
      <i aria-hidden="true" />
      <span class="quiet">{status.value === "open" ? now : words}</span>
    </span>
  );
}

/** Only its user knows whether a project is open on a computer that left a note beside it. */
function NoteDialog({ computer }: { computer: string }) {
  const close = () => (noteOpen.value = false);
  const takeOver = () => {
    close();
    void run("project.take_over", { despite_note: true }, "Edit here");
  };
  return (
    <Dialog title="Edit here" onClose={close}>
      <p>
        A note beside this project says that it is open on {computer}, or was not closed there. If it is open there,
        close it there: what two computers do in one file at once would be lost.
      </p>
      <p class="row">
        <Button label="It stays read only here" text="Cancel" onClick={close} />
        <Button
          label={`It is not open on ${computer}: edit it here`}
          text="It is not open there"
          primary
          onClick={takeOver}
        />
      </p>
    </Dialog>
  );
}
