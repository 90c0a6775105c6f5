/** The selection: how much is selected, how to change it, what to do with it, and what was kept by name. */

import { signal } from "@preact/signals";

import type { SelectByAttribute } from "../messages";
import { healFromAround } from "../paint/mending";
import { cropBox, removesBody, selectedCount, selection, sent, tinted, wholeIsSelected } from "../paint/selected";
import { changeSelection, deselect, fillSelected, hideSelected, selectWhole } from "../paint/selection";
import { camera, readOnly, selecting, state } from "../state/store";
import { editor, report, run } from "../editor/editor";
import type { Vec3 } from "../view/camera";
import { CommandButton } from "./command-button";
import { Button, Check, Choice, Percent, Slider } from "./parts";
import { PixelateSelected } from "./pixelate";

const ATTRIBUTES: readonly (readonly [SelectByAttribute["attribute"], string])[] = [
  ["size", "Size (rank)"],
  ["opacity", "Opacity"],
  ["depth", "Depth"],
  ["height", "Height"],
];
/** How far grow, shrink and feather go, share of the asset's radius. */
const amount = signal(0.03);
const value = signal<{ attribute: SelectByAttribute["attribute"]; low: number; high: number }>({
  attribute: "size",
  low: 0.95,
  high: 1,
});
const floaterShare = signal(0.01);
const naming = signal("");

/** Over the view while something is selected. */
export function SelectionChip() {
  const count = selectedCount.value;
  if (count === 0) return null;
  return (
    <div class="selection-chip" role="status">
      <span>{count.toLocaleString()} selected</span>
      <CommandButton
        icon="eye"
        command="select.tint"
        pressed={tinted.value}
        onClick={() => (tinted.value = !tinted.value)}
      />
      <CommandButton icon="close" command="select.none" onClick={deselect} />
    </div>
  );
}

export function SelectionPanel() {
  const now = state.value;
  if (!now) return null;
  const none = selectedCount.value === 0;
  const off = none || readOnly.value;
  const move = (to: "grow" | "shrink" | "feather") => changeSelection(to, amount.value * now.asset.radius);
  return (
    <div class="selection-panel">
      <p class="row">
        <CommandButton
          command="select.invert"
          text="Invert"
          disabled={none}
          onClick={() => changeSelection("invert")}
        />
        <Button
          label="Everything connected to the selection"
          text="Connected"
          disabled={none}
          onClick={() => changeSelection("connected")}
        />
        <CommandButton
          label="Hide the selection, as a layer; the Gaussians stay in the file"
          command="edit.delete"
          text="Hide"
          disabled={off}
          onClick={() => void hideSelected(false, "Hide")}
        />
        <Button
          label="Hide everything else, as a layer"
          text="Crop"
          disabled={off}
          onClick={() => void hideSelected(true, "Crop")}
        />
      </p>
      <p class="row">
        <Button
          label="Select the whole thing of which something is selected, its back too"
          text="Whole thing"
          disabled={none}
          onClick={() => void selectWhole()}
        />
        <CommandButton
          label="Hide what is selected, and continue the surface behind it with new Gaussians"
          command="select.fill"
          text="Remove and fill"
          disabled={off}
          onClick={() => void fillSelected(true)}
        />
        <Button
          label="Continue the surface over a hole that the selection surrounds"
          text="Fill hole"
          disabled={off}
          onClick={() => void fillSelected(false)}
        />
        <Button
          label="Heal the selected part of this view from its surroundings"
          text="Heal"
          disabled={off || !selection.value}
          onClick={() => void healFromAround().catch(report)}
        />
      </p>
      {wholeIsSelected.value ? (
        <p class="quiet">What is tinted goes: Shift adds to it, Alt takes away.</p>
      ) : (
        <Check
          label="Remove the whole thing, not only what is selected"
          value={removesBody.value}
          onChange={(whole) => (removesBody.value = whole)}
        />
      )}
      <details open>
        <summary>Edge</summary>
        <Slider
          label="Amount"
          value={amount.value * 100}
          min={0.2}
          max={30}
          log
          digits={1}
          unit=" %"
          onInput={(v) => (amount.value = v / 100)}
        />
        <p class="row">
          <Button label="Grow the selection" text="Grow" disabled={none} onClick={() => move("grow")} />
          <Button label="Shrink the selection" text="Shrink" disabled={none} onClick={() => move("shrink")} />
          <Button label="Soften the edge" text="Feather" disabled={none} onClick={() => move("feather")} />
        </p>
      </details>
      <ByValue />
      <details>
        <summary>Floaters</summary>
        <Slider
          label="Up to"
          value={floaterShare.value * 100}
          min={0.01}
          max={100}
          log
          digits={2}
          unit=" %"
          onInput={(v) => (floaterShare.value = v / 100)}
        />
        <p class="quiet">of the surface of the largest part</p>
        <p class="row">
          <Button
            label="Select small loose parts, and haze that touches nothing"
            text="Find floaters"
            onClick={() => changeSelection("floaters", 0, floaterShare.value)}
          />
        </p>
      </details>
      <PixelateSelected off={off} />
      <CropBox />
      <Kept off={off} />
    </div>
  );
}

function ByValue() {
  const v = value.value;
  const set = (part: Partial<typeof v>) => {
    const next = { ...value.value, ...part };
    value.value = { ...next, low: Math.min(next.low, next.high), high: Math.max(next.low, next.high) };
  };
  const select = () =>
    camera.value &&
    void sent(() =>
      run("selection.attribute", { camera: camera.value!, ...v, how: selecting.value.combine }, "Selecting"),
    );
  return (
    <details>
      <summary>By value</summary>
      <Choice label="Value" value={v.attribute} options={ATTRIBUTES} onChange={(attribute) => set({ attribute })} />
      <Percent label="From" value={v.low} onInput={(low) => set({ low })} />
      <Percent label="To" value={v.high} onInput={(high) => set({ high })} />
      <p class="row">
        <Button label="Select by value" text="Select" onClick={select} />
      </p>
    </details>
  );
}

const AXES = ["X", "Y", "Z"] as const;
/** How much farther than nearly all of the asset a new box reaches. */
const BOX_ROOM = 1.1;

function CropBox() {
  const box = cropBox.value;
  const { center, radius } = state.value!.asset;
  const start = () => {
    // what reaches farthest along the axis is left out if it is one Gaussian in a hundred; a little room is added
    const reach = (axis: number, sign: number) =>
      BOX_ROOM *
      (editor.viewer.depthBelow(center as Vec3, [0, 1, 2].map((k) => (k === axis ? -sign : 0)) as Vec3) ?? radius);
    const side = (sign: number) => center.map((v, axis) => v + sign * reach(axis, sign)) as Vec3;
    cropBox.value = box ? null : { low: side(-1), high: side(1) };
  };
  const set = (side: "low" | "high", axis: number, to: number) => {
    const next = { low: [...box!.low] as Vec3, high: [...box!.high] as Vec3 };
    next[side][axis] = to;
    if (next.low[axis] <= next.high[axis]) cropBox.value = next;
  };
  const select = async (crop: boolean) => {
    const { low, high } = box!;
    await sent(() => run("selection.box", { low, high, how: crop ? "replace" : selecting.value.combine }, "Selecting"));
    if (crop) await hideSelected(true, "Crop box");
    cropBox.value = null;
  };
  return (
    <details open={box !== null}>
      <summary>Box</summary>
      {!box && (
        <p class="row">
          <Button label="Show a box around the asset; its faces have handles" text="Set a box" onClick={start} />
        </p>
      )}
      {box && (
        <>
          {AXES.map((name, axis) =>
            (["low", "high"] as const).map((side) => (
              <Slider
                key={name + side}
                label={`${name} ${side === "low" ? "from" : "to"}`}
                value={box[side][axis]}
                min={center[axis] - 1.5 * radius}
                max={center[axis] + 1.5 * radius}
                step={radius / 200}
                digits={2}
                onInput={(to) => set(side, axis, to)}
              />
            )),
          )}
          <p class="row">
            <Button label="Select what is in the box" text="Select" onClick={() => void select(false)} />
            <Button
              label="Hide everything outside of the box, as a layer"
              text="Crop to box"
              disabled={readOnly.value}
              onClick={() => void select(true)}
            />
            <Button label="Remove the box" icon="close" onClick={start} />
          </p>
        </>
      )}
    </details>
  );
}

function Kept({ off }: { off: boolean }) {
  const names = state.value!.selection.names;
  const save = () => {
    const name = naming.value.trim() || `Selection ${names.length + 1}`;
    naming.value = "";
    void sent(() => run("selection.save", { name })).then((answer) => answer ?? (naming.value ||= name));
  };
  return (
    <details open={names.length > 0}>
      <summary>Saved in the project</summary>
      <p class="row">
        <input
          type="text"
          aria-label="Name of the selection"
          placeholder="Name"
          value={naming.value}
          onInput={(event) => (naming.value = event.currentTarget.value)}
          onKeyDown={(event) => {
            event.stopPropagation();
            if (event.key === "Enter" && !off) save();
          }}
        />
        <Button label="Save the selection under this name" icon="save" disabled={off} onClick={save} />
      </p>
      <ul class="list">
        {names.map((name) => (
          <li key={name}>
            <button
              type="button"
              onClick={() =>
                void sent(() => run("selection.recall", { name, how: selecting.value.combine }, "Selecting"))
              }
            >
              {name}
            </button>
            <Button
              icon="bin"
              label={`Delete ${name}`}
              disabled={readOnly.value}
              onClick={() => void run("selection.delete", { name })}
            />
          </li>
        ))}
      </ul>
    </details>
  );
}
