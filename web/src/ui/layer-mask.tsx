/** The mask of the chosen layer: painted, from the selection, or by a rule. */

import { signal } from "@preact/signals";

import type { LayerInfo, MaskInfo, MaskSet } from "../messages";
import { selectedCount, selectionSent } from "../paint/selected";
import { duringLayer } from "../state/pending-layers";
import { maskedLayer, maskShows, readOnly, selectedLayer, state } from "../state/store";
import { run } from "../editor/editor";
import { takeMaskTool } from "../tools";
import { Button, Choice, Slider } from "./parts";

/** Whether the settings of masks are open. */
export const maskOpen = signal(false);

type RuleName = "height" | "slope" | "coverage" | "curvature";
const RULES: Record<RuleName, { label: string; min?: number; max: number; step: number; unit: string; scale: number }> =
  {
    height: { label: "Height", max: 100, step: 1, unit: " %", scale: 0.01 },
    slope: { label: "Angle from upright", max: 180, step: 1, unit: "°", scale: 1 },
    coverage: { label: "Coverage", max: 2, step: 1, unit: "", scale: 1 },
    curvature: { label: "Edges and crevices", min: -90, max: 90, step: 1, unit: "°", scale: 1 },
  };
const SHOWS = [
  ["hide", "Hide"],
  ["show", "Show"],
] as const;
/** What coverage can be (session/document/layer_mask.py), as ranges "low high". */
const COVERAGES = [
  ["0 0", "As in the original"],
  ["1 1", "Seen by an edited view"],
  ["2 2", "Predicted"],
  ["1 2", "Seen or predicted"],
] as const;
interface ChosenRule {
  name: RuleName;
  low: number;
  high: number;
  soft: number;
  /** Changes of its sliders are one step of the history. */
  gesture: string;
}
/** Layer (`keyOf`) -> the rule that its mask got here last: its sliders are there when the layer is chosen again. */
const rules = signal<ReadonlyMap<string, ChosenRule>>(new Map());

const set = (layer: LayerInfo, fields: Omit<MaskSet, "layer">) =>
  run("layer.mask", { layer: layer.id, ...fields }, `Mask of ${layer.name}`);

const enable = (layer: LayerInfo, mask: MaskInfo, enabled: boolean) =>
  duringLayer(layer.id, { mask: { ...mask, enabled } }, set(layer, { mask: enabled ? "on" : "off" }));

/** Paint the layer's mask with the brush from now on, or stop. */
export async function paintMask(layer: LayerInfo): Promise<void> {
  if (maskedLayer.value === layer.id) {
    maskedLayer.value = null;
    return;
  }
  if (!layer.mask && !(await set(layer, { mask: "reveal" }))) return;
  selectedLayer.value = layer.id;
  maskedLayer.value = layer.id;
  takeMaskTool();
}

async function fromSelection(layer: LayerInfo): Promise<void> {
  await selectionSent();
  await set(layer, { mask: "selection" });
}

const keyOf = (layer: LayerInfo): string => `${state.peek()?.session} ${layer.id}`;

const newGesture = (): string => `rule ${Math.random().toString(36).slice(2)}`;

/** Set the rule, and apply it when its sliders are let go. */
function byRule(layer: LayerInfo, part: Partial<ChosenRule>, end: boolean): void {
  const first: ChosenRule = { name: "height", low: 0, high: 1, soft: 0, gesture: newGesture() };
  const next = { ...first, ...rules.value.get(keyOf(layer)), ...part };
  rules.value = new Map(rules.value).set(keyOf(layer), next);
  if (!end) return;
  const { name, low, high, soft, gesture } = next;
  const { scale } = RULES[name];
  const values = { low: Math.min(low, high) * scale, high: Math.max(low, high) * scale, soft: soft * scale };
  if (name === "curvature") {
    // the ends of the sliders are open: few places bend further
    if (values.low === RULES.curvature.min) values.low = -180;
    if (values.high === RULES.curvature.max) values.high = 180;
  }
  const mask = layer.mask ?? { enabled: true, shows: false, parts: 1 };
  void duringLayer(layer.id, { mask }, set(layer, { mask: name, ...values, gesture }));
}

function forgetRule(layer: LayerInfo): void {
  const rest = new Map(rules.value);
  rest.delete(keyOf(layer));
  rules.value = rest;
}

export function LayerMask({ layer }: { layer: LayerInfo | null }) {
  if (!maskOpen.value || !layer) return null;
  const off = readOnly.value;
  const mask = layer.mask;
  const r = mask && rules.value.get(keyOf(layer));
  const measure = r && RULES[r.name];
  const painting = mask !== null && maskedLayer.value === layer.id;
  return (
    <div class="layer-mask" role="group" aria-label={`Mask of ${layer.name}`}>
      <p class="row">
        <Button
          label="Paint the mask with the brush"
          icon="brush"
          text="Paint"
          pressed={painting}
          disabled={off}
          onClick={() => void paintMask(layer)}
        />
        <Choice
          label="Brush"
          value={maskShows.value ? "show" : "hide"}
          options={SHOWS}
          disabled={!painting}
          onChange={(value) => (maskShows.value = value === "show")}
        />
      </p>
      <p class="row">
        <Button
          label="Show all of the layer"
          text="Show all"
          disabled={off}
          onClick={() => void set(layer, { mask: "reveal" })}
        />
        <Button
          label="Hide all of the layer"
          text="Hide all"
          disabled={off}
          onClick={() => void set(layer, { mask: "hide" })}
        />
        <Button
          label="Show the layer only in the selection"
          text="Selection"
          disabled={off || selectedCount.value === 0}
          onClick={() => void fromSelection(layer)}
        />
      </p>
      <p class="row">
        <Choice
          label="Rule"
          value={r?.name ?? ""}
          options={[
            ...(r ? [] : ([["", "None"]] as const)),
            ...(Object.keys(RULES) as RuleName[]).map((name) => [name, RULES[name].label] as const),
          ]}
          disabled={off}
          onChange={(name) => {
            if (!name) return;
            const gesture = newGesture();
            const { max } = RULES[name];
            // edges: what bends outwards
            if (name === "curvature") return byRule(layer, { name, low: 12, high: max, soft: 8, gesture }, true);
            const high = name === "coverage" ? 0 : max / 2;
            byRule(layer, { name, low: 0, high, soft: 0, gesture }, true);
          }}
        />
        {mask && (
          <>
            <Button
              label={mask.enabled ? "Disable the mask" : "Enable the mask"}
              text={mask.enabled ? "Off" : "On"}
              disabled={off}
              onClick={() => void enable(layer, mask, !mask.enabled)}
            />
            <Button
              label="Remove the mask"
              text="Remove"
              disabled={off}
              onClick={() => (forgetRule(layer), void set(layer, { mask: "remove" }))}
            />
          </>
        )}
      </p>
      {r?.name === "coverage" && (
        <p class="row">
          <Choice
            label="Shows"
            value={`${r.low} ${r.high}`}
            options={COVERAGES}
            disabled={off}
            onChange={(range) => {
              const [low, high] = range.split(" ").map(Number);
              byRule(layer, { low, high }, true);
            }}
          />
        </p>
      )}
      {r &&
        measure &&
        r.name !== "coverage" &&
        (["low", "high", "soft"] as const).map((key) => (
          <Slider
            key={key}
            label={{ low: "From", high: "To", soft: "Soft" }[key]}
            value={r[key]}
            min={key === "soft" ? 0 : (measure.min ?? 0)}
            max={measure.max}
            step={measure.step}
            unit={measure.unit}
            disabled={off}
            onInput={(v) => byRule(layer, { [key]: Math.round(v) }, false)}
            onChange={(v) => byRule(layer, { [key]: Math.round(v) }, true)}
          />
        ))}
    </div>
  );
}
