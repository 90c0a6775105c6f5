/** The brush in full: presets, tip, dabs, texture, hand. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { download, pixelsOf } from "../net/blobs";
import {
  BUILT_IN_PRESETS,
  currentPreset,
  engine,
  parsePresets,
  presetsText,
  setEngine,
  takePreset,
  type Engine,
  type Preset,
} from "../paint/brush-settings";
import { DabPath, roundFrame, type Brush } from "../paint/dabs";
import { emptyMask, type Mask } from "../paint/raster";
import {
  builtInTip,
  BUILT_IN_TIPS,
  grainAt,
  MAX_TIP_PICTURE_PX,
  TEXTURES,
  textureTile,
  tipOfPicture,
  TIP_PX,
  withHalves,
  type BuiltInTip,
} from "../paint/tips";
import { presets } from "../state/remembered";
import { brush, toast } from "../state/store";
import { report } from "../editor/editor";
import { SymmetryPanel } from "./symmetry";
import { Button, Check, Choice, FileButton, Percent, Slider } from "./parts";

const naming = signal("");
const SAMPLE = { width: 120, height: 34 };

/** A stroke of the brush, as small as a list shows it. */
function sampleOf({ size, hardness, flow, engine: e }: Preset, canvas: HTMLCanvasElement): void {
  const { width, height } = SAMPLE;
  const mask = emptyMask(width, height);
  const radius = Math.max(1.2, Math.min(size / 2, 4 + size / 11, 11));
  const sample: Brush = {
    ...e,
    hardness,
    flow,
    tip:
      e.tip === "picture"
        ? e.picture &&
          withHalves(
            TIP_PX,
            Float32Array.from(e.picture, (v) => v / 255),
          )
        : builtInTip(e.tip),
    frame: () => roundFrame(radius),
    pressureSize: true,
    pressureFlow: false,
    seed: 1,
  };
  const path = new DabPath(mask, sample);
  const at = (t: number) => ({
    x: 12 + t * (width - 24),
    y: height / 2 - 7 * Math.sin(t * 2 * Math.PI),
    pressure: Math.sin(Math.PI * (0.12 + 0.76 * t)),
  });
  path.down(at(0));
  for (let k = 1; k <= 40; k++) path.move(at(k / 40));
  path.up();
  const tile = textureTile(e.texture);
  const grain = (k: number): number =>
    tile ? grainAt(tile, k % width, Math.floor(k / width), 0.5 * e.textureScale, e.textureDepth) : 1;
  show(mask, canvas, grain);
}

/** Draw a mask in the colour of text. grain: a factor of each pixel. */
function show(mask: Mask, canvas: HTMLCanvasElement, grain: (k: number) => number = () => 1): void {
  const image = new ImageData(mask.width, mask.height);
  const { data } = image;
  for (let k = 0; k < mask.data.length; k++) {
    [data[k * 4], data[k * 4 + 1], data[k * 4 + 2]] = [230, 231, 234];
    if (mask.data[k] > 0) data[k * 4 + 3] = mask.data[k] * grain(k) * 255;
  }
  canvas.getContext("2d")!.putImageData(image, 0, 0);
}

function Sample({ preset }: { preset: Preset }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => sampleOf(preset, canvas.current!), [preset]);
  return <canvas ref={canvas} {...SAMPLE} aria-hidden="true" />;
}

function TipPicture({ name }: { name: BuiltInTip }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const mask = emptyMask(32, 32);
    const plain = { ...currentPreset("").engine, angle: 0, roundness: 1, sizeJitter: 0, angleJitter: 0, scatter: 0 };
    const preview = { ...plain, opacityJitter: 0, alongPath: false, hardness: 0.6, flow: 1, pressureSize: false };
    const tip = builtInTip(name);
    new DabPath(mask, { ...preview, pressureFlow: false, tip, frame: () => roundFrame(14), seed: 1 }).down({
      x: 16,
      y: 16,
      pressure: 1,
    });
    show(mask, canvas.current!);
  }, [name]);
  return <canvas ref={canvas} width={32} height={32} aria-hidden="true" />;
}

async function choosePicture(file: File): Promise<void> {
  const full = await pixelsOf(file).catch(() => null);
  if (!full) return toast("warning", `${file.name} is not a picture that this browser reads.`);
  const factor = Math.min(1, MAX_TIP_PICTURE_PX / Math.max(full.width, full.height));
  const small =
    factor < 1
      ? await pixelsOf(
          file,
          Math.max(1, Math.round(full.width * factor)),
          Math.max(1, Math.round(full.height * factor)),
        )
      : full;
  const picture = Uint8Array.from(tipOfPicture(small), (v) => Math.round(v * 255));
  if (!picture.some((v) => v > 12))
    return toast(
      "warning",
      `${file.name} has nothing dark or opaque to make a tip of.`,
      "What is dark becomes the tip; in a picture with transparency, what is opaque.",
    );
  setEngine({ tip: "picture", picture, spacing: Math.max(engine.value.spacing, 0.25) });
}

function save(): void {
  const name = naming.value.trim().slice(0, 60) || `Brush ${presets.value.length + 1}`;
  presets.value = [...presets.value.filter((one) => one.name !== name), currentPreset(name)].slice(-200);
  naming.value = "";
}

async function load(file: File): Promise<void> {
  const added = parsePresets(await file.text());
  const names = new Set(added.map((one) => one.name));
  presets.value = [...presets.value.filter((one) => !names.has(one.name)), ...added].slice(-200);
  toast("info", `${added.length} ${added.length === 1 ? "brush" : "brushes"} added`);
}

function exportAll(): void {
  const url = URL.createObjectURL(new Blob([presetsText(presets.value)], { type: "application/json" }));
  download(url, "brushes.json");
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

const NAMED = Object.entries as <T extends string>(names: Record<T, string>) => [T, string][];

/** A slider of the engine. */
function Amount({ label, name, min = 0, max = 1 }: { label: string; name: keyof Engine; min?: number; max?: number }) {
  const value = engine.value[name] as number;
  return (
    <Slider
      label={label}
      value={value * 100}
      min={min * 100}
      max={max * 100}
      unit=" %"
      onInput={(v) => setEngine({ [name]: v / 100 })}
    />
  );
}

export function BrushPanel() {
  const e = engine.value;
  const b = brush.value;
  return (
    <div class="brush-panel">
      <ul class="presets" aria-label="Brushes">
        {[...BUILT_IN_PRESETS, ...presets.value].map((one, k) => (
          <li key={one.name + k}>
            <button type="button" title={one.name} onClick={() => takePreset(one)}>
              <Sample preset={one} />
              <span>{one.name}</span>
            </button>
            {k >= BUILT_IN_PRESETS.length && (
              <Button
                icon="close"
                label={`Delete ${one.name}`}
                onClick={() => (presets.value = presets.value.filter((other) => other !== one))}
              />
            )}
          </li>
        ))}
      </ul>
      <p class="row">
        <input
          type="text"
          aria-label="Name of the brush"
          placeholder="Name"
          value={naming.value}
          onInput={(event) => (naming.value = event.currentTarget.value)}
          onKeyDown={(event) => {
            event.stopPropagation();
            if (event.key === "Enter") save();
          }}
        />
        <Button label="Save this brush under this name, in this browser" icon="plus" onClick={save} />
        <Button
          label="Save your brushes to a file"
          icon="save"
          disabled={presets.value.length === 0}
          onClick={exportAll}
        />
        <FileButton
          label="Load brushes from a file"
          icon="open"
          bare
          accept=".json,application/json"
          onFiles={([file]) => file && void load(file).catch(report)}
        />
      </p>
      <h3>Tip</h3>
      <div class="tips" role="group" aria-label="Tip">
        {NAMED(BUILT_IN_TIPS).map(([key, name]) => (
          <button
            type="button"
            key={key}
            title={name}
            aria-label={name}
            aria-pressed={e.tip === key}
            onClick={() => setEngine({ tip: key })}
          >
            <TipPicture name={key} />
          </button>
        ))}
        <FileButton
          label="A picture as tip"
          icon="stamp"
          bare
          accept="image/*"
          onFiles={([file]) => file && void choosePicture(file).catch(report)}
        />
        {e.tip === "picture" && <span class="quiet">A picture</span>}
      </div>
      {e.tip === "round" && (
        <Percent
          label="Hardness"
          value={b.hardness}
          onInput={(hardness) => (brush.value = { ...brush.value, hardness })}
        />
      )}
      <Slider
        label="Angle"
        value={e.angle}
        min={-180}
        max={180}
        step={1}
        unit="°"
        reset={0}
        onInput={(angle) => setEngine({ angle })}
      />
      <Amount label="Roundness" name="roundness" min={0.05} />
      <Check label="Turns with the stroke" value={e.alongPath} onChange={(alongPath) => setEngine({ alongPath })} />
      <Check label="Follows the surface" value={e.follow} onChange={(follow) => setEngine({ follow })} />
      <h3>Dabs</h3>
      <Slider
        label="Spacing"
        value={e.spacing * 100}
        min={1}
        max={300}
        log
        unit=" %"
        reset={10}
        onInput={(v) => setEngine({ spacing: v / 100 })}
      />
      <Amount label="Size jitter" name="sizeJitter" />
      <Amount label="Opacity jitter" name="opacityJitter" />
      <Amount label="Angle jitter" name="angleJitter" />
      <Amount label="Scatter" name="scatter" />
      <h3>Texture</h3>
      <Choice
        label="Texture"
        value={e.texture}
        options={NAMED(TEXTURES)}
        onChange={(texture) => setEngine({ texture })}
      />
      {e.texture !== "none" && (
        <>
          <Slider
            label="Scale"
            value={e.textureScale * 100}
            min={25}
            max={800}
            log
            unit=" %"
            reset={100}
            onInput={(v) => setEngine({ textureScale: v / 100 })}
          />
          <Amount label="Depth" name="textureDepth" />
        </>
      )}
      <SymmetryPanel />
      <h3>Smoothing</h3>
      <Amount label="Steadiness" name="stabiliser" />
      <Check
        label="Pressure: size"
        value={b.pressureSize}
        onChange={(pressureSize) => (brush.value = { ...brush.value, pressureSize })}
      />
      <Check
        label="Pressure: flow"
        value={b.pressureFlow}
        onChange={(pressureFlow) => (brush.value = { ...brush.value, pressureFlow })}
      />
    </div>
  );
}
