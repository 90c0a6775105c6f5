/**
 * "Batch...": the visible layers on other assets, or variants of this one. Chosen, planned (nothing is made yet), at work
 * beside the painting, done. The batch is the server's: closing this window or the page changes nothing.
 */

import { signal } from "@preact/signals";

import type { BatchAnswer, BatchJobInfo } from "../messages";
import type { Fields } from "../net/connection";
import { CommandError } from "../net/connection";
import { download } from "../net/blobs";
import { applyBatch, atWork, batch, batchOpen, countOf, variantOf } from "../state/batch";
import { assets as sceneAssets, batchAsset, selectedAsset } from "../state/assets";
import { camera, state } from "../state/store";
import { editor } from "../editor/editor";
import { BatchAssets, chosenAssets } from "./batch-assets";
import { BatchVariants, rows } from "./batch-variants";
import { sizeOf } from "./export-asset";
import { Button, Choice, Dialog } from "./parts";

type What = "assets" | "variants";
type Format = NonNullable<Fields<"batch.plan">["format"]>;

const FORMATS: readonly (readonly [Format, string])[] = [
  ["", "As the asset"],
  ["ply", "PLY"],
  ["compressed.ply", "Compressed PLY"],
  ["splat", "splat"],
  ["spz", "SPZ"],
  ["sog", "SOG"],
  ["glb", "glTF"],
];
const STATES: Record<BatchJobInfo["state"], string> = {
  queued: "Waiting",
  running: "Running",
  done: "Done",
  failed: "Failed",
  cancelled: "Cancelled",
};

const what = signal<What>("assets");
const format = signal<Format>("");
const busy = signal("");
const problem = signal("");

const results = (count: number): string => `${count} result${count === 1 ? "" : "s"}`;

/** What the server answers goes into `batch`; what it refuses is said in the window, which covers all else. */
async function ask(words: string, work: () => Promise<BatchAnswer | void>): Promise<void> {
  busy.value = words;
  problem.value = "";
  try {
    const answer = await work();
    if (answer) applyBatch(answer);
  } catch (error) {
    const hint = error instanceof CommandError ? error.hint : "";
    problem.value = `${(error as Error).message} ${hint}`.trim();
  } finally {
    busy.value = "";
  }
}

const plan = () =>
  ask("Planning", async () => {
    const scope = what.value === "assets" ? { assets: chosenAssets() } : { variants: rows.value.map(variantOf) };
    const asset = batchAsset.value?.id;
    return editor.link.do("batch.plan", { ...scope, asset, format: format.value, camera: camera.value });
  });
const start = (id: string) => ask("Starting", () => editor.link.do("batch.start", { batch: id }));
const cancel = (id: string) => ask("Cancelling", () => editor.link.do("batch.cancel", { batch: id }));
const discard = (id: string) =>
  ask("Removing", async () => {
    await editor.link.do("batch.discard", { batch: id });
    batch.value = null;
  });

export function BatchDialog() {
  if (!batchOpen.value) return null;
  const close = () => {
    batchOpen.value = false;
    problem.value = "";
  };
  return (
    <Dialog title="Batch" onClose={close}>
      <div class="batch">
        {batch.value ? <Jobs /> : <Setup />}
        {problem.value && (
          <p class="problem" role="alert">
            {problem.value}
          </p>
        )}
        {busy.value && (
          <p class="quiet" role="status">
            {busy.value} ...
          </p>
        )}
      </div>
    </Dialog>
  );
}

function Setup() {
  const present = batchAsset.value;
  const layers = state.value?.layers.filter((one) => one.visible && (!present || one.asset === present.id)) ?? [];
  const kinds: readonly (readonly [What, string])[] = [
    ["assets", "These layers on other assets"],
    ["variants", "Variants of this asset"],
  ];
  const assets = what.value === "assets";
  const count = assets ? chosenAssets().length : rows.value.length;
  return (
    <>
      <div class="row" role="radiogroup" aria-label="What to make">
        {kinds.map(([key, name]) => (
          <label key={key} class="check">
            <input type="radio" name="batch" checked={what.value === key} onChange={() => (what.value = key)} />
            <span>{name}</span>
          </label>
        ))}
      </div>
      {present && (
        <p class="row">
          <Choice
            label="Asset"
            value={present.id}
            options={sceneAssets.value.map((one) => [one.id, one.name] as const)}
            onChange={(id) => (selectedAsset.value = id)}
          />
        </p>
      )}
      <p class="quiet">
        {assets
          ? layers.length
            ? `The visible layers (${layers.map((layer) => layer.name).join(", ")}) are painted again on each asset, from the same cameras. The assets must be placed as this one is.`
            : "No visible layer yet: paint something first, then put it onto other assets."
          : "One result for each row: this asset as it is now, with one more change."}
      </p>
      {assets ? <BatchAssets /> : <BatchVariants />}
      <p class="row">
        <Choice label="Files" value={format.value} options={FORMATS} onChange={(value) => (format.value = value)} />
      </p>
      <p class="row">
        <Button
          label="Show what will be made"
          text="Plan"
          primary
          disabled={busy.value !== "" || count === 0 || (assets && !layers.length)}
          onClick={() => void plan()}
        />
        <span class="quiet">{count ? `${results(count)}; nothing is made before you start the plan.` : ""}</span>
      </p>
    </>
  );
}

function Jobs() {
  const now = batch.value!;
  const { id } = now;
  const total = now.jobs.length;
  const ended = countOf(now, "done", "failed", "cancelled");
  const failed = countOf(now, "failed");
  const words = {
    planned: `${results(total)} will be made. Nothing was made yet.`,
    running: `${ended} of ${total} ended${failed ? `, ${failed} failed` : ""}. You can close this window and go on painting.`,
    cancelling: "Cancelling; what is done stays.",
    done: `${countOf(now, "done")} of ${total} done${failed ? `, ${failed} failed` : ""}.`,
    cancelled: `Cancelled; ${countOf(now, "done")} of ${total} done.`,
  }[now.state];
  return (
    <>
      <h3>{now.title}</h3>
      <p role="status">{words}</p>
      {atWork(now) && <progress max={total} value={ended} aria-label="Jobs that have ended" />}
      <div class="batch-list" tabIndex={0} role="region" aria-label="Results">
        <table>
          <thead>
            <tr>
              {now.state !== "planned" && <th scope="col">Before, after</th>}
              <th scope="col">Result</th>
              <th scope="col">What is done</th>
              {now.state !== "planned" && <th scope="col">State</th>}
              {now.state !== "planned" && <th scope="col">Files</th>}
            </tr>
          </thead>
          <tbody>
            {now.jobs.map((job) => (
              <Row key={job.number} job={job} planned={now.state === "planned"} />
            ))}
          </tbody>
        </table>
      </div>
      <p class="row">
        {now.state === "planned" && (
          <>
            <Button
              label={`Make ${results(total)}`}
              text={`Make ${results(total)}`}
              primary
              disabled={busy.value !== ""}
              onClick={() => void start(id)}
            />
            <Button label="Back" text="Back" disabled={busy.value !== ""} onClick={() => void discard(id)} />
          </>
        )}
        {atWork(now) && (
          <Button
            label="Cancel what is not done; what is done stays"
            text="Cancel"
            disabled={now.state === "cancelling"}
            onClick={() => void cancel(id)}
          />
        )}
        {now.zip_url && (
          <Button
            label={atWork(now) ? "Download what is done so far" : "Download everything that is done as one ZIP"}
            icon="share"
            text={atWork(now) ? "What is done (ZIP)" : "Download all (ZIP)"}
            primary={!atWork(now)}
            onClick={() => download(now.zip_url!, "batch.zip")}
          />
        )}
        {now.page_url && (
          <a class="button" href={now.page_url} target="_blank" rel="noreferrer">
            Summary page
          </a>
        )}
        {(now.state === "done" || now.state === "cancelled") && (
          <Button
            label="Another batch; these results are removed"
            text="New batch"
            disabled={busy.value !== ""}
            onClick={() => void discard(id)}
          />
        )}
      </p>
      {!atWork(now) && now.zip_url && (
        <p class="quiet">Results stay until there is a new batch, or the studio is closed: download what you need.</p>
      )}
    </>
  );
}

function Row({ job, planned }: { job: BatchJobInfo; planned: boolean }) {
  return (
    <tr class={job.state}>
      {!planned && (
        <td class="pictures-cell">
          {job.before_url && job.after_url && (
            <>
              <img src={job.before_url} alt={`${job.name} before`} loading="lazy" />
              <img src={job.after_url} alt={`${job.name} after`} loading="lazy" />
            </>
          )}
        </td>
      )}
      <td>
        <b>{job.name}</b>
        {job.bytes !== null && <span class="quiet"> {sizeOf(job.bytes)}</span>}
      </td>
      <td>{job.words}</td>
      {!planned && (
        <td>
          <span class="state">{STATES[job.state]}</span>
          {job.line && <span class={job.state === "failed" ? "problem" : "quiet"}> {job.line}</span>}
          {job.warnings.map((line) => (
            <span key={line} class="quiet">
              {" "}
              {line}
            </span>
          ))}
        </td>
      )}
      {!planned && (
        <td>
          {job.url && (
            <a href={job.url} download={job.name} aria-label={`Download ${job.name}`}>
              Download
            </a>
          )}{" "}
          {job.receipt_url && (
            <a
              href={job.receipt_url}
              download={`${job.name}.receipt.json`}
              aria-label={`Download the receipt of ${job.name}`}
            >
              Receipt
            </a>
          )}
        </td>
      )}
    </tr>
  );
}

/** In the status line: how far the batch is; opens its window. */
export function BatchChip() {
  const now = batch.value;
  if (!now || now.state === "planned") return null;
  const total = now.jobs.length;
  const failed = countOf(now, "failed");
  const words = atWork(now)
    ? `Batch: ${countOf(now, "done", "failed")} of ${total}`
    : `Batch: ${countOf(now, "done")} of ${total} done${failed ? `, ${failed} failed` : ""}`;
  return <Button label="Show the batch" text={words} onClick={() => (batchOpen.value = true)} />;
}
