/** The brush as it is set, for the tools that paint with it: its dabs, its texture, its colour. */

import { editor } from "../editor/editor";
import { brush, camera, color, paintMode, pose, rgb } from "../state/store";
import { rayOf, type CameraJson } from "../view/camera";
import { engine, keptShading, viewScale } from "./brush-settings";
import { blend, type Rgb } from "./colors";
import { roundFrame, shaped, type Brush, type Frame } from "./dabs";
import { rememberLatest } from "./latest";
import type { Grain, Source } from "./patch";
import { localMean, NEIGHBOURHOOD, shaded } from "./shading";
import type { Stroke } from "./stroke";
import { facingFrame, frameOnSurface } from "./surface-blocks";
import { builtInTip, grainAt, textureTile, TIP_PX, withHalves, type TipImage } from "./tips";
import { surfaceOf } from "./view-surface";

/** The string of a steady hand at its full strength, pixels of the screen. */
const MAX_STRING_PX = 80;

/** Length of the stabiliser's string, pixels of the view. */
export const stringLength = (): number => engine.value.stabiliser * MAX_STRING_PX * viewScale.value;

const tipOfPicture = rememberLatest((picture: Uint8Array): TipImage =>
  withHalves(
    TIP_PX,
    Float32Array.from(picture, (value) => value / 255),
  ),
);

function tipImage(): TipImage | null {
  const { tip, picture } = engine.value;
  if (tip !== "picture") return builtInTip(tip);
  return picture && tipOfPicture(picture);
}

/** Depth of the asset under a pixel where no table of the surface is at hand: of the ray, else of the asset's middle. */
function depthAt(x: number, y: number): number {
  const [now, eye] = [camera.value!, pose.value!];
  const direction = rayOf(eye, (2 * x) / now.width - 1, (2 * y) / now.height - 1, now.width / now.height);
  const hit = editor.viewer.hit(eye.eye, direction);
  const row = now.world_to_camera[2];
  return hit ? row[0] * hit[0] + row[1] * hit[1] + row[2] * hit[2] + row[3] : eye.distance;
}

/** The circle of the brush at a pixel, as the view sees it. `depth`: to fall back on, where the surface has no entry. */
function frameAt(x: number, y: number, depth: () => number): Frame {
  const { unit, worldSize, follow } = engine.value;
  const now = camera.value!;
  const size = (brush.value.size / 2) * viewScale.value;
  if (unit === "screen" && !follow) return roundFrame(size);
  const at = surfaceOf(now)?.at(x, y) ?? null;
  const z = at ? at.point[2] : depth();
  const radius = unit === "world" ? worldSize / 2 : (size * z) / now.fx;
  return at && follow ? frameOnSurface(now, at, radius) : facingFrame(now, z, radius);
}

/** Of the first place where the cursor was on a view: it is looked up once, where the surface is not known. */
const depthOnView = rememberLatest((_view: CameraJson | null) => {
  let depth: number | null = null;
  return (x: number, y: number): number => (depth ??= depthAt(x, y));
});

/** The ring of the cursor. */
export function cursorFrame(x: number, y: number): Frame {
  const { angle, roundness } = engine.value;
  const frame = frameAt(x, y, () => depthOnView(camera.value)(x, y));
  return shaped(frame, 1, angle, roundness);
}

/** Strokes so far: each has jitter of its own. */
let strokes = 0;

/** The brush for one stroke that begins at a pixel. plain: a round tip without jitter (clone, heal). */
export function brushFor(x: number, y: number, plain = false): Brush {
  const { hardness, flow, pressureSize, pressureFlow } = brush.value;
  const { angle, roundness, alongPath, spacing, sizeJitter, opacityJitter, angleJitter, scatter } = engine.value;
  let depth: number | null = null;
  return {
    frame: (u, v) => frameAt(u, v, () => (depth ??= depthAt(x, y))),
    tip: plain ? null : tipImage(),
    ...{ hardness, flow, pressureSize, pressureFlow },
    ...(plain
      ? {
          angle: 0,
          roundness: 1,
          alongPath: false,
          spacing: 0.1,
          sizeJitter: 0,
          opacityJitter: 0,
          angleJitter: 0,
          scatter: 0,
        }
      : { angle, roundness, alongPath, spacing, sizeJitter, opacityJitter, angleJitter, scatter }),
    seed: ++strokes,
  };
}

/** The texture of the paint; null: none. */
export function grainOf(): Grain | null {
  const { texture, textureScale, textureDepth } = engine.value;
  const tile = textureTile(texture);
  const scale = textureScale * viewScale.value;
  return tile && ((x, y) => grainAt(tile, x, y, scale, textureDepth));
}

/** The chosen colour in the chosen mode, with the shading of what it covers as far as that is kept. */
export function colorSource(stroke: Stroke): Source {
  const paint = rgb(color.value).map((c) => c * 255) as Rgb;
  const [mode, keep] = [paintMode.value, keptShading.value];
  const background = camera.value!.background.map((c) => c * 255) as Rgb;
  let mean: Float32Array | null = null;
  return (x, y, out) => {
    const { base } = stroke;
    let result = paint;
    if (base && (mode !== "normal" || keep > 0)) {
      const pixel = y * base.width + x;
      const below: Rgb = [base.data[pixel * 4], base.data[pixel * 4 + 1], base.data[pixel * 4 + 2]];
      if (keep > 0) {
        mean ??= localMean(base, background, Math.ceil(NEIGHBOURHOOD * Math.max(base.width, base.height)));
        result = shaded(paint, below, mean[pixel], keep);
      }
      result = blend(mode, result, below);
    }
    [out[0], out[1], out[2]] = result;
  };
}
