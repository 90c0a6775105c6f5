/** Which pixels and which background a picture or a turntable gets: the same choices for both. */

import { signal, type Signal } from "@preact/signals";

import { rgb } from "../state/store";
import type { CameraJson } from "../view/camera";
import { Choice } from "./parts";

export const MIN_SIDE_PX = 16;
export const MAX_SIDE_PX = 8192;
/** Of the server: 4096 x 4096. */
export const MAX_PIXELS = 1 << 24;

const SIZES = [
  ["view", "As on the screen"],
  ["1080x1080", "Square (1080)"],
  ["1920x1080", "Full HD (1920 x 1080)"],
  ["1080x1920", "Upright (1080 x 1920)"],
  ["3840x2160", "4K (3840 x 2160)"],
  ["double", "Twice the screen"],
  ["custom", "Other"],
] as const;
type SizeName = (typeof SIZES)[number][0];

/** What was chosen, kept while the page is open. */
export interface FrameChoice {
  size: Signal<SizeName>;
  width: Signal<string>;
  height: Signal<string>;
  background: Signal<string>;
  color: Signal<string>;
}

export const frameChoice = (size: SizeName = "view"): FrameChoice => ({
  size: signal<SizeName>(size),
  width: signal("1200"),
  height: signal("800"),
  background: signal("view"),
  color: signal("#ffffff"),
});

/** Pixels [width, height] of a view on the screen at the chosen size; null: not a size that can be rendered. */
export function pixelsOf(choice: FrameChoice, view: CameraJson): [number, number] | null {
  const name = choice.size.value;
  let size: [number, number] = [view.width, view.height];
  if (name === "double") size = [view.width * 2, view.height * 2];
  else if (name === "custom") size = [Number(choice.width.value), Number(choice.height.value)];
  else if (name !== "view") size = name.split("x").map(Number) as [number, number];
  const good = size.every((side) => Number.isInteger(side) && side >= MIN_SIDE_PX && side <= MAX_SIDE_PX);
  return good && size[0] * size[1] <= MAX_PIXELS ? size : null;
}

/** The view in a picture of that many pixels: its shorter side shows what the shorter side of the screen shows. */
export function reframed(view: CameraJson, [width, height]: [number, number]): CameraJson {
  const scale = Math.min(width, height) / Math.min(view.width, view.height);
  const [x, y] = [view.cx - view.width / 2, view.cy - view.height / 2];
  return {
    ...view,
    width,
    height,
    fx: view.fx * scale,
    fy: view.fy * scale,
    cx: width / 2 + x * scale,
    cy: height / 2 + y * scale,
  };
}

/** The camera that was chosen; null: no such picture. */
export function chosenCamera(choice: FrameChoice, view: CameraJson | null): CameraJson | null {
  const pixels = view && pixelsOf(choice, view);
  if (!view || !pixels) return null;
  const camera = choice.size.value === "view" ? view : reframed(view, pixels);
  return choice.background.value === "color" ? { ...camera, background: rgb(choice.color.value) } : camera;
}

interface Props {
  choice: FrameChoice;
  view: CameraJson | null;
  /** Kinds of transparency that the file can have, besides a background. */
  clear: readonly (readonly [string, string])[];
}

export function FrameSize({ choice, view, clear }: Props) {
  const { size, width, height, background, color } = choice;
  const pixels = view && pixelsOf(choice, view);
  const backgrounds = [["view", "As in the view"], ["color", "Colour"], ...clear] as const;
  const offered = backgrounds.some(([name]) => name === background.value);
  return (
    <>
      <p class="row">
        <Choice label="Size" value={size.value} options={SIZES} onChange={(value) => (size.value = value)} />
        {size.value === "custom" &&
          (
            [
              [width, "Width"],
              [height, "Height"],
            ] as const
          ).map(([side, name]) => (
            <input
              key={name}
              type="text"
              inputMode="numeric"
              class="pixels"
              aria-label={`${name} in pixels, ${MIN_SIDE_PX} to ${MAX_SIDE_PX}`}
              aria-invalid={!pixels}
              value={side.value}
              onInput={(event) => (side.value = event.currentTarget.value)}
              onKeyDown={(event) => event.stopPropagation()}
            />
          ))}
        <span class="quiet" role="status">
          {pixels
            ? `${pixels[0]} x ${pixels[1]} pixels`
            : `${MIN_SIDE_PX} to ${MAX_SIDE_PX} a side, 16.8 megapixels in all`}
        </span>
      </p>
      <p class="row">
        <Choice
          label="Background"
          value={offered ? background.value : "view"}
          options={backgrounds as readonly (readonly [string, string])[]}
          onChange={(value) => (background.value = value)}
        />
        {background.value === "color" && (
          <input
            type="color"
            aria-label="Colour of the background"
            value={color.value}
            onInput={(event) => (color.value = event.currentTarget.value)}
          />
        )}
      </p>
    </>
  );
}
