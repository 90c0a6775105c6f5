/** Settings of mirrored strokes. */

import { run } from "../editor/editor";
import { assetPlane, symmetry, type PlaneChoice } from "../paint/symmetry";
import { mirroring } from "../paint/view-surface";
import { readOnly, state } from "../state/store";
import type { Vec3 } from "../view/camera";
import { Button, Check, Choice, Slider } from "./parts";

const PLANES: readonly (readonly [PlaneChoice, string])[] = [
  ["found", "From the asset"],
  ["x", "X"],
  ["y", "Y"],
  ["z", "Z"],
];
const POOR = 0.6;

/** Switch it on or off; the plane is looked for when it is first needed. */
async function toggleSymmetry(on: boolean): Promise<void> {
  symmetry.value = { ...symmetry.value, on };
  mirroring.value = on;
  const now = state.value;
  if (!on || !now || symmetry.value.plane !== "found" || assetPlane.value?.session === now.session) return;
  const answer = await run("symmetry.find", {}, "Plane of symmetry");
  if (!answer) {
    // Another plane may have been chosen since.
    if (symmetry.value.plane === "found") symmetry.value = { ...symmetry.value, plane: "x" };
    return;
  }
  const { normal, offset, agreement } = answer;
  assetPlane.value = { session: now.session, plane: { normal: normal as Vec3, offset }, agreement };
}

export function SymmetryButton() {
  const { on } = symmetry.value;
  return (
    <Button
      label={on ? "Paint on this side only" : "Mirror strokes to the other side of the asset"}
      icon="compare"
      text="Symmetry"
      pressed={on}
      disabled={readOnly.value || !state.value}
      onClick={() => void toggleSymmetry(!on)}
    />
  );
}

/** Said in the bar of a tool that works on one side only while strokes are mirrored. */
export function OneSided({ why }: { why: string }) {
  if (!symmetry.value.on) return null;
  return <span class="hint">Symmetry: {why}</span>;
}

export function SymmetryPanel() {
  const s = symmetry.value;
  const set = (part: Partial<typeof s>) => (symmetry.value = { ...symmetry.value, ...part });
  const measured = assetPlane.value?.session === state.value?.session ? assetPlane.value : null;
  const choose = (plane: PlaneChoice) => {
    set({ plane, shift: 0, angle: 0, lean: 0 });
    void toggleSymmetry(true);
  };
  return (
    <>
      <h3>Symmetry</h3>
      <Check label="Mirror strokes" value={s.on} disabled={readOnly.value} onChange={(on) => void toggleSymmetry(on)} />
      {s.on && (
        <>
          <Choice label="Plane" value={s.plane} options={PLANES} onChange={choose} />
          {s.plane === "found" && measured && (
            <p class="quiet">
              {measured.agreement < POOR
                ? "The asset is hardly symmetric: check where mirrored strokes land."
                : `The asset matches its mirror image to ${Math.round(100 * measured.agreement)} %.`}
            </p>
          )}
          <Slider
            label="Shift"
            value={s.shift * 100}
            min={-60}
            max={60}
            step={0.2}
            digits={1}
            unit=" %"
            reset={0}
            onInput={(v) => set({ shift: v / 100 })}
          />
          <Slider
            label="Turn"
            value={s.angle}
            min={-90}
            max={90}
            step={0.5}
            digits={1}
            unit="°"
            reset={0}
            onInput={(angle) => set({ angle })}
          />
          <Slider
            label="Lean"
            value={s.lean}
            min={-90}
            max={90}
            step={0.5}
            digits={1}
            unit="°"
            reset={0}
            onInput={(lean) => set({ lean })}
          />
        </>
      )}
    </>
  );
}
