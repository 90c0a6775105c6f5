/** Settings of the brush that the bar of every tool with one shows: its size with its unit, the shading that it keeps. */

import {
  engine,
  keepShading,
  MAX_SIZE_PX,
  MAX_WORLD_SHARE,
  MIN_SIZE_PX,
  MIN_WORLD_SHARE,
  setEngine,
  setKeepShading,
} from "../paint/brush-settings";
import { brush, pose, state } from "../state/store";
import { Choice, Percent, Slider } from "./parts";

const UNITS = [
  ["screen", "px"],
  ["world", "world"],
] as const;

/** World units per pixel of the screen at the point that the view turns around. */
function unitsPerPixel(): number {
  const now = pose.value;
  const height = document.getElementById("stage")?.clientHeight ?? 0;
  return now && height ? (2 * now.distance * Math.tan((now.fov * Math.PI) / 360)) / height : 1;
}

/** The same brush in the other unit. */
function choose(unit: "screen" | "world"): void {
  if (unit === engine.value.unit) return;
  const scale = unitsPerPixel();
  if (unit === "screen") {
    const size = Math.max(MIN_SIZE_PX, Math.min(MAX_SIZE_PX, engine.value.worldSize / scale));
    brush.value = { ...brush.value, size };
    setEngine({ unit });
  } else setEngine({ unit, worldSize: brush.value.size * scale });
}

export function BrushSize() {
  const { unit, worldSize } = engine.value;
  const radius = state.value?.asset.radius ?? 1;
  const digits = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(radius))));
  return (
    <>
      {unit === "screen" ? (
        <Slider
          label="Size"
          value={brush.value.size}
          min={MIN_SIZE_PX}
          max={MAX_SIZE_PX}
          log
          digits={0}
          onInput={(size) => (brush.value = { ...brush.value, size })}
        />
      ) : (
        <Slider
          label="Size"
          value={worldSize}
          min={MIN_WORLD_SHARE * radius}
          max={MAX_WORLD_SHARE * radius}
          log
          digits={digits}
          onInput={(size) => setEngine({ worldSize: size })}
        />
      )}
      <span class="bare-choice">
        <Choice label="Unit of the size" value={unit} options={UNITS} onChange={choose} />
      </span>
    </>
  );
}

export function KeepShading() {
  return (
    <span title="How much of the light, shade and fine relief stays under the paint">
      <Percent label="Keep shading" value={keepShading.value} onInput={setKeepShading} />
    </span>
  );
}
