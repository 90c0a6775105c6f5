/** "Edit with a source…": the present view goes to a program or an image service, and comes back as a picture. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { SourceInfo } from "../messages";
import { sendBlob } from "../net/blobs";
import { maskPng } from "../paint/picture";
import { selection } from "../paint/selection";
import { addChecked } from "../state/dropped-images";
import { camera } from "../state/store";
import { report, run } from "../state/studio";
import { Button, Check, Choice, Dialog } from "./parts";

export const sourcesOpen = signal(false);
/** null: not answered yet. */
const sources = signal<SourceInfo[] | null>(null);
const chosenName = signal("");
const prompt = signal("");
const seed = signal("");
const onlySelected = signal(true);

export function SourceDialog({ onClose }: { onClose: () => void }) {
  useEffect(() => {
    void run("source.list", {}).then((answer) => {
      sources.value = answer?.sources ?? [];
      const usable = sources.value.filter((one) => !one.missing);
      if (!usable.some((one) => one.name === chosenName.value)) chosenName.value = usable[0]?.name ?? "";
    });
  }, []);
  const list = sources.value ?? [];
  const usable = list.filter((one) => !one.missing);
  const source = usable.find((one) => one.name === chosenName.value) ?? null;
  const number = /^\d{0,9}$/.test(seed.value.trim());
  const ready = source && number && !(source.needs_prompt && !prompt.value.trim());
  const send = () => {
    if (!source) return;
    onClose();
    void ask(source).catch(report);
  };
  return (
    <Dialog title="Edit with a source" onClose={onClose}>
      {sources.value === null && <p class="quiet">Looking for sources</p>}
      {usable.length > 0 && (
        <p class="row">
          <Choice
            label="Source"
            value={chosenName.value}
            options={usable.map((one) => [one.name, one.paid ? `${one.name} (paid)` : one.name] as const)}
            onChange={(name) => (chosenName.value = name)}
          />
        </p>
      )}
      {source && (
        <>
          <p class="quiet">{source.summary}</p>
          <p class="quiet">It takes {source.accepts}.</p>
          {source.prompt && (
            <p class="row wide">
              <input
                type="text"
                aria-label="Prompt"
                placeholder={source.needs_prompt ? "What shall become of the view" : "Prompt (optional)"}
                maxLength={4000}
                value={prompt.value}
                onInput={(event) => (prompt.value = event.currentTarget.value)}
                onKeyDown={(event) => event.key === "Enter" && ready && send()}
              />
            </p>
          )}
          {source.seed && (
            <p class="row">
              <input
                type="text"
                inputMode="numeric"
                class="pixels"
                aria-label="Seed"
                placeholder="Seed"
                aria-invalid={!number}
                value={seed.value}
                onInput={(event) => (seed.value = event.currentTarget.value)}
              />
            </p>
          )}
          {selection.value && (
            <Check
              label={source.mask ? "Only what is selected" : "Only what is selected (cut afterwards)"}
              value={onlySelected.value}
              onChange={(on) => (onlySelected.value = on)}
            />
          )}
        </>
      )}
      <p class="row">
        <Button label="Send the present view" text="Send this view" primary disabled={!ready} onClick={send} />
      </p>
      {list.length > usable.length && (
        <details>
          <summary>Sources that cannot be used yet</summary>
          {list
            .filter((one) => one.missing)
            .map((one) => (
              <p class="quiet" key={one.name}>
                <b>{one.name}</b>: {one.missing}
              </p>
            ))}
        </details>
      )}
    </Dialog>
  );
}

/** Progress and cancel are those of every job. */
async function ask(source: SourceInfo): Promise<void> {
  if (!camera.value) return;
  const limiting = onlySelected.value && selection.value;
  const view = camera.value;
  const mask = limiting ? await sendBlob(await maskPng(limiting), "mask.png") : null;
  const answer = await run(
    "source.edit",
    {
      source: source.name,
      camera: view,
      prompt: source.prompt ? prompt.value.trim() : "",
      mask,
      seed: source.seed && seed.value.trim() ? Number(seed.value) : null,
    },
    `Asking ${source.name}`,
  );
  if (answer) addChecked(answer.name, answer);
}
