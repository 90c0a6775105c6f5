/** New light on an asset, as the light panel sets it, and as the operation `light` takes it (splatpainter light --help). */

import type { LightOptions } from "../messages";
import { rgb } from "../state/store";
import { KELVIN_RANGE, kelvinColor } from "./kelvin";

export type LampKind = "point" | "spot" | "rect" | "disk" | "sphere";

/** A colour, or a temperature in its place. */
export type LightColor = { hex: string } | { kelvin: number };

interface Light {
  id: number;
  color: LightColor;
  /** 1: as bright as white light from all around, on a surface that faces a sun, or one world unit from a lamp. */
  intensity: number;
}

export interface SunLight extends Light {
  kind: "sun";
  /** Degrees counter-clockwise seen from above, 0 at the front of the asset. */
  azimuth: number;
  /** Degrees above the horizon. */
  elevation: number;
  /** Angular diameter, degrees: softness of its shadows. */
  size: number;
}

export interface LampLight extends Light {
  kind: LampKind;
  /** World units. */
  position: readonly [number, number, number];
  /** Where spot, rect and disk look to. */
  target: readonly [number, number, number];
  /** spot: full angle, degrees; rect: width and height; disk and sphere: radius; world units. */
  sizes: readonly number[];
}

export interface LightSettings {
  /** Name of an environment; "": none. */
  sky: string;
  /** Of one from a file: hash of what the project holds of it; "": it needs no file. */
  held: string;
  /** The light before, where it is known, and the hash of what the project holds of it; null: it is estimated. */
  source: { name: string; held: string } | null;
  /** White light from all around besides; null: a little where suns and lamps come without a sky. */
  fill: number | null;
  /** Degrees by which the environment turns, counter-clockwise seen from above. */
  rotate: number;
  suns: readonly SunLight[];
  lamps: readonly LampLight[];
  /** Stops, of all lights. */
  exposure: number;
  /** How much of the new look, 0 .. 1; the rest is the captured one. */
  mix: number;
  /** They are added to the light that is baked in; else they replace it. */
  add: boolean;
  /** Shadows by the asset itself. */
  shadows: boolean;
}

/** Of suns and lamps together (lights/light_set.py). */
export const MAX_LIGHTS = 64;
/** Least share of the new look: the operation takes no 0. */
export const MIN_MIX = 0.01;
/** Of intensities and exposures that the panel offers; the operation takes more. */
export const INTENSITY_RANGE = [0.01, 100] as const;
export const EXPOSURE_RANGE = [-5, 5] as const;

export const NO_LIGHT: LightSettings = {
  sky: "",
  held: "",
  source: null,
  fill: null,
  rotate: 0,
  suns: [],
  lamps: [],
  exposure: 0,
  mix: 1,
  add: false,
  shadows: true,
};
/** Of the sun that one sees, degrees (lights/lamps.py). */
export const SUN_DEGREES = 0.53;
/** White light from all around where suns and lamps come without a sky (lights/light_set.py). */
export const LAMP_FILL = 0.15;
/** Option -> hash of what the project holds of the file that it names. */
export type HeldFiles = Record<string, string>;
const WARM: LightColor = { hex: "#fff4e0" };
const SIZES: Record<LampKind, (radius: number) => readonly number[]> = {
  point: () => [],
  spot: () => [40],
  rect: (radius) => [0.5 * radius, 0.5 * radius],
  disk: (radius) => [0.25 * radius],
  sphere: (radius) => [0.1 * radius],
};
/** What the numbers of `sizes` are called, and in which unit. */
export const SIZE_NAMES: Record<LampKind, readonly (readonly [string, string])[]> = {
  point: [],
  spot: [["Angle", "°"]],
  rect: [
    ["Width", ""],
    ["Height", ""],
  ],
  disk: [["Radius", ""]],
  sphere: [["Radius", ""]],
};
const LAMP_KINDS = Object.keys(SIZES) as LampKind[];
/** Kinds that look somewhere. */
export const AIMED: readonly LampKind[] = ["spot", "rect", "disk"];

const nextId = ({ suns, lamps }: LightSettings): number =>
  1 + Math.max(0, ...suns.map(({ id }) => id), ...lamps.map(({ id }) => id));

export const isFull = ({ suns, lamps }: LightSettings): boolean => suns.length + lamps.length >= MAX_LIGHTS;

/** Whether there is any light to apply. */
export const isLit = ({ sky, suns, lamps }: LightSettings): boolean => sky !== "" || suns.length + lamps.length > 0;

export function withSun(lights: LightSettings, azimuth = 45, elevation = 40): LightSettings {
  if (isFull(lights)) return lights;
  const sun: SunLight = {
    id: nextId(lights),
    kind: "sun",
    azimuth,
    elevation,
    size: SUN_DEGREES,
    color: WARM,
    intensity: 1,
  };
  return ordered({ ...lights, suns: [...lights.suns, sun] });
}

/** With a lamp above the middle of an asset of this radius, beside those that there are, that looks at it. `up`: unit. */
export function withLamp(
  lights: LightSettings,
  kind: LampKind,
  asset: { center: readonly number[]; radius: number; up: readonly number[] },
): LightSettings {
  if (isFull(lights)) return lights;
  const { center, radius, up } = asset;
  const aside = 0.5 * lights.lamps.length;
  const side = up.map((_, k) => up[(k + 1) % 3]); // across, as up lies along an axis
  const at = (share: number, along = 0) =>
    [0, 1, 2].map((k) => center[k] + radius * (share * up[k] + along * side[k])) as [number, number, number];
  const lamp: LampLight = {
    id: nextId(lights),
    kind,
    position: at(1.5, aside),
    target: at(0),
    sizes: SIZES[kind](radius),
    color: { kelvin: 2700 },
    intensity: Math.max(INTENSITY_RANGE[0], Math.min(INTENSITY_RANGE[1], radius ** 2)), // it falls off with the square
  };
  return ordered({ ...lights, lamps: [...lights.lamps, lamp] });
}

/** As a layer gives them back: lamps by their kind, ids from 1. */
function ordered(lights: LightSettings): LightSettings {
  let id = 0;
  const suns = lights.suns.map((one) => ({ ...one, id: ++id }));
  const sorted = LAMP_KINDS.flatMap((kind) => lights.lamps.filter((one) => one.kind === kind));
  return { ...lights, suns, lamps: sorted.map((one) => ({ ...one, id: ++id })) };
}

export const changedSun = (lights: LightSettings, id: number, part: Partial<SunLight>): LightSettings => ({
  ...lights,
  suns: lights.suns.map((one) => (one.id === id ? { ...one, ...part } : one)),
});

export const changedLamp = (lights: LightSettings, id: number, part: Partial<LampLight>): LightSettings => ({
  ...lights,
  lamps: lights.lamps.map((one) => (one.id === id ? { ...one, ...part } : one)),
});

export const without = (lights: LightSettings, id: number): LightSettings =>
  ordered({
    ...lights,
    suns: lights.suns.filter((one) => one.id !== id),
    lamps: lights.lamps.filter((one) => one.id !== id),
  });

/** "#rrggbb" of a light, as bright as it can be. */
export function hexOf(color: LightColor): string {
  if ("hex" in color) return color.hex;
  const linear = kelvinColor(color.kelvin);
  const most = Math.max(...linear);
  const channel = (value: number) => {
    const share = value / most;
    const srgb = share <= 0.0031308 ? 12.92 * share : 1.055 * share ** (1 / 2.4) - 0.055;
    return Math.round(255 * srgb)
      .toString(16)
      .padStart(2, "0");
  };
  return `#${linear.map(channel).join("")}`;
}

/** What a layer of light says of itself. */
export type LayerLight = Partial<LightOptions> & { held?: HeldFiles };

/** Fields of the operation `light`, and what a project holds for them: lights are numbers with commas between, then a colour and an intensity. */
export interface LightFields {
  hdri: string;
  source_light: string | null;
  held: HeldFiles;
  fill: number | null;
  rotate: number;
  exposure: number;
  mix: number;
  add: boolean;
  shadows: boolean;
  sun: string[];
  point: string[];
  spot: string[];
  rect: string[];
  disk: string[];
  sphere: string[];
}

const digits = (value: number, count = 6): string => String(Number(value.toPrecision(count)));
/** Places: world coordinates of maps have seven digits before the point. */
const PLACE_DIGITS = 12;
const placed = (value: number): string => digits(value, PLACE_DIGITS);

function colorAndIntensity({ color, intensity }: Light): string[] {
  return ["kelvin" in color ? `${digits(color.kelvin)}K` : color.hex, digits(intensity)];
}

export function lightFields(lights: LightSettings): LightFields {
  const lampsOf = (kind: LampKind) =>
    lights.lamps
      .filter((one) => one.kind === kind)
      .map((one) => {
        const target = AIMED.includes(kind) ? one.target : [];
        return [
          ...[...one.position, ...target].map(placed),
          ...one.sizes.map((size) => digits(size)),
          ...colorAndIntensity(one),
        ].join(",");
      });
  const sun = lights.suns.map((one) =>
    [digits(one.azimuth), digits(one.elevation), ...colorAndIntensity(one), digits(one.size)].join(","),
  );
  const { sky: hdri, rotate, exposure, add, shadows, fill, source } = lights;
  const held = { ...(lights.held && { hdri: lights.held }), ...(source && { source_light: source.held }) };
  return {
    ...{ hdri, source_light: source?.name ?? null, held, fill, rotate, exposure, add, shadows, sun },
    mix: Math.max(MIN_MIX, Math.min(1, lights.mix)),
    point: lampsOf("point"),
    spot: lampsOf("spot"),
    rect: lampsOf("rect"),
    disk: lampsOf("disk"),
    sphere: lampsOf("sphere"),
  };
}

/**
 * The settings of a layer of light: its options, of which those at their defaults are left out, and its opacity. The inverse
 * of `lightFields`.
 */
export function lightsOf(parameters: LayerLight, opacity: number): LightSettings {
  const { hdri = "", rotate = 0, exposure = 0, add = false, shadows = true, kelvin, fill = null } = parameters;
  const { held = {}, source_light: name, sun_size = SUN_DEGREES } = parameters;
  const white: LightColor = kelvin ? { kelvin } : { hex: "#ffffff" };
  const words = (kind: LampKind | "sun") => parameters[kind] ?? [];
  let id = 0;
  const read = (text: string, count: number) => {
    const parts = text.split(",");
    const rest = parts.slice(count);
    const word = /^#|K$/.test(rest[0] ?? "") ? rest.shift()! : "";
    const named = word.startsWith("#") ? { hex: word } : { kelvin: Number(word.slice(0, -1)) };
    const light = { id: ++id, color: word ? named : white, intensity: rest.length ? Number(rest[0]) : 1 };
    return { numbers: parts.slice(0, count).map(Number), light, rest: rest.slice(1) };
  };
  const suns = words("sun").map((text): SunLight => {
    const { numbers, light, rest } = read(text, 2);
    const size = rest.length ? Number(rest[0]) : sun_size;
    return { ...light, kind: "sun", azimuth: numbers[0], elevation: numbers[1], size };
  });
  const lamps = LAMP_KINDS.flatMap((kind) =>
    words(kind).map((text): LampLight => {
      const aim = AIMED.includes(kind) ? 3 : 0;
      const { numbers, light } = read(text, 3 + aim + SIZE_NAMES[kind].length);
      const vector = (at: number) => numbers.slice(at, at + 3) as [number, number, number];
      return {
        ...light,
        kind,
        position: vector(0),
        target: aim ? vector(3) : [0, 0, 0],
        sizes: numbers.slice(3 + aim),
      };
    }),
  );
  const source = name && held.source_light ? { name, held: held.source_light } : null;
  const sky = { sky: hdri, held: held.hdri ?? "", source, fill };
  return { ...sky, rotate, suns, lamps, exposure, mix: opacity, add, shadows };
}

/** The colour as the other kind of setting: a temperature for a colour is the nearest one. */
export function asKelvin(color: LightColor): LightColor {
  if ("kelvin" in color) return color;
  const [red, , blue] = rgb(color.hex);
  const [low, high] = KELVIN_RANGE;
  let [best, least] = [6500, Infinity];
  for (let kelvin = 2000; kelvin <= Math.min(high, 12_000); kelvin += 100) {
    const [r, , b] = rgb(hexOf({ kelvin }));
    const off = Math.abs(red - blue - (r - b));
    if (off < least) [best, least] = [kelvin, off];
  }
  return { kelvin: Math.max(low, best) };
}

export const asHex = (color: LightColor): LightColor => ({ hex: hexOf(color) });
