/** The list of layers, uppermost first. */

import { useState } from "preact/hooks";

import { chordOf } from "../keys/chord";
import type { LayerInfo, LayerSet } from "../messages";
import { blobUrl, download } from "../net/blobs";
import { readOnly, selectedLayer, state, tab } from "../state/store";
import { report, run } from "../state/studio";
import { openFile } from "./files";
import { changePlaced } from "../paint/placement";
import { Icon } from "./icons";
import { Button, Choice, FileButton, Slider } from "./parts";

const BLENDS = [
  ["normal", "Normal"],
  ["color", "Colour"],
  ["luminosity", "Luminosity"],
  ["darken", "Darken"],
  ["lighten", "Lighten"],
] as const;

const set = (layer: string, fields: Omit<LayerSet, "layer">) => run("layer.set", { layer, ...fields }, "Layer");

export function Layers() {
  const layers = state.value?.layers ?? [];
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
  const [over, setOver] = useState<number | null>(null);
  const [dragged, setDragged] = useState<string | null>(null);
  const drop = (to: number) => {
    if (dragged) void run("layer.move", { layer: dragged, to }, "Reordering");
    setDragged(null);
    setOver(null);
  };
  return (
    <section class="panel layers" aria-label="Layers">
      <header>
        <h2>Layers</h2>
        <LayerActions layer={chosen} layers={layers} range={range} />
      </header>
      <LayerSettings layer={chosen} />
      <InConflict />
      <ul class="layer-list" aria-label="Layers, uppermost first">
        {topDown.map((layer, k) => {
          const index = layers.length - 1 - k;
          return (
            <li
              key={layer.id}
              class={`layer${range.includes(layer) ? " chosen" : ""}${over === index ? " over" : ""}${layer.visible ? "" : " off"}`}
              draggable={!readOnly.value}
              onClick={(event) => choose(layer, event.shiftKey)}
              onDragStart={(event) => {
                event.dataTransfer!.setData("text/plain", layer.id);
                setDragged(layer.id);
              }}
              onDragOver={(event) => {
                if (!dragged) return;
                event.preventDefault();
                setOver(index);
              }}
              onDragLeave={() => setOver(null)}
              onDragEnd={() => (setDragged(null), setOver(null))}
              onDrop={(event) => (event.preventDefault(), event.stopPropagation(), drop(index))}
            >
              <Button
                icon={layer.visible ? "eye" : "hidden"}
                label={layer.visible ? `Hide ${layer.name}` : `Show ${layer.name}`}
                disabled={readOnly.value}
                onClick={() => void set(layer.id, { visible: !layer.visible })}
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
              <Name
                layer={layer}
                chosen={range.includes(layer)}
                onKeyDown={(event) => onKey(event, layer, index, layers.length)}
              />
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
    </section>
  );
}

function onKey(event: KeyboardEvent, layer: LayerInfo, index: number, count: number): void {
  const handled = () => (event.preventDefault(), event.stopPropagation());
  if (chordOf(event) === "Delete" && !readOnly.value)
    (void run("layer.delete", { layer: layer.id }, "Deleting"), handled());
  if (event.altKey && event.key === "ArrowUp" && index < count - 1)
    (void run("layer.move", { layer: layer.id, to: index + 1 }, "Reordering"), handled());
  if (event.altKey && event.key === "ArrowDown" && index > 0)
    (void run("layer.move", { layer: layer.id, to: index - 1 }, "Reordering"), handled());
}

function Thumbnail({ layer }: { layer: LayerInfo }) {
  const [first] = layer.views;
  const picture = layer.thumbnail ?? first?.picture;
  if (!picture)
    return <span class="thumbnail none">{layer.kind === "look" ? <Icon name="lens" /> : <Icon name="brush" />}</span>;
  return <img class="thumbnail" src={blobUrl(picture)} alt="" loading="lazy" draggable={false} />;
}

interface NameProps {
  layer: LayerInfo;
  chosen: boolean;
  onKeyDown: (event: KeyboardEvent) => void;
}

function Name({ layer, chosen, onKeyDown }: NameProps) {
  const [editing, setEditing] = useState(false);
  if (editing)
    return (
      <input
        class="rename"
        type="text"
        value={layer.name}
        aria-label="Layer name"
        autoFocus
        ref={(input) => input?.focus()}
        onClick={(event) => event.stopPropagation()}
        onBlur={(event) => {
          setEditing(false);
          const name = event.currentTarget.value.trim();
          if (name && name !== layer.name) void set(layer.id, { name });
        }}
        onKeyDown={(event) => {
          event.stopPropagation();
          if (event.key === "Enter") event.currentTarget.blur();
          if (event.key === "Escape") setEditing(false);
        }}
      />
    );
  const count = layer.gaussians_edited + layer.gaussians_appended;
  const rename = () => !readOnly.value && setEditing(true);
  return (
    <button
      type="button"
      class="layer-name"
      aria-pressed={chosen}
      title={layer.note || layer.name}
      onDblClick={rename}
      onKeyDown={(event) => {
        if (event.key === "F2") rename();
        else onKeyDown(event);
      }}
    >
      <b>{layer.name}</b>
      <span class="quiet">
        {layer.strokes !== null && `${layer.strokes} ${layer.strokes === 1 ? "stroke" : "strokes"}, `}
        {count.toLocaleString()} Gaussians{layer.opacity < 1 ? `, ${Math.round(layer.opacity * 100)} %` : ""}
        {layer.blend !== "normal" ? `, ${layer.blend}` : ""}
      </span>
    </button>
  );
}

/** Go on with the layer that a command made. */
const chooseMade = (answer: { layer: LayerInfo } | null): void => {
  if (answer) selectedLayer.value = answer.layer.id;
};

async function exportLayer(layer: LayerInfo): Promise<void> {
  const answer = await run("layer.export", { layer: layer.id }, "Writing the layer");
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
        onClick={() => void run("layer.new", { above: layer?.id ?? null }, "New layer").then(chooseMade)}
      />
      <Button
        icon="copy"
        command="layer.duplicate"
        disabled={off}
        onClick={() => layer && void run("layer.duplicate", { layer: layer.id }, "Duplicating").then(chooseMade)}
      />
      <Button
        icon="merge"
        label={
          range.length > 1 ? `Merge ${range.length} layers` : "Merge with the layer below (Shift-click chooses several)"
        }
        disabled={off || together.length < 2}
        onClick={() => void run("layer.merge", { layers: together.map((one) => one.id) }, "Merging").then(chooseMade)}
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
      <Button
        icon="bin"
        label="Delete the layer"
        command="edit.delete"
        disabled={off}
        onClick={() => layer && void run("layer.delete", { layer: layer.id }, "Deleting")}
      />
    </span>
  );
}

/** Blend and opacity of the chosen layer. */
function LayerSettings({ layer }: { layer: LayerInfo | null }) {
  const [draft, setDraft] = useState<number | null>(null);
  const off = !layer || readOnly.value;
  return (
    <div class="layer-settings">
      <Choice
        label="Blend"
        value={layer?.blend ?? "normal"}
        options={BLENDS}
        disabled={off}
        onChange={(blend) => layer && void set(layer.id, { blend })}
      />
      <Slider
        label="Opacity"
        value={(draft ?? layer?.opacity ?? 1) * 100}
        min={0}
        max={100}
        unit=" %"
        disabled={off}
        onInput={(v) => setDraft(v / 100)}
        onChange={(v) => {
          if (layer) void set(layer.id, { opacity: Math.round(v) / 100 }).finally(() => setDraft(null));
        }}
      />
    </div>
  );
}

/** Says that layers overwrite each other, and leads to where that is settled. */
function InConflict() {
  const count = state.value?.conflicts.filter((one) => one.policy === "latest").length ?? 0;
  if (count === 0) return null;
  return (
    <button type="button" class="in-conflict" onClick={() => (tab.value = "views")}>
      Layers of different views overlap ({count})
    </button>
  );
}
