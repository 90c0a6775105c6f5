/** Adjustment layers: sliders, tone curve and hues on all Gaussians or on those that are selected, previewed live. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { GradeSliders } from "../messages";
import { selectedCount } from "../paint/selection";
import { readOnly, selectedLayer, state } from "../state/store";
import { link, report, run } from "../state/studio";
import { Curve } from "./curve";
import { Button, Percent, Slider } from "./parts";

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

const sliders = signal<Full>(NEUTRAL);
const hue = signal(0);
let pending: Full | null = null;
let busy = false;
const plain = (values: Full) => JSON.stringify(values) === JSON.stringify(NEUTRAL);

/** Show the newest values; while the server works on one, those in between are skipped. */
async function preview(values: Full): Promise<void> {
  pending = values;
  if (busy) return;
  busy = true;
  try {
    while (pending) {
      const next: Full = pending;
      pending = null;
      await link.do("look.preview", { look: plain(next) ? null : next });
    }
  } catch (error) {
    report(error);
  } finally {
    busy = false;
  }
}

function change(part: Partial<Full>): void {
  sliders.value = { ...sliders.value, ...part };
  void preview(sliders.value);
}

export function resetSliders(): void {
  if (plain(sliders.value)) return;
  sliders.value = NEUTRAL;
  void preview(NEUTRAL);
}

async function commit(): Promise<void> {
  pending = null;
  const answer = await run("look.commit", { look: sliders.value, name: "Adjustment" }, "Adjustment");
  if (!answer) return;
  sliders.value = NEUTRAL;
  selectedLayer.value = answer.layer.id;
}

const AMOUNTS = [
  ["Exposure", "exposure", -3, 3],
  ["Temperature", "temperature", -1, 1],
  ["Tint", "tint", -1, 1],
  ["Contrast", "contrast", -1, 1],
  ["Saturation", "saturation", -1, 1],
] as const;

const BANDS = [
  ["Shift", "shift", 180, 1, "°"],
  ["Saturation", "saturation", 1, 0.01, ""],
  ["Lightness", "lightness", 1, 0.01, ""],
] as const;

export function Adjustments() {
  const chosen = state.value?.layers.find((layer) => layer.id === selectedLayer.value && layer.kind === "look");
  useEffect(() => resetSliders, []);
  const values = sliders.value;
  const band = values.hues.find((one) => one.hue === hue.value) ?? {
    hue: hue.value,
    width: 60,
    shift: 0,
    saturation: 0,
    lightness: 0,
  };
  const setBand = (part: Partial<typeof band>) =>
    change({ hues: [...values.hues.filter((one) => one.hue !== hue.value), { ...band, ...part }] });
  const neutral = plain(values);
  return (
    <div class="adjustments">
      {AMOUNTS.map(([label, key, min, max]) => (
        <Slider
          key={key}
          label={label}
          value={values[key]}
          min={min}
          max={max}
          digits={2}
          reset={0}
          disabled={readOnly.value}
          onInput={(v) => change({ [key]: v })}
        />
      ))}
      <h3>Tone curve</h3>
      <Curve points={values.curve} onChange={(curve) => change({ curve })} />
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
      {BANDS.map(([label, key, limit, step, unit]) => (
        <Slider
          key={key}
          label={label}
          value={band[key] ?? 0}
          min={-limit}
          max={limit}
          step={step}
          digits={step < 1 ? 2 : 0}
          unit={unit}
          reset={0}
          disabled={readOnly.value}
          onInput={(v) => setBand({ [key]: v })}
        />
      ))}
      <h3>Where</h3>
      <Percent
        label="Strength"
        value={values.strength}
        reset={1}
        disabled={readOnly.value}
        onInput={(strength) => change({ strength })}
      />
      {selectedCount.value > 0 && (
        <p class="quiet">Only what is selected ({selectedCount.value.toLocaleString()} Gaussians).</p>
      )}
      <p class="row actions">
        <Button
          label="Make it a layer"
          icon="check"
          text="Apply as layer"
          primary
          disabled={neutral || readOnly.value}
          onClick={() => void commit().catch(report)}
        />
        <Button label="All sliders to zero" text="Reset" disabled={neutral} onClick={resetSliders} />
        {chosen && (
          <Button
            label="Put these sliders into the chosen adjustment layer"
            text="Into layer"
            disabled={neutral || readOnly.value}
            onClick={() =>
              void run("layer.set", { layer: chosen.id, parameters: { ...values } }, `Changing ${chosen.name}`).then(
                resetSliders,
              )
            }
          />
        )}
      </p>
    </div>
  );
}
