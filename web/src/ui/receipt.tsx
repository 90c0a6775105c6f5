/** What changed and what did not, with the proof. */

import { signal } from "@preact/signals";

import type { Verified } from "../messages";
import { download } from "../net/blobs";
import { state } from "../state/store";
import { run } from "../editor/editor";
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
  const changed = asset.gaussians_original - asset.gaussians_unchanged;
  const verified =
    proof.value && proof.value.session === now.session && proof.value.version === now.version
      ? proof.value.answer
      : null;
  return (
    <div class="receipt">
      <p class="figure">
        <b>{asset.gaussians_unchanged.toLocaleString()}</b> of {asset.gaussians_original.toLocaleString()} Gaussians
        byte-identical
      </p>
      <div class="bar" role="img" aria-label={`${changed} Gaussians changed`}>
        <i style={{ width: `${(100 * asset.gaussians_unchanged) / Math.max(1, asset.gaussians_original)}%` }} />
      </div>
      <dl>
        <dt>Changed</dt>
        <dd>{changed.toLocaleString()}</dd>
        <dt>Added</dt>
        <dd>{(asset.gaussians - asset.gaussians_original).toLocaleString()}</dd>
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
          label="Write the asset, read it back and compare every Gaussian with the original"
          icon="check"
          text="Verify"
          onClick={() => void verify()}
        />
        <Button label="Save the receipt as JSON" icon="save" text="Receipt" onClick={() => void save()} />
      </p>
      {verified && (
        <div class={`proof ${verified.proved ? "good" : "bad"}`} role="status">
          <b>{verified.proved ? "Proved" : "Not proved"}</b>
          <p>
            {verified.same.toLocaleString()} of {verified.gaussians.toLocaleString()} Gaussians are the same,{" "}
            {verified.changed.toLocaleString()} changed, {verified.appended.toLocaleString()} added.
          </p>
          <p class="quiet">{verified.exact}</p>
          {verified.changed > changed && (
            <p>
              Writing {asset.format} changed {(verified.changed - changed).toLocaleString()} Gaussians that no layer
              changed: its palette moves with new colours. Export a .ply to keep them.
            </p>
          )}
          {verified.problems.map((line) => (
            <p key={line}>{line}</p>
          ))}
        </div>
      )}
      {asset.doubts.length + asset.problems.length > 0 && (
        <>
          <h3>The file</h3>
          <ul class="problems">
            {[...asset.doubts, ...asset.problems].map((line) => (
              <li key={line}>{line}</li>
            ))}
          </ul>
        </>
      )}
    </div>
  );
}
