/** Pictures edited elsewhere: what they are, what changed in them, and one edit from up to four. */

import { useEffect, useRef } from "preact/hooks";

import { selectedCount } from "../paint/selected";
import { blobUrl } from "../net/blobs";
import {
  addPicture,
  applyImages,
  check,
  discard,
  editMode,
  droppedImages,
  isPresentView,
  maskUrl,
  MAX_IMAGES,
  setThreshold,
  type DroppedImage,
} from "../state/dropped-images";
import { camera, method, readOnly } from "../state/store";
import { report } from "../editor/editor";
import { chooseTool } from "../tools";
import { placePicture, stamp } from "../tools/stamp";
import { Button, Choice, FileButton, Slider } from "./parts";
import { SourceDialog, sourcesOpen } from "./sources";
import { goTo } from "./views";

const MODES = [
  ["local", "Only what was edited"],
  ["global", "The whole asset (relit)"],
  ["spread", "The edited material, all around"],
] as const;
const CAMERA_SOURCES = {
  given: "the current view",
  chunk: "its camera is in the file",
  sidecar: "its camera is in the file beside it",
  export: "recognised as an exported view",
  capture: "a photograph of this capture",
} as const;

export function Pictures() {
  const list = droppedImages.value;
  const ready = list.filter((one) => one.checked).length;
  return (
    <div class="pictures">
      <p class="row">
        <FileButton
          label="Choose pictures"
          icon="open"
          accept="image/png,image/jpeg,image/webp"
          multiple
          onFiles={(files) => files.slice(0, MAX_IMAGES).forEach((file) => void addPicture(file))}
        />
        <Button
          label="Send the current view to a program or an image service"
          text="Edit with a source..."
          onClick={() => (sourcesOpen.value = true)}
        />
      </p>
      {sourcesOpen.value && <SourceDialog onClose={() => (sourcesOpen.value = false)} />}
      {list.length === 0 && (
        <p class="quiet">
          Drop a picture of the asset that you edited in another program. Its camera is found automatically.
        </p>
      )}
      {list.map((one) => (
        <Entry key={one.id} one={one} />
      ))}
      {ready > 0 && (
        <>
          <p class="row wide">
            <Choice
              label="Changes"
              value={editMode.value}
              options={MODES}
              onChange={(mode) => (editMode.value = mode)}
            />
          </p>
          {selectedCount.value > 0 && <p class="quiet">Only what is selected changes.</p>}
          <p class="row actions">
            <Button
              label="Make it a layer"
              icon="check"
              primary
              disabled={readOnly.value}
              text={ready > 1 ? `Apply ${ready} views as one layer` : "Apply as layer"}
              onClick={() => void applyImages(method.value)}
            />
          </p>
        </>
      )}
    </div>
  );
}

function Entry({ one }: { one: DroppedImage }) {
  const entry = useRef<HTMLElement>(null);
  const ready = one.checked !== null || one.problem !== "";
  useEffect(() => entry.current?.scrollIntoView({ block: "nearest" }), [ready]); // scrolled to when its camera is there
  const timer = useRef<ReturnType<typeof setTimeout> | undefined>(undefined);
  const { checked } = one;
  const place = async () => {
    if (!camera.value) return;
    chooseTool(stamp);
    const pixels = await (await fetch(blobUrl(one.blob))).blob();
    if (await placePicture(pixels, one.name)) discard(one.id);
  };
  const recheck = (percent: number) => {
    setThreshold(one.id, percent / 100);
    clearTimeout(timer.current);
    timer.current = setTimeout(() => void check(one.id).catch(report), 150);
  };
  return (
    <article ref={entry} class="drop" aria-label={one.name}>
      <header>
        <b title={one.name}>{one.name}</b>
        {checked && <Button icon="camera" label="Go to this view" onClick={() => goTo(checked.camera)} />}
        <Button icon="close" label="Remove" onClick={() => discard(one.id)} />
      </header>
      <span class="drop-picture">
        <img src={blobUrl(checked?.picture ?? one.blob)} alt={one.name} />
        {checked && editMode.value !== "global" && (
          <span
            class="drop-mask"
            role="img"
            aria-label="What did not change is dimmed"
            style={{ "--mask": `url(${maskUrl(one)})` }}
          />
        )}
      </span>
      {checked && (
        <>
          <p class="quiet">
            {CAMERA_SOURCES[checked.camera_source]}; {(checked.share * 100).toFixed(1)} % changed
            {Math.hypot(...checked.shift) > 0.05
              ? `; moved back by ${checked.shift.map((v) => v.toFixed(1)).join(", ")} px`
              : ""}
          </p>
          {checked.notes.map((line) => (
            <p class="quiet" key={line}>
              {line}
            </p>
          ))}
          {checked.warnings.map((warning) => (
            <div class="warning" key={warning.message}>
              <p>{warning.message}</p>
              {warning.picture && <img src={blobUrl(warning.picture)} alt="Where" />}
            </div>
          ))}
          {editMode.value !== "global" && (
            <Slider
              label="Threshold"
              value={(one.threshold ?? 0.02) * 100}
              min={0}
              max={30}
              step={0.1}
              digits={1}
              unit=" %"
              onInput={recheck}
            />
          )}
        </>
      )}
      {one.problem && (
        <div class="warning">
          <p>{one.problem}</p>
          <p class="row">
            <Button
              label="It shows the current view"
              text="It shows this view"
              onClick={() => void isPresentView(one.id).catch(report)}
            />
            <Button
              label="Place it on the view and move it"
              text="Use as stamp"
              onClick={() => void place().catch(report)}
            />
          </p>
        </div>
      )}
    </article>
  );
}
