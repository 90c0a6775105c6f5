/** What the bars of several tools show. */

import { signal } from "@preact/signals";

import { MAX_ANGLE_DEGREES, MAX_DEPTH_EDGE_PX } from "../paint/limits";
import { chosenMask } from "../paint/stroke-target";
import {
  brush,
  color,
  limits,
  method,
  paintMode,
  recentColors,
  setColor,
  spreading,
  state,
  tab,
  type PaintMode,
} from "../state/store";
import { BrushSize, KeepShading } from "../ui/brush-size";
import { Button, Check, Choice, Percent, Slider } from "../ui/parts";
import { OneSided, SymmetryButton } from "../ui/symmetry";

const MODES: readonly (readonly [PaintMode, string])[] = [
  ["normal", "Normal"],
  ["color", "Colour only"],
  ["darken", "Darken"],
  ["lighten", "Lighten"],
];
const METHODS = { auto: "Auto", ttt: "Network", corrected: "Corrected", lift: "Lift", fit: "Fit" } as const;
/** Whether the limits are being set. */
const limiting = signal(false);

/** Of tools whose dabs follow one another: size, hardness, opacity, flow. `shading`: paint may keep what is below it. */
export function BrushBar({ shading = false, mirrors = true }: { shading?: boolean; mirrors?: boolean }) {
  const b = brush.value;
  const set = (part: Partial<typeof b>) => (brush.value = { ...brush.value, ...part });
  return (
    <>
      <BrushSize />
      <Percent label="Hardness" value={b.hardness} onInput={(v) => set({ hardness: v })} />
      <Percent label="Opacity" value={b.opacity} min={0.01} onInput={(v) => set({ opacity: v })} />
      <Percent label="Flow" value={b.flow} min={0.01} onInput={(v) => set({ flow: v })} />
      {shading && <KeepShading />}
      {mirrors && <SymmetryButton />}
      <Button
        label="Tip, dabs, texture and smoothing of the brush"
        icon="brush"
        text="Tip"
        pressed={tab.value === "brush"}
        onClick={() => (tab.value = "brush")}
      />
    </>
  );
}

/** While the mask of a layer is painted: whose, and what the tool does to it. */
export function MaskHint({ shows }: { shows: boolean }) {
  const layer = chosenMask();
  if (!layer) return null;
  return (
    <>
      <OneSided why="masks are painted on this side only" />
      <span class="hint">
        Mask of {layer.name}: {shows ? "shows" : "hides"} it
      </span>
    </>
  );
}

export function PaintModes() {
  return (
    <Choice label="Mode" value={paintMode.value} options={MODES} onChange={(value) => (paintMode.value = value)} />
  );
}

export function RecentColors() {
  return (
    <span class="recent">
      {recentColors.value.slice(0, 6).map((value) => (
        <button
          type="button"
          key={value}
          aria-label={`Colour ${value}`}
          title={value}
          style={{ background: value }}
          aria-pressed={value === color.value}
          onClick={() => setColor(value)}
        />
      ))}
    </span>
  );
}

export function Methods() {
  const there = state.value?.methods ?? ["auto"];
  return (
    <Choice
      label="Method"
      value={method.value}
      options={there.map((key) => [key, METHODS[key]] as const)}
      onChange={(value) => (method.value = value)}
    />
  );
}

/** Paint that goes on over the material that it lies on. */
export function Spreading() {
  const s = spreading.value;
  const set = (part: Partial<typeof s>) => (spreading.value = { ...spreading.value, ...part });
  return (
    <>
      <Button
        label="Treat paint as a material, which changes all around; each stroke is a layer"
        text="Spread"
        pressed={s.on}
        onClick={() => set({ on: !s.on })}
      />
      {s.on && (
        <span class="group">
          <Percent label="Threshold" value={s.threshold} onInput={(threshold) => set({ threshold })} />
          <Check label="Show confidence" value={s.show} onChange={(show) => set({ show })} />
        </span>
      )}
    </>
  );
}

export function Limits() {
  const l = limits.value;
  const set = (part: Partial<typeof l>) => (limits.value = { ...limits.value, ...part });
  return (
    <>
      <Button
        label="Limits of what one view may paint"
        text="Limits"
        pressed={limiting.value}
        onClick={() => (limiting.value = !limiting.value)}
      />
      {limiting.value && (
        <span class="group">
          <Slider
            label="Angle limit"
            value={l.angle}
            min={0}
            max={MAX_ANGLE_DEGREES}
            step={1}
            unit="°"
            reset={80}
            onInput={(angle) => set({ angle: Math.round(angle) })}
          />
          <Slider
            label="Depth-edge limit"
            value={l.depthEdge}
            min={0}
            max={MAX_DEPTH_EDGE_PX}
            step={1}
            unit=" px"
            reset={0}
            onInput={(depthEdge) => set({ depthEdge: Math.round(depthEdge) })}
          />
          <Check label="Show what will not be painted" value={l.show} onChange={(show) => set({ show })} />
        </span>
      )}
    </>
  );
}
