/** Messages of the studio: toasts, progress, the status line, the sheet of shortcuts. */

import {
  dismiss,
  drawn,
  graphicsLost,
  jobs,
  pythonLog,
  refusal,
  silent,
  state,
  status,
  stopped,
  toast,
  toasts,
  working,
} from "../state/store";
import { BatchChip } from "./batch";
import { LOADING_GAUSSIANS, openAsset } from "../state/activity";
import { aside } from "../state/side-view";
import { Button } from "./parts";

/** What went wrong before what to do about it: one sentence, if it is none by itself. */
const before = (hint: string, message: string): string => (hint && !/[.!?:;]$/.test(message) ? `${message};` : message);

export function Toasts() {
  return (
    <div class="toasts" aria-live="polite">
      {toasts.value.map((one) => (
        <div key={one.id} class={`toast ${one.level}`} role={one.level === "error" ? "alert" : "status"}>
          <p>
            {before(one.hint, one.message)}
            {one.hint && <span class="quiet"> {one.hint}</span>}
          </p>
          <Button icon="close" label="Dismiss" onClick={() => dismiss(one.id)} />
        </div>
      ))}
    </div>
  );
}

export function Jobs() {
  return (
    <div class="jobs" aria-live="polite">
      {jobs.value.map((job) => (
        <div key={job.id} class="job">
          <span>
            {job.label}
            {job.stage && <span class="quiet"> {job.stage}</span>}
          </span>
          <progress max={1} value={job.progress > 0 ? job.progress : undefined} aria-label={job.label} />
          <Button label={`Cancel: ${job.label}`} text="Cancel" onClick={job.cancel} />
        </div>
      ))}
    </div>
  );
}

/** While the asset is on its way to the screen. */
export function Loading() {
  const { written, total } = drawn.value;
  const waits = state.value === null && status.value !== "stopped";
  if (!waits && total < LOADING_GAUSSIANS) return null;
  const words = waits ? "Opening" : `Loading ${total.toLocaleString()} Gaussians`;
  return (
    <div class="loading" role="status">
      <span>
        {words}
        <progress max={1} value={waits ? undefined : written / total} aria-label={words} />
      </span>
    </div>
  );
}

const decibels = (value: number): string => (value >= 99 ? "identical" : `${value.toFixed(1)} dB`);

export async function copy(line: string): Promise<void> {
  try {
    await navigator.clipboard.writeText(line);
    toast("info", "Copied");
  } catch {
    toast("warning", "The browser did not allow copying.", "Select the line and copy it by hand.");
  }
}

export function StatusLine() {
  const now = state.value;
  const edit = now?.latest_edit;
  const refused = refusal.value;
  const seen = aside.value?.layer === edit?.layer && aside.value?.version === now?.version ? aside.value : null;
  const line = pythonLog.value.at(-1);
  return (
    <footer class="status">
      <span>{openAsset.value}</span>
      <BatchChip />
      {edit && (
        <span
          class="last-edit"
          title="The last edit: its time, how well the view matches the picture inside the mask, and what changed outside"
        >
          <b>{edit.name}</b> {edit.seconds.toFixed(2)} s
          {edit.psnr_after !== null &&
            `, inside ${edit.psnr_before !== null ? `${decibels(edit.psnr_before)} → ` : ""}${decibels(edit.psnr_after)}`}
          {edit.psnr_outside !== null && `, outside ${decibels(edit.psnr_outside)}`}, {edit.gaussians.toLocaleString()}{" "}
          Gaussians
          {seen && seen.psnr !== null && (
            <span
              class={seen.low ? "aside low" : "aside"}
              title={
                seen.low
                  ? "Seen 35° from the side the paint differs from the picture: look at it from other views"
                  : "How well the paint matches the picture, seen 35° from the side"
              }
            >
              , aside {decibels(seen.psnr)}
              {seen.low && " – look from the side"}
            </span>
          )}
        </span>
      )}
      {refused && (
        <span class="refusal" role="status" title={`${before(refused.hint, refused.message)} ${refused.hint}`}>
          <b>Not done{refused.what && `: ${refused.what}`}</b> {before(refused.hint, refused.message)} {refused.hint}
          <Button icon="close" label="Close this message" onClick={() => (refusal.value = null)} />
        </span>
      )}
      <span class="gap" />
      {line && (
        <span class="python">
          <code title={line}>{line}</code>
          <Button icon="copy" label="Copy the Python line" onClick={() => void copy(line)} />
        </span>
      )}
    </footer>
  );
}

/** Over everything while the server or the view is away. */
export function Away() {
  if (graphicsLost.value)
    return (
      <div class="away" role="alert">
        <p>
          The graphics card took the view away. Every stroke that was finished is saved.
          <br />
          {graphicsLost.value.again
            ? "This has happened twice: close what else uses the graphics card, or choose fewer pixels, then reload."
            : working.value > 0
              ? "The page reloads when the file that is being made is finished."
              : "The page reloads in two seconds."}
        </p>
        <Button label="Reload the page" text="Reload" primary onClick={() => location.reload()} />
      </div>
    );
  if (status.value === "stopped")
    return (
      <div class="away" role="alert">
        <p>{stopped.value || "The studio has stopped."}</p>
        <Button label="Reload the page" text="Reload" primary onClick={() => location.reload()} />
      </div>
    );
  if (status.value === "open" && silent.value)
    return (
      <div class="away-note" role="status">
        No answer for 20 seconds. Still waiting; what you paint stays on the screen.
      </div>
    );
  if (status.value === "open" || (status.value === "connecting" && !state.value)) return null;
  return (
    <div class="away-note" role="status">
      Connection lost. What was saved is safe, what you paint now is kept; trying again.
    </div>
  );
}
