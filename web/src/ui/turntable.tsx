/** A turn around the asset, moving: how large, how long, on what. */

import { signal } from "@preact/signals";

import { download } from "../net/blobs";
import { shownLayers } from "../state/pending-layers";
import { camera, toast } from "../state/store";
import { run } from "../editor/editor";
import { chosenCamera, FrameSize, frameChoice } from "./frame-size";
import { Button, Choice, Dialog, Slider } from "./parts";

const FORMATS = [
  ["mp4", "MP4 (AV1)"],
  ["webp", "WebP, animated"],
] as const;
const RATES = [
  ["15", "15 a second"],
  ["24", "24 a second"],
  ["30", "30 a second"],
  ["60", "60 a second"],
] as const;
const TURNS = [
  ["360", "Once around"],
  ["-360", "Once, the other way"],
  ["90", "A quarter"],
  ["180", "Half"],
] as const;

const WHAT = [
  ["camera", "The camera turns"],
  ["lights", "The lights turn"],
  ["both", "Both turn"],
] as const;

const turns = signal<(typeof WHAT)[number][0]>("camera");
const choice = frameChoice("1080x1080");
const format = signal<"mp4" | "webp">("mp4");
const seconds = signal(6);
const rate = signal<(typeof RATES)[number][0]>("30");
const degrees = signal<(typeof TURNS)[number][0]>("360");
const quality = signal(80);

async function make(): Promise<boolean> {
  const first = chosenCamera(choice, camera.value);
  if (!first) return false;
  const transparent = format.value === "webp" && choice.background.value === "straight";
  const fields = { format: format.value, seconds: seconds.value, fps: Number(rate.value), quality: quality.value };
  const turn = {
    camera: first,
    degrees: Number(degrees.value),
    turns: shownLayers.value.some((one) => one.kind === "light") ? turns.value : ("camera" as const),
    transparent,
  };
  const answer = await run("turntable", { ...fields, ...turn }, "Turntable");
  if (!answer) return false;
  download(answer.url, answer.file);
  toast("info", `${answer.file}, ${(answer.bytes / 1e6).toFixed(1)} MB`);
  return true;
}

export function TurntableDialog({ onClose }: { onClose: () => void }) {
  const view = camera.value;
  const frames = Math.round(seconds.value * Number(rate.value));
  const clear = format.value === "webp" ? ([["straight", "Transparent"]] as const) : [];
  return (
    <Dialog title="Turntable" onClose={onClose}>
      <p class="row">
        <Choice label="File" value={format.value} options={FORMATS} onChange={(value) => (format.value = value)} />
        <Choice label="Turn" value={degrees.value} options={TURNS} onChange={(value) => (degrees.value = value)} />
        {shownLayers.value.some((one) => one.kind === "light") && (
          <Choice label="What turns" value={turns.value} options={WHAT} onChange={(value) => (turns.value = value)} />
        )}
      </p>
      <FrameSize choice={choice} view={view} clear={clear} />
      <Slider
        label="Seconds"
        value={seconds.value}
        min={1}
        max={30}
        step={0.5}
        digits={1}
        unit=" s"
        onInput={(value) => (seconds.value = value)}
      />
      <p class="row">
        <Choice label="Frames" value={rate.value} options={RATES} onChange={(value) => (rate.value = value)} />
      </p>
      <Slider
        label="Quality"
        value={quality.value}
        min={30}
        max={100}
        step={1}
        onInput={(value) => (quality.value = Math.round(value))}
      />
      <p class="quiet">
        {frames} frames, from this view on. MP4 plays in browsers, VLC and what knows AV1; WebP loops, and can be
        transparent.
      </p>
      <p class="row">
        <Button
          label="Render and download"
          icon="film"
          text="Render and download"
          primary
          disabled={!chosenCamera(choice, view)}
          onClick={() => (void make(), onClose())}
        />
      </p>
    </Dialog>
  );
}
