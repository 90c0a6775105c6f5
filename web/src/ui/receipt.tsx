/** What changed and what did not, with the proof. */

import { signal } from "@preact/signals";

import type { Verified } from "../messages";
import { download } from "../net/blobs";
import { state } from "../state/store";
import { run } from "../state/studio";
import { Button } from "./parts";

const proof = signal<{ version: number; session: string; answer: Verified } | null>(null);

async function verify(): Promise<void> {
  const now = state.value!;
  const answer = await run("verify", {}, "Writing, reading back, comparing");
  if (answer) proof.value = { version: now.version, session: now.session, answer };
}

async function save(): Promise<void> {
  const answer = await run("receipt", {}, "Receipt");
  if (!answer) return;
  const url = URL.createObjectURL(new Blob([JSON.stringify(answer.receipt, null, 2)], { type: "application/json" }));
  download(url, "receipt.json");
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

export function ReceiptPanel() {
  const now = state.value;
  if (!now) return null;
  const { asset } = now;
  const changed = asset.rows_original - asset.rows_same;
  const found =
    proof.value && proof.value.session === now.session && proof.value.version === now.version
      ? proof.value.answer
      : null;
  return (
    <div class="receipt">
      <p class="figure">
        <b>{asset.rows_same.toLocaleString()}</b> of {asset.rows_original.toLocaleString()} rows byte-identical
      </p>
      <div class="bar" role="img" aria-label={`${changed} rows changed`}>
        <i style={{ width: `${(100 * asset.rows_same) / Math.max(1, asset.rows_original)}%` }} />
      </div>
      <dl>
        <dt>Changed</dt>
        <dd>{changed.toLocaleString()}</dd>
        <dt>Added</dt>
        <dd>{(asset.rows - asset.rows_original).toLocaleString()}</dd>
        <dt>Format</dt>
        <dd>
          {asset.format || "demo"}, SH degree {Math.sqrt(asset.sh_coefficients) - 1}
        </dd>
        <dt>Original</dt>
        <dd class="hash" title={asset.sha256}>
          {asset.sha256.slice(0, 16)}
        </dd>
      </dl>
      <p class="row">
        <Button
          label="Write the asset, read it back and compare every row with the original"
          icon="check"
          text="Verify"
          onClick={() => void verify()}
        />
        <Button label="Save the receipt as JSON" icon="save" text="Receipt" onClick={() => void save()} />
      </p>
      {found && (
        <div class={`proof ${found.proved ? "good" : "bad"}`} role="status">
          <b>{found.proved ? "Proved" : "Not proved"}</b>
          <p>
            {found.same.toLocaleString()} of {found.rows.toLocaleString()} rows are the same,{" "}
            {found.changed.toLocaleString()} changed, {found.appended.toLocaleString()} added.
          </p>
          <p class="quiet">{found.exact}</p>
          {found.changed > changed && (
            <p>
              Writing {asset.format} changed {(found.changed - changed).toLocaleString()} rows that no layer changed:
              its palette moves with new colours. Export a .ply to keep them.
            </p>
          )}
          {found.problems.map((line) => (
            <p key={line}>{line}</p>
          ))}
        </div>
      )}
      {asset.problems.length > 0 && (
        <>
          <h3>The file</h3>
          <ul class="problems">
            {asset.problems.map((line) => (
              <li key={line}>{line}</li>
            ))}
          </ul>
        </>
      )}
    </div>
  );
}
