/** The list of layers, uppermost first. */

import { signal } from "@preact/signals";
import { useLayoutEffect, useRef, useState } from "preact/hooks";

import { chordOf } from "../keys/chord";
import type { LayerInfo } from "../messages";
import { blobUrl, download } from "../net/blobs";
import { dragged, isPending, moveLayer, setLayer, shownLayers } from "../state/pending-layers";
import { maskedLayer, readOnly, selectedLayer, spreading, state, tab } from "../state/store";
import { report, run } from "../editor/editor";
import { nameOfAsset, selectedAsset } from "../state/assets";
import { openFile } from "./files";
import { changePlaced } from "../tools/replacing";
import { FillSettings } from "./fill-layer";
import { Icon, type IconName } from "./icons";
import { LayerMask, maskOpen, paintMask } from "./layer-mask";
import { OptionSettings } from "./layer-options";
import { CommandButton } from "./command-button";
import { Button, Check, Choice, FileButton, reveal, Slider } from "./parts";

const BLENDS = [
  ["normal", "Normal"],
  ["color", "Colour"],
  ["luminosity", "Luminosity"],
  ["darken", "Darken"],
  ["lighten", "Lighten"],
] as const;

/** The layer whose name is being written. */
const renaming = signal<string | null>(null);

export function Layers() {
  const layers = shownLayers.value;
  const topDown = [...layers].reverse();
  const chosen = layers.find((layer) => layer.id === selectedLayer.value) ?? null;
  const [rangeEnd, setRangeEnd] = useState<string | null>(null);
  const indexOf = (id: string | null | undefined) => layers.findIndex((layer) => layer.id === id);
  const [first, last] = [indexOf(chosen?.id), indexOf(rangeEnd) < 0 ? indexOf(chosen?.id) : indexOf(rangeEnd)];
  const range = chosen ? layers.slice(Math.min(first, last), Math.max(first, last) + 1) : [];
  const choose = (layer: LayerInfo, extend: boolean) => {
    setRangeEnd(extend && chosen ? layer.id : null);
    if (!extend || !chosen) selectedLayer.value = layer.id;
  };
  const list = useRef<HTMLUListElement>(null);
  useLayoutEffect(() => {
    reveal(list.current, list.current?.querySelector(".layer.chosen"));
  }, [chosen?.id]);
  /** Of a double click: rows may have moved under the pointer until its second one. */
  const firstClicked = useRef<string | null>(null);
  const [over, setOver] = useState<number | null>(null);
  const [carried, setCarried] = useState<string | null>(null);
  const drop = (to: number) => {
    const name = layers.find((layer) => layer.id === carried)?.name;
    if (carried) void moveLayer(carried, to, `Moving ${name}`);
    setCarried(null);
    setOver(null);
  };
  return (
    <section class="panel layers" aria-label="Layers">
      <header>
        <h2>Layers</h2>
        <LayerActions layer={chosen} layers={layers} range={range} />
      </header>
      <LayerSettings layer={chosen} />
      <ul ref={list} class="layer-list" aria-label="Layers, uppermost first">
        {topDown.map((layer, k) => {
          const index = layers.length - 1 - k;
          return (
            <li
              key={layer.id}
              class={`layer${range.includes(layer) ? " chosen" : ""}${over === index ? " over" : ""}${layer.visible ? "" : " off"}`}
              draggable={!readOnly.value}
              onClick={(event) => {
                if (event.detail < 2) firstClicked.current = layer.id;
                choose(layer, event.shiftKey);
              }}
              onDragStart={(event) => {
                event.dataTransfer!.setData("text/plain", layer.id);
                setCarried(layer.id);
              }}
              onDragOver={(event) => {
                if (!carried) return;
                event.preventDefault();
                setOver(index);
              }}
              onDragLeave={() => setOver(null)}
              onDragEnd={() => (setCarried(null), setOver(null))}
              onDrop={(event) => {
                if (!carried) return; // a file: the window takes it
                event.preventDefault();
                event.stopPropagation();
                drop(index);
              }}
            >
              <Button
                icon={layer.visible ? "eye" : "hidden"}
                label={layer.visible ? `Hide ${layer.name}` : `Show ${layer.name}`}
                disabled={readOnly.value}
                onClick={() =>
                  void setLayer(
                    layer.id,
                    { visible: !layer.visible },
                    `${layer.visible ? "Hiding" : "Showing"} ${layer.name}`,
                  )
                }
              />
              <Thumbnail layer={layer} />
              {layer.placed && (
                <Button
                  icon={layer.placed.kind === "text" ? "text" : "stamp"}
                  label={`Change ${layer.name}`}
                  disabled={readOnly.value}
                  onClick={() => void changePlaced(layer).catch(report)}
                />
              )}
              {layer.mask && (
                <Button
                  icon="mask"
                  label={
                    maskedLayer.value === layer.id ? `Paint ${layer.name} itself` : `Paint the mask of ${layer.name}`
                  }
                  pressed={maskedLayer.value === layer.id}
                  disabled={readOnly.value}
                  onClick={() => void paintMask(layer)}
                />
              )}
              <Name
                layer={layer}
                chosen={range.includes(layer)}
                onDblClick={() => rename(firstClicked.current)}
                onKeyDown={(event) => onKey(event, layer, index, layers.length)}
              />
              {isPending(layer.id) && <i class="spinner" role="status" aria-label={`${layer.name} is being changed`} />}
            </li>
          );
        })}
        {layers.length === 0 && <li class="empty">No layers yet. Paint on the asset, or drop an edited picture.</li>}
        <li class="layer base">
          <Icon name="lock" />
          <span>Original</span>
          <span class="quiet">
            {state.value ? `${state.value.asset.gaussians_original.toLocaleString()} Gaussians` : ""}
          </span>
        </li>
      </ul>
      {/* Below the list: what one layer has and another has not moves no row under the pointer. */}
      <SpreadSettings layer={chosen} />
      <FillSettings layer={chosen} />
      <OptionSettings layer={chosen} />
      <LayerMask layer={chosen} />
      <InConflict />
    </section>
  );
}

const rename = (layer: string | null): void => {
  if (!readOnly.value) renaming.value = layer;
};

function onKey(event: KeyboardEvent, layer: LayerInfo, index: number, count: number): void {
  const handled = () => (event.preventDefault(), event.stopPropagation());
  if (chordOf(event) === "Delete" && !readOnly.value)
    (void run("layer.delete", { layer: layer.id }, `Deleting ${layer.name}`), handled());
  if (event.altKey && event.key === "ArrowUp" && index < count - 1)
    (void moveLayer(layer.id, index + 1, `Moving ${layer.name}`), handled());
  if (event.altKey && event.key === "ArrowDown" && index > 0)
    (void moveLayer(layer.id, index - 1, `Moving ${layer.name}`), handled());
}

/** Of layers without a picture; all others are painted. */
const KIND_ICONS: Record<string, IconName> = {
  look: "lens",
  hide: "hidden",
  fill: "heal",
  light: "sun",
  delight: "sun",
  pixelate: "grid",
};

function Thumbnail({ layer }: { layer: LayerInfo }) {
  const [first] = layer.views;
  const picture = layer.thumbnail ?? first?.picture;
  if (!picture)
    return (
      <span class="thumbnail none">
        <Icon name={KIND_ICONS[layer.kind] ?? "brush"} />
      </span>
    );
  return <img class="thumbnail" src={blobUrl(picture)} alt="" loading="lazy" draggable={false} />;
}

interface NameProps {
  layer: LayerInfo;
  chosen: boolean;
  onDblClick: () => void;
  onKeyDown: (event: KeyboardEvent) => void;
}

function Name({ layer, chosen, onDblClick, onKeyDown }: NameProps) {
  if (renaming.value === layer.id)
    return (
      <input
        class="rename"
        type="text"
        defaultValue={layer.name} // what is being written stays while the layer changes
        aria-label="Layer name"
        autoFocus
        ref={(input) => input?.focus()}
        onFocus={(event) => event.currentTarget.select()}
        onClick={(event) => event.stopPropagation()}
        onBlur={(event) => {
          if (renaming.value !== layer.id) return; // left by Escape
          renaming.value = null;
          const name = event.currentTarget.value.trim();
          if (name && name !== layer.name) void setLayer(layer.id, { name }, `Renaming ${layer.name}`);
        }}
        onKeyDown={(event) => {
          event.stopPropagation();
          if (event.key === "Enter") event.currentTarget.blur();
          if (event.key === "Escape") renaming.value = null;
        }}
      />
    );
  const count = layer.gaussians_edited + layer.gaussians_appended;
  return (
    <button
      type="button"
      class="layer-name"
      aria-pressed={chosen}
      title={layer.note || layer.name}
      onDblClick={onDblClick}
      onKeyDown={(event) => {
        if (event.key === "F2") rename(layer.id);
        else onKeyDown(event);
      }}
    >
      <b>{layer.name}</b>
      <span class="quiet">
        {nameOfAsset(layer.asset) && `${nameOfAsset(layer.asset)}: `}
        {layer.strokes !== null && `${layer.strokes} ${layer.strokes === 1 ? "stroke" : "strokes"}, `}
        {count.toLocaleString()} Gaussians{layer.opacity < 1 ? `, ${Math.round(layer.opacity * 100)} %` : ""}
        {layer.blend !== "normal" && `, ${BLENDS.find(([key]) => key === layer.blend)?.[1].toLowerCase()}`}
      </span>
      {layer.visible && layer.problem && <span class="problem">Changes nothing: {layer.problem}</span>}
    </button>
  );
}

/** Go on with the layer that a command made. */
const chooseMade = (answer: { layer: LayerInfo } | null): void => {
  if (answer) selectedLayer.value = answer.layer.id;
};

async function exportLayer(layer: LayerInfo): Promise<void> {
  const answer = await run("layer.export", { layer: layer.id }, `Writing ${layer.name}`);
  if (answer) download(answer.url, answer.file);
}

interface ActionProps {
  layer: LayerInfo | null;
  layers: LayerInfo[];
  /** The chosen layer and those up to where Shift was clicked, from below. */
  range: LayerInfo[];
}

/** What can be done with the chosen layer. */
function LayerActions({ layer, layers, range }: ActionProps) {
  const off = !layer || readOnly.value;
  const below = layer ? layers[layers.indexOf(layer) - 1] : undefined;
  const together = range.length > 1 ? range : layer && below ? [below, layer] : [];
  return (
    <span class="group">
      <Button
        icon="plus"
        label="New layer to paint into"
        disabled={readOnly.value || !state.value}
        onClick={() =>
          void run("layer.new", { above: layer?.id ?? null, asset: selectedAsset.value ?? "" }, "New layer").then(
            chooseMade,
          )
        }
      />
      <CommandButton
        icon="copy"
        command="layer.duplicate"
        disabled={off}
        onClick={() =>
          layer && void run("layer.duplicate", { layer: layer.id }, `Duplicating ${layer.name}`).then(chooseMade)
        }
      />
      <Button
        icon="mask"
        label="Mask of the layer"
        pressed={maskOpen.value}
        disabled={!layer}
        onClick={() => (maskOpen.value = !maskOpen.value)}
      />
      <Button
        icon="merge"
        label={
          range.length > 1 ? `Merge ${range.length} layers` : "Merge with the layer below (Shift-click chooses several)"
        }
        disabled={off || together.length < 2}
        onClick={() =>
          void run("layer.merge", { layers: together.map(({ id }) => id), name: together[0].name }, "Merging").then(
            chooseMade,
          )
        }
      />
      <Button
        icon="share"
        label="Save the layer as a file"
        disabled={!layer}
        onClick={() => layer && void exportLayer(layer)}
      />
      <FileButton
        icon="open"
        label="Add a layer from a file"
        bare
        accept=".splatlayer"
        disabled={readOnly.value || !state.value}
        onFiles={([file]) => file && void openFile(file)}
      />
      <CommandButton
        icon="bin"
        label="Delete the layer"
        command="edit.delete"
        disabled={off}
        onClick={() => layer && void run("layer.delete", { layer: layer.id }, `Deleting ${layer.name}`)}
      />
    </span>
  );
}

/** Blend and opacity of the chosen layer. */
function LayerSettings({ layer }: { layer: LayerInfo | null }) {
  const drag = useRef<{ layer: string; send: ReturnType<typeof dragged> } | null>(null);
  const off = !layer || readOnly.value;
  const fade = (opacity: number, end: boolean) => {
    if (!layer) return;
    if (drag.current?.layer !== layer.id)
      drag.current = { layer: layer.id, send: dragged(layer.id, `Opacity of ${layer.name}`) };
    void drag.current.send({ opacity });
    if (end) drag.current = null;
  };
  return (
    <div class="layer-settings">
      <Choice
        label="Blend"
        value={layer?.blend ?? "normal"}
        options={BLENDS}
        disabled={off}
        onChange={(blend) => layer && void setLayer(layer.id, { blend }, `Blend of ${layer.name}`)}
      />
      <Slider
        label="Opacity"
        value={(layer?.opacity ?? 1) * 100}
        min={0}
        max={100}
        step={1}
        unit=" %"
        disabled={off}
        onInput={(v) => fade(Math.round(v) / 100, false)}
        onChange={(v) => fade(Math.round(v) / 100, true)}
      />
    </div>
  );
}

/** How far a layer that spreads reaches; it is solved again where the slider is let go. */
function SpreadSettings({ layer }: { layer: LayerInfo | null }) {
  const [draft, setDraft] = useState<number | null>(null);
  if (!layer || layer.mode !== "spread") return null;
  const given = layer.parameters["spread_threshold"];
  const solve = (value: number) => {
    const parameters = { ...layer.parameters, spread_threshold: Math.round(value) / 100 };
    setDraft(null);
    void setLayer(layer.id, { parameters }, `Threshold of ${layer.name}`);
  };
  return (
    <>
      <div class="layer-settings">
        <Slider
          label="Threshold"
          value={draft ?? (typeof given === "number" ? given : 0.5) * 100}
          min={0}
          max={100}
          step={1}
          unit=" %"
          disabled={readOnly.value}
          onInput={setDraft}
          onChange={solve}
        />
      </div>
      <div class="layer-settings">
        <Check
          label="Show confidence"
          value={spreading.value.show}
          onChange={(show) => (spreading.value = { ...spreading.value, show })}
        />
      </div>
    </>
  );
}

/** Names layers that overwrite each other where it matters, and leads to where that is settled. */
function InConflict() {
  const [first, ...more] = (state.value?.conflicts ?? []).filter((one) => one.reason && one.policy === "latest");
  if (!first) return null;
  const { upper_name: upper, lower_name: lower } = first;
  return (
    <button type="button" class="in-conflict" onClick={() => (tab.value = "views")}>
      {first.reason === "stale"
        ? `${lower} was painted on under ${upper}, which shows it as it was`
        : `${upper} and ${lower}, of different views, cover each other`}
      {more.length > 0 && ` (and ${more.length} more)`}
    </button>
  );
}
