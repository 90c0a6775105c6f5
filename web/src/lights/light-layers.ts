/**
 * Light layers under the panel's hands: what it shows is the chosen light layer, or a draft that becomes a layer as soon as
 * there is light in it. Each gesture is one step of the history.
 */

import { computed, signal } from "@preact/signals";

import { editor, run } from "../editor/editor";
import type { LayerInfo, LightOptions } from "../messages";
import { chosenAsset } from "../state/assets";
import { NewestOnly } from "../state/newest-only";
import { dragged, shownLayers } from "../state/pending-layers";
import { readOnly, selectedLayer, state } from "../state/store";
import { axisName } from "../state/up-axis";
import {
  isLit,
  lightFields,
  lightsOf,
  NO_LIGHT,
  type LayerLight,
  type LightFields,
  type LightSettings,
} from "./lights";

/** The light layer that is chosen. */
export const lightLayer = computed<LayerInfo | null>(
  () => shownLayers.value.find((one) => one.id === selectedLayer.value && one.kind === "light") ?? null,
);

/** The lamp that is chosen, by its id among those that are shown; null: none. */
export const selectedLamp = signal<number | null>(null);
let shownLayer: string | undefined;
lightLayer.subscribe((layer) => {
  if (layer?.id === shownLayer) return;
  if (shownLayer !== undefined) selectedLamp.value = null; // a draft that became a layer has the same lamps
  shownLayer = layer?.id;
});

const draft = signal<LightSettings>(NO_LIGHT);
const making = signal(false);
/** What is asked for and not done yet. */
const asked = signal<{ layer: string; lights: LightSettings } | null>(null);

/** Options of the operation that the panel sets. How much of it shows is the layer's opacity. */
type Options = Omit<LightFields, "mix">;
function optionsOf(lights: LightSettings): Options {
  const { mix: _, ...options } = lightFields(lights);
  return options;
}
const same = (a: unknown, b: unknown): boolean => JSON.stringify(a) === JSON.stringify(b);

/** What the panel shows. */
export const shownLights = computed<LightSettings>(() => {
  const layer = lightLayer.value;
  if (!layer) return draft.value;
  if (asked.value?.layer === layer.id) return asked.value.lights;
  return lightsOf(layer.parameters as LayerLight, layer.opacity);
});

/**
 * Layers that go with one: those of the other assets of the scene that are as it is, made by one light over all of them,
 * unless one asset is chosen.
 */
export function linkedTo(layer: LayerInfo): LayerInfo[] {
  if (chosenAsset.value) return [layer];
  const alike = (one: LayerInfo) =>
    one.kind === "light" && one.asset !== layer.asset && one.name === layer.name && one.opacity === layer.opacity;
  const others = shownLayers.value.filter((one) => alike(one) && same(shape(one), shape(layer)));
  return [layer, ...others];
}
/** What of a layer is set here; what it keeps to is of its asset. */
const shape = ({ parameters, opacity }: LayerInfo) => optionsOf(lightsOf(parameters as LayerLight, opacity));

interface Gesture {
  layer: string;
  /** It, and those that go with it. */
  layers: readonly string[];
  send: ReturnType<typeof dragged>;
  start: LightSettings;
  /** Whether the server can show a drag of it without changing the layer. */
  glances: boolean;
  /** Options that it has changed at some time: those in between are skipped, so each message has all of them. */
  touched: Set<keyof Options>;
  faded: boolean;
}
const gesture = signal<Gesture | null>(null);
/** A pointer or a key is down: what changes is shown, and becomes a step when it is let go. */
let held = false;
/** What is shown of it and no step yet. */
let unsent: LightSettings | null = null;

/** The next change is a step of its own, once the pointer or the key that begins it is let go. */
export function beginGesture(): void {
  void letGo();
  gesture.value = null;
  held = true;
}

/** A colour is being picked, in a window of the browser that has no pointer of ours. */
export function hold(): void {
  held = true;
}

/** Make a step of what was dragged. */
export async function letGo(): Promise<void> {
  held = false;
  glances.skip();
  const lights = unsent;
  unsent = null;
  if (lights) await changeLights(lights);
}

interface Glance {
  lights: LightSettings;
  gesture: Gesture;
}
/** One at a time, the newest next: a drag is followed as fast as the server can. */
const glances = new NewestOnly<Glance>(async ({ lights, gesture: now }) => {
  const parameters = { ...changesOf(now, lights) };
  const layers = now.layers.map((layer) => ({ layer, parameters, opacity: lights.mix }));
  const answer = await editor.link.do("layer.preview", { layers }).catch(() => null);
  if (answer && !answer.possible) now.glances = false;
});

/** Options that a gesture has changed at some time: those in between were skipped, so each message has all of them. */
function changesOf(now: Gesture, lights: LightSettings): Partial<Options> {
  const [options, before] = [optionsOf(lights), optionsOf(now.start)];
  for (const name of Object.keys(options) as (keyof Options)[])
    if (!same(options[name], before[name])) now.touched.add(name);
  return Object.fromEntries([...now.touched].map((name) => [name, options[name]]));
}

/** From the panel, also while something is dragged. */
export async function changeLights(lights: LightSettings): Promise<void> {
  const layer = lightLayer.value;
  if (readOnly.value) return;
  if (!held) unsent = null;
  if (!layer) {
    draft.value = lights;
    if (isLit(lights) && !making.value) await make();
    return;
  }
  const { rig, sun_at: places } = layer.parameters as LayerLight; // not the panel's, and light all the same
  if (!isLit(lights) && !rig && !places?.length) return remove(layer, lights);
  const start = shownLights.value;
  if (gesture.value?.layer !== layer.id) {
    const layers = linkedTo(layer).map(({ id }) => id);
    gesture.value = {
      layer: layer.id,
      layers,
      send: dragged(layers, `Changing ${layer.name}`),
      start,
      glances: true,
      touched: new Set(),
      faded: false,
    };
  }
  const now = gesture.value;
  const parameters = changesOf(now, lights);
  now.faded ||= lights.mix !== now.start.mix;
  const request = { layer: layer.id, lights };
  asked.value = request;
  if (held && now.glances && layer.visible) {
    unsent = lights;
    await glances.add({ lights, gesture: now });
    // Where it could not be shown so, it is done at once, as is what follows of this gesture.
    if (!now.glances && held && unsent === lights) {
      unsent = null;
      held = false;
      await changeLights(lights);
    }
    return;
  }
  try {
    if (now.touched.size || now.faded)
      await now.send({ ...(now.touched.size && { parameters }), ...(now.faded && { opacity: lights.mix }) });
  } finally {
    if (asked.value === request) asked.value = null;
  }
}

async function make(): Promise<void> {
  const sent = draft.value;
  const up = axisName(state.value?.asset.up);
  const { held, ...options } = optionsOf(sent);
  const operation: LightOptions = { kind: "light", ...options, ...(up && up !== "-y" && { up }) };
  making.value = true;
  const fields = { operation, held, name: "Light", opacity: sent.mix, asset: chosenAsset.value?.id ?? null };
  const answer = await run("layer.add", fields, "Light").finally(() => (making.value = false));
  const newest = draft.value;
  draft.value = NO_LIGHT;
  if (!answer) return;
  selectedLayer.value = answer.layer.id;
  gesture.value = null;
  if (newest !== sent) await changeLights(newest);
}

/** Without any light there is no layer; what else was set is there for the next one. */
async function remove(layer: LayerInfo, lights: LightSettings): Promise<void> {
  draft.value = lights;
  gesture.value = null;
  await run("layer.delete", { layer: layer.id }, `Deleting ${layer.name}`);
}

/** The light that is baked in taken out, as a layer below what comes next. */
export async function takeLightOut(): Promise<void> {
  const up = axisName(state.value?.asset.up);
  const operation = { kind: "delight" as const, ...(up && up !== "-y" && { up }) };
  const fields = { operation, name: "White light", asset: chosenAsset.value?.id ?? null };
  await run("layer.add", fields, "Taking the light out");
}

/** Before and after. */
export const toggleLight = (layer: LayerInfo): Promise<unknown> =>
  dragged(
    linkedTo(layer).map(({ id }) => id),
    `${layer.visible ? "Hiding" : "Showing"} ${layer.name}`,
  )({ visible: !layer.visible });

/** Leave the chosen one: the next light is a layer of its own. */
export function anotherLight(): void {
  gesture.value = null;
  draft.value = NO_LIGHT;
  selectedLayer.value = null;
}
