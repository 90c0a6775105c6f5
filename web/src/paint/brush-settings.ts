/** The brush beside its size, hardness, opacity and flow (state/store): how its dabs follow each other. */

import { computed, signal } from "@preact/signals";

import { brush, density, paintMode, state } from "../state/store";
import type { BuiltInTip, Texture } from "./tips";
import { BUILT_IN_TIPS, TEXTURES, TIP_PX } from "./tips";

export interface Engine {
  /** Of the size: pixels of the screen, the same at every pixel setting, or world units. */
  unit: "screen" | "world";
  worldSize: number;
  /** Each dab lies on the surface and turns with it. */
  follow: boolean;
  /** A key of BUILT_IN_TIPS, or "picture". */
  tip: BuiltInTip | "picture";
  /** Of "picture": [TIP_PX²] 0..255. */
  picture: Uint8Array | null;
  angle: number;
  roundness: number;
  alongPath: boolean;
  spacing: number;
  sizeJitter: number;
  opacityJitter: number;
  angleJitter: number;
  scatter: number;
  texture: Texture;
  textureScale: number;
  textureDepth: number;
  stabiliser: number;
}

export const PLAIN: Engine = {
  unit: "screen",
  worldSize: 0.1,
  follow: false,
  tip: "round",
  picture: null,
  angle: 0,
  roundness: 1,
  alongPath: false,
  spacing: 0.1,
  sizeJitter: 0,
  opacityJitter: 0,
  angleJitter: 0,
  scatter: 0,
  texture: "none",
  textureScale: 1,
  textureDepth: 1,
  stabiliser: 0,
};

export const engine = signal<Engine>(PLAIN);
export const setEngine = (part: Partial<Engine>): void => void (engine.value = { ...engine.value, ...part });

/** Pixels of the view per pixel of the page (CSS). */
export const viewScale = computed(() => density.value);

/** Share of the asset's radius: the range of sizes in world units. */
export const MIN_WORLD_SHARE = 1e-3;
export const MAX_WORLD_SHARE = 2;
export const MIN_SIZE_PX = 1;
export const MAX_SIZE_PX = 600;

const radius = (): number => state.value?.asset.radius ?? 1;

/** Make the brush larger or smaller by a factor, in its unit. */
export function resizeBrush(factor: number): void {
  if (engine.value.unit === "world") {
    const [min, max] = [MIN_WORLD_SHARE * radius(), MAX_WORLD_SHARE * radius()];
    setEngine({ worldSize: Math.max(min, Math.min(max, engine.value.worldSize * factor)) });
  } else {
    const size = Math.max(MIN_SIZE_PX, Math.min(MAX_SIZE_PX, brush.value.size * factor));
    brush.value = { ...brush.value, size };
  }
}

/** How much of the surface's own shading paint keeps, 0..1. */
const chosenShading = signal<number | null>(null);
/** All of it where the asset has fine detail of its own, until it is chosen. */
export const keepShading = computed(() => chosenShading.value ?? (state.value?.asset.fine_detail ? 1 : 0));
/** What paint keeps in the present mode: one that changes the colour alone keeps all shading by itself. */
export const shadingApplies = computed(() => paintMode.value !== "color");
export const keptShading = computed(() => (shadingApplies.value ? keepShading.value : 0));
export const setKeepShading = (share: number): void => void (chosenShading.value = Math.max(0, Math.min(1, share)));

/** A brush with everything that it is, as it is kept and exported. */
export interface Preset {
  name: string;
  /** Screen pixels. */
  size: number;
  hardness: number;
  opacity: number;
  flow: number;
  pressureSize: boolean;
  pressureFlow: boolean;
  engine: Engine;
}

const preset = (name: string, size: number, part: Partial<Engine>, tone: Partial<Preset> = {}): Preset => ({
  name,
  size,
  hardness: 0.7,
  opacity: 1,
  flow: 1,
  pressureSize: true,
  pressureFlow: false,
  ...tone,
  engine: { ...PLAIN, ...part },
});

export const BUILT_IN_PRESETS: readonly Preset[] = [
  preset("Round", 40, {}),
  preset("Soft", 90, {}, { hardness: 0, flow: 0.5, pressureSize: false, pressureFlow: true }),
  preset("Pen", 8, { stabiliser: 0.5 }, { hardness: 0.9 }),
  preset("Marker", 34, { tip: "square", roundness: 0.35, angle: -35, spacing: 0.05 }, { opacity: 0.8 }),
  preset("Chalk", 46, { tip: "chalk", spacing: 0.16, angleJitter: 1, texture: "paper", textureDepth: 0.7 }),
  preset("Bristles", 56, { tip: "bristle", alongPath: true, spacing: 0.03, opacityJitter: 0.3 }, { flow: 0.8 }),
  preset(
    "Spray",
    110,
    { tip: "spray", spacing: 0.22, angleJitter: 1, sizeJitter: 0.2 },
    { flow: 0.7, pressureSize: false },
  ),
  preset("Sponge", 80, { tip: "sponge", spacing: 0.45, angleJitter: 1, sizeJitter: 0.3, scatter: 0.15 }),
  preset("Leaves", 46, {
    tip: "leaf",
    spacing: 0.8,
    angleJitter: 1,
    sizeJitter: 0.6,
    scatter: 0.6,
    opacityJitter: 0.3,
  }),
  preset("Weave", 70, { texture: "canvas" }, { hardness: 0.85 }),
];

export const currentPreset = (name: string): Preset => {
  const { size, hardness, opacity, flow, pressureSize, pressureFlow } = brush.value;
  return { name, size, hardness, opacity, flow, pressureSize, pressureFlow, engine: engine.value };
};

export function takePreset({ name: _name, engine: next, ...tone }: Preset): void {
  // a size in world units belongs to an asset: the preset's is one on the screen
  const { unit, worldSize } = engine.value;
  brush.value = { ...brush.value, ...tone };
  engine.value = { ...next, unit, worldSize };
}

/** The format of an exported file. */
const FORMAT = "splatpainter.brushes";
const MAX_PRESETS = 200;
const MAX_NAME = 60;
const RANGES: Partial<Record<keyof Engine, readonly [number, number]>> = {
  worldSize: [0, 1e6],
  angle: [-180, 180],
  roundness: [0.02, 1],
  spacing: [0.01, 3],
  sizeJitter: [0, 1],
  opacityJitter: [0, 1],
  angleJitter: [0, 1],
  scatter: [0, 1],
  textureScale: [0.25, 8],
  textureDepth: [0, 1],
  stabiliser: [0, 1],
};
const CHOICES: Partial<Record<keyof Engine, readonly string[]>> = {
  unit: ["screen", "world"],
  tip: [...Object.keys(BUILT_IN_TIPS), "picture"],
  texture: Object.keys(TEXTURES),
};

const bytesOf = (text: string): Uint8Array => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

/** As text: JSON, a tip's picture as base64. */
export function presetsText(presets: readonly Preset[]): string {
  const brushes = presets.map(({ engine: { picture, ...rest }, ...tone }) => ({
    ...tone,
    engine: { ...rest, picture: picture && btoa(String.fromCharCode(...picture)) },
  }));
  return JSON.stringify({ format: FORMAT, version: 1, brushes }, null, 1);
}

/** The presets of a text. Throws an Error of one line that says what is wrong. */
export function parsePresets(text: string): Preset[] {
  let data: unknown;
  try {
    data = JSON.parse(text);
  } catch {
    throw new Error("brushes: expected a JSON file");
  }
  const { format, version, brushes } = (data ?? {}) as { format?: unknown; version?: unknown; brushes?: unknown };
  if (format !== FORMAT || version !== 1 || !Array.isArray(brushes))
    throw new Error("brushes: expected a file of brushes that this studio saved");
  if (brushes.length > MAX_PRESETS) throw new Error(`brushes: expected at most ${MAX_PRESETS}, got ${brushes.length}`);
  return brushes.map((one, k) => parsePreset(one, `brush ${k + 1}`));
}

function parsePreset(data: unknown, where: string): Preset {
  const fields = (data ?? {}) as Record<string, unknown>;
  const given = (fields.engine ?? {}) as Record<string, unknown>;
  const number = (value: unknown, name: string, [min, max]: readonly [number, number]): number => {
    if (typeof value !== "number" || !(value >= min && value <= max))
      throw new Error(`${where}: expected ${name} from ${min} to ${max}, got ${String(value).slice(0, 40)}`);
    return value;
  };
  const { name } = fields;
  if (typeof name !== "string" || !name.trim() || name.length > MAX_NAME)
    throw new Error(`${where}: expected a name of at most ${MAX_NAME} characters`);
  const checked: Record<string, unknown> = { ...PLAIN };
  for (const key of Object.keys(PLAIN) as (keyof Engine)[]) {
    const value = given[key];
    if (value === undefined || key === "picture") continue;
    const [range, choices] = [RANGES[key], CHOICES[key]];
    if (range) checked[key] = number(value, key, range);
    else if (choices && !choices.includes(String(value)))
      throw new Error(
        `${where}: expected ${key} to be one of ${choices.join(", ")}, got ${String(value).slice(0, 40)}`,
      );
    else if (!choices && typeof value !== "boolean") throw new Error(`${where}: expected ${key} to be true or false`);
    else checked[key] = value;
  }
  if (checked.tip === "picture") {
    let picture: Uint8Array | null = null;
    try {
      picture = bytesOf(String(given.picture));
    } catch {
      // said below
    }
    if (picture?.length !== TIP_PX * TIP_PX)
      throw new Error(`${where}: expected a tip of ${TIP_PX} x ${TIP_PX} pixels`);
    checked.picture = picture;
  }
  return {
    name,
    size: number(fields.size, "size", [MIN_SIZE_PX, MAX_SIZE_PX]),
    hardness: number(fields.hardness, "hardness", [0, 1]),
    opacity: number(fields.opacity, "opacity", [0.01, 1]),
    flow: number(fields.flow, "flow", [0.01, 1]),
    pressureSize: fields.pressureSize === true,
    pressureFlow: fields.pressureFlow === true,
    engine: checked as unknown as Engine,
  };
}
