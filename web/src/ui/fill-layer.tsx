/** A layer that fills a hole: whether it takes its colours from what surrounds it, or from a picture source. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { LayerInfo, SourceInfo } from "../messages";
import { camera, readOnly } from "../state/store";
import { run } from "../editor/editor";
import { Button, Choice } from "./parts";

/** null: not asked for yet. */
const sources = signal<SourceInfo[] | null>(null);
const chosenName = signal("");
const prompt = signal("");

export function FillSettings({ layer }: { layer: LayerInfo | null }) {
  const isFill = layer?.kind === "fill";
  useEffect(() => {
    if (isFill && sources.value === null)
      void run("source.list", {}).then((answer) => {
        sources.value = (answer?.sources ?? []).filter((one) => !one.missing);
        chosenName.value = sources.value[0]?.name ?? "";
      });
  }, [isFill]);
  if (!layer || !isFill) return null;
  const list = sources.value ?? [];
  const source = list.find((one) => one.name === chosenName.value) ?? null;
  const colored = layer.views.length > 0;
  const ready = source && !(source.needs_prompt && !prompt.value.trim()) && !readOnly.value && layer.visible;
  const ask = () =>
    source &&
    camera.value &&
    void run(
      "fill.source",
      {
        layer: layer.id,
        source: source.name,
        camera: camera.value,
        prompt: source.prompt ? prompt.value.trim() : "",
      },
      `Asking ${source.name}`,
    );
  return (
    <details class="layer-mask" open={colored}>
      <summary>{colored ? "Filled by a source" : "Filled from its surroundings"}</summary>
      {list.length > 0 && (
        <p class="row">
          <Choice
            label="Source"
            value={chosenName.value}
            options={list.map((one) => [one.name, one.paid ? `${one.name} (paid)` : one.name] as const)}
            onChange={(name) => (chosenName.value = name)}
          />
        </p>
      )}
      {source?.prompt && (
        <p class="row wide">
          <input
            type="text"
            aria-label="What should be there"
            placeholder={source.needs_prompt ? "What should be there" : "Prompt (optional)"}
            maxLength={4000}
            value={prompt.value}
            onInput={(event) => (prompt.value = event.currentTarget.value)}
            onKeyDown={(event) => {
              event.stopPropagation();
              if (event.key === "Enter" && ready) ask();
            }}
          />
        </p>
      )}
      <p class="row">
        {list.length > 0 && (
          <Button
            label="Send this view with the fill as its mask, and colour the fill by the answer"
            text="Ask"
            primary
            disabled={!ready}
            onClick={ask}
          />
        )}
        {colored && (
          <Button
            label="Fill from the surroundings again"
            text="Surroundings"
            disabled={readOnly.value}
            onClick={() => void run("fill.surroundings", { layer: layer.id }, `Filling ${layer.name}`)}
          />
        )}
      </p>
      {sources.value !== null && list.length === 0 && <p class="quiet">No picture source is set up.</p>}
    </details>
  );
}
