/**
 * Adjustment layers on all Gaussians or on those that are selected, previewed live: sliders, tone curve and hues; or
 * colours from elsewhere, of a LUT, of a picture, or one new colour. Where a layer of sliders is chosen, they are its own.
 */

import { computed, signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { type ColorTransfer, type GradeSliders, type LayerInfo, RANGES } from "../messages";
import { sendBlob } from "../net/blobs";
import { selectedCount } from "../paint/selected";
import { dragged, shownLayers } from "../state/pending-layers";
import { pendingStrokes, readOnly, selectedLayer, state } from "../state/store";
import { editor, report, run } from "../editor/editor";
import { drafts, DraftSteps } from "../state/draft-steps";
import { NewestOnly } from "../state/newest-only";
import { Curve } from "./curve";
import { Button, FileButton, Percent, Slider } from "./parts";

type Full = Required<GradeSliders>;
const NEUTRAL: Full = {
  exposure: 0,
  temperature: 0,
  tint: 0,
  contrast: 0,
  saturation: 0,
  curve: [],
  hues: [],
  strength: 1,
};
const HUES = [
  ["Reds", 0],
  ["Yellows", 60],
  ["Greens", 120],
  ["Cyans", 180],
  ["Blues", 240],
  ["Magentas", 300],
] as const;

/** Width of the band that is all hues alike. */
const [, ALL_HUES] = RANGES.HueSliders.width;

const sliders = signal<Full>(NEUTRAL);
/** Colours from elsewhere, in place of the sliders, and what they are called. */
const transfer = signal<{ colors: ColorTransfer; name: string } | null>(null);
const hue = signal(0);

type DraftLook = { sliders: Full; transfer: { colors: ColorTransfer; name: string } | null };
const draftLook = (): DraftLook => ({ sliders: sliders.value, transfer: transfer.value });
/** Changes of the layer to come, for undo. */
const draftSteps = new DraftSteps<DraftLook>();
/** After what they were made: what was done since is taken back before them. */
const draftAt = signal("");
/** The layer to come is about to be changed. */
function noteDraft(): void {
  if (!gesture.noted) draftSteps.note(draftLook());
  gesture.noted = true;
  draftAt.value = latest();
}
/** Names the newest step of the history, and of the selection. */
function latest(): string {
  const now = state.value;
  return now ? `${now.project.id} ${now.history[now.cursor]?.id} ${now.selection.undo}` : "";
}

/** The chosen layer whose sliders these are; null: they are of a layer to come. */
const gradeLayer = computed<LayerInfo | null>(() => {
  if (transfer.value) return null;
  const isGrade = ({ kind, parameters }: LayerInfo) => kind === "look" && parameters.look === "grade";
  return shownLayers.value.find((one) => one.id === selectedLayer.value && isGrade(one)) ?? null;
});
/** Of that layer or of the one to come. */
const values = computed<Full>(() => {
  const layer = gradeLayer.value;
  if (!layer) return sliders.value;
  const names = Object.keys(NEUTRAL) as (keyof Full)[];
  return Object.fromEntries(names.map((name) => [name, layer.parameters[name] ?? NEUTRAL[name]])) as Full;
});
/** What a press or a key begins on the sliders is a step of its own. noted: it is one of the layer to come. */
const gesture: { layer: string; send: ReturnType<typeof dragged> | null; noted: boolean } = {
  ...{ layer: "", send: null, noted: false },
};
function beginGesture(): void {
  gesture.send = null;
  gesture.noted = false;
}

const plain = (values: Full) => JSON.stringify(values) === JSON.stringify(NEUTRAL);

interface Previewed {
  values: Full;
  colors: ColorTransfer | null;
}
/** While the server works on one, those in between are skipped. */
const previews = new NewestOnly<Previewed>(async ({ values, colors }) => {
  const fields = colors ? { transfer: colors } : { look: plain(values) ? null : values };
  await editor.link.do("look.preview", fields).catch(report);
});

/** Show the newest values. */
function preview(): void {
  const { strength } = sliders.value;
  const colors = transfer.value && { ...transfer.value.colors, strength };
  void previews.add({ values: sliders.value, colors });
}

function change(part: Partial<Full>): void {
  const layer = gradeLayer.value;
  if (layer) {
    if (gesture.layer !== layer.id) beginGesture();
    gesture.layer = layer.id;
    gesture.send ??= dragged(layer.id, `Changing ${layer.name}`);
    void gesture.send({ parameters: { ...values.value, ...part } });
    return;
  }
  noteDraft();
  sliders.value = { ...sliders.value, ...part };
  preview();
}

function showDraft(next: DraftLook | null): void {
  if (!next) return resetDraft();
  sliders.value = next.sliders;
  transfer.value = next.transfer;
  preview();
}

const isNeutral = (): boolean => plain(sliders.value) && !transfer.value;
const isNewest = (): boolean => gradeLayer.value === null && draftAt.value === latest() && pendingStrokes.value === 0;
drafts.push({
  canBack: () => !isNeutral() && isNewest(),
  back: () => showDraft(draftSteps.back(draftLook())),
  canAgain: () => draftSteps.canAgain && isNewest(),
  again: () => showDraft(draftSteps.again(draftLook())),
});

/** Leave the layer to come. */
function resetDraft(): void {
  draftSteps.forget();
  if (isNeutral()) return;
  sliders.value = NEUTRAL;
  transfer.value = null;
  preview();
}

/** The next adjustment is a layer of its own. */
const anotherAdjustment = (): void => void (selectedLayer.value = null);

/** Colours from elsewhere take the place of the sliders, for a layer of its own. */
function take(colors: ColorTransfer, name: string): void {
  beginGesture();
  noteDraft();
  sliders.value = { ...NEUTRAL, strength: sliders.value.strength };
  transfer.value = { colors, name };
  preview();
}

async function takeFile(kind: "lut" | "match", file: File | undefined): Promise<void> {
  if (file) take({ kind, file: await sendBlob(file, file.name) }, file.name);
}

async function commit(): Promise<void> {
  previews.skip();
  const sent = sliders.value;
  const given = transfer.value;
  const look = given ? { transfer: { ...given.colors, strength: sent.strength } } : { look: sent };
  const name = given?.name.slice(0, 100) ?? "Adjustment";
  const answer = await run("look.commit", { ...look, name }, name);
  // What else was taken from elsewhere meanwhile is for the next layer.
  if (!answer || transfer.value !== given) return;
  const newest = sliders.value;
  sliders.value = NEUTRAL;
  transfer.value = null;
  draftSteps.forget();
  beginGesture();
  selectedLayer.value = answer.layer.id;
  if (!given && newest !== sent) change(newest);
}

/** Of the stops that are possible, those that a slider of this width can be set to a tenth of. */
const EXPOSURE_RANGE = [-3, 3] as const;
const AMOUNTS = [
  ["Exposure", "exposure", EXPOSURE_RANGE],
  ["Temperature", "temperature", RANGES.GradeSliders.temperature],
  ["Tint", "tint", RANGES.GradeSliders.tint],
  ["Contrast", "contrast", RANGES.GradeSliders.contrast],
  ["Saturation", "saturation", RANGES.GradeSliders.saturation],
] as const;

/** A turn further is the same hue again from the other side. */
const SHIFT_RANGE = [-180, 180] as const;
const BANDS = [
  ["Shift", "shift", SHIFT_RANGE, 1, "°"],
  ["Saturation", "saturation", RANGES.HueSliders.saturation, 0.01, ""],
  ["Lightness", "lightness", RANGES.HueSliders.lightness, 0.01, ""],
] as const;

export function Adjustments() {
  const chosen = gradeLayer.value;
  useEffect(() => resetDraft, []);
  useEffect(() => {
    if (chosen) resetDraft(); // its preview ends
  }, [chosen?.id]);
  const now = values.value;
  const given = transfer.value;
  const single = now.hues.filter((one) => one.width !== ALL_HUES);
  const all = now.hues.filter((one) => one.width === ALL_HUES);
  const band = single.find((one) => one.hue === hue.value) ?? {
    hue: hue.value,
    width: 60,
    shift: 0,
    saturation: 0,
    lightness: 0,
  };
  const setBand = (part: Partial<typeof band>) =>
    change({ hues: [...all, ...single.filter((one) => one.hue !== hue.value), { ...band, ...part }] });
  const turn = (shift: number) => change({ hues: [...(shift ? [{ hue: 0, width: ALL_HUES, shift }] : []), ...single] });
  const neutral = plain(now) && !given;
  const off = readOnly.value || given !== null;
  return (
    <div
      class="adjustments"
      onPointerDownCapture={beginGesture}
      onKeyDownCapture={(event) => !event.repeat && beginGesture()}
    >
      {chosen && (
        <p class="row">
          <b>{chosen.name}</b>
          <Button
            icon="plus"
            label="Another adjustment, as a layer of its own"
            disabled={readOnly.value}
            onClick={anotherAdjustment}
          />
        </p>
      )}
      {AMOUNTS.map(([label, key, [min, max]]) => (
        <Slider
          key={key}
          label={label}
          value={now[key]}
          min={min}
          max={max}
          digits={2}
          reset={0}
          disabled={off}
          onInput={(v) => change({ [key]: v })}
        />
      ))}
      <Slider
        label="Hue"
        value={all[0]?.shift ?? 0}
        min={SHIFT_RANGE[0]}
        max={SHIFT_RANGE[1]}
        step={1}
        unit="°"
        reset={0}
        disabled={off}
        onInput={turn}
      />
      <h3>Tone curve</h3>
      <Curve points={now.curve} onChange={(curve) => change({ curve })} />
      <h3>Hues</h3>
      <span class="hues" role="group" aria-label="Range of hues">
        {HUES.map(([name, at]) => (
          <button
            type="button"
            key={name}
            title={name}
            aria-label={name}
            aria-pressed={hue.value === at}
            style={{ background: `hsl(${at} 65% 50%)` }}
            onClick={() => (hue.value = at)}
          />
        ))}
      </span>
      {BANDS.map(([label, key, [min, max], step, unit]) => (
        <Slider
          key={key}
          label={label}
          value={band[key] ?? 0}
          min={min}
          max={max}
          step={step}
          digits={step < 1 ? 2 : 0}
          unit={unit}
          reset={0}
          disabled={off}
          onInput={(v) => setBand({ [key]: v })}
        />
      ))}
      <h3>From elsewhere</h3>
      {given ? (
        <p class="row">
          <span role="status">{given.name} in place of the sliders</span>
          <Button icon="close" label={`Remove ${given.name}`} onClick={resetDraft} />
        </p>
      ) : (
        <>
          <p class="row">
            <FileButton
              label="LUT (.cube)"
              accept=".cube"
              disabled={readOnly.value}
              onFiles={(files) => void takeFile("lut", files[0]).catch(report)}
            />
            <FileButton
              label="Match a picture"
              accept="image/png,image/jpeg,image/webp"
              disabled={readOnly.value}
              onFiles={(files) => void takeFile("match", files[0]).catch(report)}
            />
          </p>
          <p class="row">
            <label class="choice">
              <span>One new colour</span>
              <input
                type="color"
                aria-label="One new colour"
                value="#2040a0"
                disabled={readOnly.value}
                onChange={({ currentTarget: { value } }) => take({ kind: "recolor", color: value }, `Colour ${value}`)}
              />
            </label>
          </p>
        </>
      )}
      <h3>Where</h3>
      <Percent
        label="Strength"
        value={now.strength}
        reset={1}
        disabled={readOnly.value}
        onInput={(strength) => change({ strength })}
      />
      {!chosen && selectedCount.value > 0 && (
        <p class="quiet">Only what is selected ({selectedCount.value.toLocaleString()} Gaussians).</p>
      )}
      <p class="row actions">
        {!chosen && (
          <Button
            label="Make it a layer"
            icon="check"
            text="Apply as layer"
            primary
            disabled={neutral || readOnly.value}
            onClick={() => void commit().catch(report)}
          />
        )}
        <Button
          label="All sliders to zero"
          text="Reset"
          disabled={neutral || readOnly.value}
          onClick={() => (chosen ? change(NEUTRAL) : resetDraft())}
        />
      </p>
    </div>
  );
}
