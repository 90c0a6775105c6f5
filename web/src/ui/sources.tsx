/**
 * "Edit with a source...": views go to a program or an image service. The present view comes back as a picture; views all
 * around become layers, after their plan was shown with its number of calls.
 */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { CameraInfo, SourceInfo, SourcePlanned } from "../messages";
import { sendBlob } from "../net/blobs";
import { maskPng } from "../paint/picture";
import { selectedCount, selection } from "../paint/selected";
import { addChecked } from "../state/dropped-images";
import { camera, method, readOnly, selectedLayer, toast } from "../state/store";
import { editor, report, run } from "../editor/editor";
import { Button, Check, Choice, Dialog, Slider } from "./parts";

type What = "view" | "around" | "refine";

export const sourcesOpen = signal(false);
/** null: not answered yet. */
const sources = signal<SourceInfo[] | null>(null);
const chosenName = signal("");
const prompt = signal("");
const seed = signal("");
const onlySelected = signal(true);
const what = signal<What>("view");
const enlarge = signal<"2" | "4">("2");
const maxViews = signal(8);
const fromHere = signal(true);
const oneLayer = signal(false);
/** null: not planned (yet). */
const plan = signal<SourcePlanned | null>(null);

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
  const enlarges = source?.scales.some((scale) => scale > 1) ?? false;
  const chosen: What = what.value === "refine" && !enlarges ? "view" : what.value;
  const number = /^\d{0,9}$/.test(seed.value.trim());
  const planned = chosen !== "around" || (plan.value?.views.length ?? 0) > 0;
  const ready = source && number && planned && !(source.needs_prompt && !prompt.value.trim());
  const send = () => {
    if (!source) return;
    onClose();
    void (chosen === "around" ? cover(source) : ask(source, chosen === "refine")).catch(report);
  };
  const kinds: (readonly [What, string])[] = [
    ["view", "This view"],
    ["around", "Views all around"],
  ];
  if (enlarges) kinds.push(["refine", "This view, sharpened"]);
  const count = plan.value?.views.length ?? 0;
  const verb = { view: "Send this view", around: `Send ${count} view${count === 1 ? "" : "s"}`, refine: "Sharpen" };
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
          <Choice label="Send" value={chosen} options={kinds} onChange={(kind) => (what.value = kind)} />
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
                placeholder={source.needs_prompt ? "What to do to the view" : "Prompt (optional)"}
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
          {chosen === "view" && selection.value && (
            <Check
              label={source.mask ? "Only what is selected" : "Only what is selected (cut afterwards)"}
              value={onlySelected.value}
              onChange={(on) => (onlySelected.value = on)}
            />
          )}
          {chosen === "refine" && (
            <p class="row">
              <Choice
                label="Enlarged"
                value={enlarge.value}
                options={[
                  ["2", "2 times"],
                  ["4", "4 times"],
                ]}
                onChange={(times) => (enlarge.value = times)}
              />
            </p>
          )}
          {chosen === "around" && <Around source={source} />}
        </>
      )}
      <p class="row">
        <Button
          label={verb[chosen]}
          text={verb[chosen]}
          primary
          disabled={!ready || (chosen === "around" && readOnly.value)}
          onClick={send}
        />
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

/** The plan of views, made anew when what it depends on changes. Nothing is sent. */
function Around({ source }: { source: SourceInfo }) {
  const limit = maxViews.value;
  const begin = fromHere.value;
  useEffect(() => {
    let stop: (() => void) | undefined;
    plan.value = null;
    const wait = setTimeout(() => {
      const fields = { source: source.name, camera: begin ? camera.value : null, max_views: limit };
      const running = editor.link.do("source.plan", fields);
      stop = running.cancel;
      running.then((answer) => stop && (plan.value = answer), report);
    }, 200);
    return () => {
      clearTimeout(wait);
      stop?.();
      stop = undefined;
    };
  }, [source.name, limit, begin]);
  const now = plan.value;
  const calls = now?.views.length ?? 0;
  return (
    <>
      <Slider
        label="Max. views"
        value={limit}
        min={1}
        max={16}
        step={1}
        onInput={(value) => (maxViews.value = Math.round(value))}
      />
      <p class="row">
        <Check label="Start with the current view" value={begin} onChange={(on) => (fromHere.value = on)} />
      </p>
      <p class="row">
        <Check label="One layer for all views" value={oneLayer.value} onChange={(on) => (oneLayer.value = on)} />
      </p>
      <p role="status">
        {now === null
          ? "Planning the views"
          : `${calls} ${now.paid ? "paid " : ""}call${calls === 1 ? "" : "s"}${now.paid ? "" : ", not paid"}; together ` +
            `${(100 * now.covered).toFixed(0)} % of ${selectedCount.value > 0 ? "what is selected" : "the surface"}. ` +
            "Nothing was sent yet."}
      </p>
      <p class="quiet">
        Each view shows what earlier ones painted, and asks for the rest. Cancel keeps what is painted.
      </p>
    </>
  );
}

const given = (source: SourceInfo) => ({
  source: source.name,
  prompt: source.prompt ? prompt.value.trim() : "",
  seed: source.seed && seed.value.trim() ? Number(seed.value) : null,
});

/** Progress and cancel are those of every job. */
async function ask(source: SourceInfo, refine: boolean): Promise<void> {
  if (!camera.value) return;
  const limiting = !refine && onlySelected.value && selection.value;
  const view = camera.value;
  const mask = limiting ? await sendBlob(await maskPng(limiting), "mask.png") : null;
  const larger = refine ? (Number(enlarge.value) as 2 | 4) : 1;
  const answer = await run(
    "source.edit",
    { ...given(source), camera: view, mask, enlarge: larger },
    `Asking ${source.name}`,
  );
  if (!answer) return;
  addChecked(answer.name, answer);
  for (const warning of answer.warnings) toast("warning", warning.message);
}

async function cover(source: SourceInfo): Promise<void> {
  const views: CameraInfo[] = plan.value?.views.map((one) => one.camera) ?? [];
  const answer = await run(
    "source.cover",
    { ...given(source), views, one_layer: oneLayer.value, method: method.value },
    `Asking ${source.name}`,
  );
  if (!answer) return;
  for (const picture of answer.refused) addChecked(picture.name, picture);
  selectedLayer.value = answer.layers.at(-1)?.id ?? selectedLayer.value;
  if (answer.notes.length || answer.painted < views.length)
    toast(
      answer.painted < views.length ? "warning" : "info",
      `${answer.painted} of ${views.length} views painted${answer.cancelled ? ", then cancelled" : ""}.`,
      answer.notes.join("; "),
    );
}
