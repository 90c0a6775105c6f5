/** The list of assets, the numbers of the chosen one, and what can be done with it. */

import { useEffect, useState } from "preact/hooks";

import type { RecentProjects, SceneAssetInfo } from "../messages";
import { assets, chosenAsset, draggedAsset, selectedAsset, setAsset } from "../state/assets";
import { readOnly, selectedLayer } from "../state/store";
import { run } from "../editor/editor";
import { sendWithBar } from "../editor/sending";
import { frameAll } from "./header";
import { Button, Dialog, FileButton, NumberField } from "./parts";

const FORMATS = ".ply,.splat,.ksplat,.spz,.sog,.glb,.gltf,.zip";
const AXES = ["X", "Y", "Z"] as const;
const FAR = 1e9;

export function Assets() {
  const [adding, setAdding] = useState(false);
  const all = assets.value;
  const chosen = chosenAsset.value;
  return (
    <section class="assets" aria-label="Assets">
      <header>
        <h2>Assets</h2>
        <Button
          icon="plus"
          label="Add asset..."
          text={all.length > 1 ? undefined : "Add asset..."}
          disabled={readOnly.value}
          onClick={() => setAdding(true)}
        />
      </header>
      {(all.length > 1 || chosen) && (
        <ul class="asset-list">
          {all.map((one) => (
            <AssetRow key={one.id} asset={one} chosen={one.id === chosen?.id} last={all.length === 1} />
          ))}
        </ul>
      )}
      {chosen && <Stand asset={chosen} several={all.length > 1} />}
      {adding && <Adding onClose={() => setAdding(false)} />}
    </section>
  );
}

function AssetRow({ asset, chosen, last }: { asset: SceneAssetInfo; chosen: boolean; last: boolean }) {
  const [editing, setEditing] = useState(false);
  const set = (fields: { visible?: boolean; name?: string }, what: string) => void setAsset(asset.id, fields, what);
  const rename = (name: string) => {
    setEditing(false);
    if (name && name !== asset.name) set({ name }, `Renaming ${asset.name}`);
  };
  const layers = asset.layers === 1 ? "1 layer" : `${asset.layers} layers`;
  return (
    <li class={`layer${chosen ? " chosen" : ""}${asset.visible ? "" : " off"}`}>
      <Button
        icon={asset.visible ? "eye" : "hidden"}
        label={asset.visible ? `Hide asset ${asset.name}` : `Show asset ${asset.name}`}
        disabled={readOnly.value || (last && asset.visible)}
        onClick={() => set({ visible: !asset.visible }, `${asset.visible ? "Hiding" : "Showing"} ${asset.name}`)}
      />
      {editing ? (
        <input
          class="rename"
          type="text"
          defaultValue={asset.name} // what is being written stays while the asset changes
          aria-label="Asset name"
          ref={(input) => input?.focus()}
          onFocus={(event) => event.currentTarget.select()}
          onBlur={(event) => rename(event.currentTarget.value.trim())}
          onKeyDown={(event) => {
            event.stopPropagation();
            if (event.key === "Enter") event.currentTarget.blur();
            if (event.key === "Escape") setEditing(false);
          }}
        />
      ) : (
        <button
          type="button"
          class="layer-name"
          aria-pressed={chosen}
          onClick={() => (selectedAsset.value = chosen ? null : asset.id)}
          title={`${asset.name}: ${asset.gaussians.toLocaleString()} Gaussians, ${layers}`}
          onDblClick={() => !readOnly.value && setEditing(true)}
        >
          <b>{asset.name}</b>
          <span class="quiet">{asset.gaussians.toLocaleString()} Gaussians</span>
        </button>
      )}
      {asset.id !== "" && (
        <Button
          icon="bin"
          label={`Remove asset ${asset.name}`}
          disabled={readOnly.value}
          onClick={() => void run("scene.remove", { asset: asset.id }, `Removing ${asset.name}`)}
        />
      )}
    </li>
  );
}

/** Where the chosen asset stands, as numbers. */
function Stand({ asset, several }: { asset: SceneAssetInfo; several: boolean }) {
  const set = (fields: { move?: number[]; turn?: number[]; scale?: number }) => void draggedAsset(asset.id)(fields);
  const row = (name: string, values: number[], digits: number, change: (values: number[]) => void) => (
    <div class="stand-row">
      <span>{name}</span>
      {AXES.map((axis, k) => (
        <NumberField
          key={axis}
          label={`${name} ${axis}`}
          value={values[k]}
          min={-FAR}
          max={FAR}
          digits={digits}
          unit=""
          disabled={readOnly.value}
          onChange={(value) => change(values.map((old, n) => (n === k ? value : old)))}
        />
      ))}
    </div>
  );
  return (
    <div class="stand">
      {row("Move", asset.moved, 3, (moved) =>
        set({ move: asset.move.map((old, k) => moved[k] + (old - asset.moved[k])) }),
      )}
      {row("Turn", asset.turn, 1, (turn) => set({ turn }))}
      <div class="stand-row">
        <span>Scale</span>
        <NumberField
          label="Scale"
          value={asset.scale}
          min={1e-6}
          max={1e6}
          digits={3}
          unit=""
          disabled={readOnly.value}
          onChange={(scale) => set({ scale })}
        />
        {several && (
          <Button
            label="Match its colours to the other assets, where they are near to each other (a layer)"
            text="Match seam"
            disabled={readOnly.value || !asset.visible}
            onClick={() =>
              void run("scene.match", { asset: asset.id }, "Matching colours").then(
                (answer) => answer && (selectedLayer.value = answer.layer.id),
              )
            }
          />
        )}
      </div>
    </div>
  );
}

/** Choose an asset, with all of the scene in the window, as soon as it is there. */
function chooseAdded(asset: string): void {
  selectedAsset.value = asset;
  const stop = assets.subscribe((all) => {
    if (!all.some((one) => one.id === asset)) return;
    queueMicrotask(() => (stop(), frameAll()));
  });
}

function Adding({ onClose }: { onClose: () => void }) {
  const [projects, setProjects] = useState<RecentProjects | null>(null);
  useEffect(() => void run("project.recent", {}).then(setProjects), []);
  const added = async (work: Promise<{ asset: string } | null>) => {
    onClose(); // at once: the bar and its Cancel are beside the view
    const answer = await work;
    if (answer) chooseAdded(answer.asset);
  };
  const send = async (file: File) => {
    onClose();
    const blob = await sendWithBar(file);
    if (blob) await added(run("scene.add", { blob }, `Adding ${file.name}`));
  };
  const files = (projects?.files ?? []).filter((name) => !/\.splatproj$/i.test(name));
  return (
    <Dialog title="Add asset" onClose={onClose}>
      <p class="row">
        <FileButton label="Choose a file" icon="open" accept={FORMATS} onFiles={([file]) => file && void send(file)} />
        <Button
          label="Add the demo asset"
          text="Demo asset"
          onClick={() => void added(run("scene.add", { demo: true }, "Demo asset"))}
        />
      </p>
      <p class="quiet">It is placed beside the others. Its layers move with it.</p>
      <h3>Recent projects, as they were opened</h3>
      <ul class="list">
        {projects?.recent.map((one) => (
          <li key={one.id}>
            <button
              type="button"
              onClick={() => void added(run("scene.add", { recent: one.id }, `Adding ${one.name}`))}
            >
              <span>{one.name}</span>
            </button>
          </li>
        ))}
        {projects && projects.recent.length === 0 && <li class="quiet">None yet</li>}
      </ul>
      {files.length > 0 && <h3>In the studio's folder</h3>}
      <ul class="list">
        {files.map((file) => (
          <li key={file}>
            <button type="button" onClick={() => void added(run("scene.add", { file }, `Adding ${file}`))}>
              <span>{file}</span>
            </button>
          </li>
        ))}
      </ul>
    </Dialog>
  );
}
