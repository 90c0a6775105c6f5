/**
 * Layers as they were asked to be: what the server has not done yet is shown at once, and marked. Where it refuses, the
 * layer is as it was again.
 */

import { computed, signal } from "@preact/signals";

import type { LayerInfo, LayerSet } from "../messages";
import { NewestOnly } from "./newest-only";
import { painting, state } from "./store";
import { run } from "../editor/editor";

type Fields = Omit<LayerSet, "layer">;
type Change = { layer: string; fields: Fields } | { layer: string; to: number };

const changes = signal<readonly Change[]>([]);

/** From bottom to top, with what is under way. */
export const shownLayers = computed<LayerInfo[]>(() => {
  let layers = state.value?.layers ?? [];
  for (const change of changes.value) {
    if ("to" in change) layers = moved(layers, change.layer, change.to);
    else layers = layers.map((one) => (one.id === change.layer ? { ...one, ...given(change.fields) } : one));
  }
  return layers;
});

/** Whether something about a layer is under way. */
export const isPending = (layer: string): boolean =>
  painting.value.includes(layer) || changes.value.some((change) => change.layer === layer);

async function during<T>(change: Change, work: Promise<T>): Promise<T> {
  changes.value = [...changes.value, change];
  try {
    return await work;
  } finally {
    changes.value = changes.value.filter((one) => one !== change);
  }
}

/** Change a layer; `what` says so where it takes a while. */
export const setLayer = (layer: string, fields: Fields, what: string) =>
  during({ layer, fields }, run("layer.set", { layer, ...fields }, what));

export const moveLayer = (layer: string, to: number, what: string) =>
  during({ layer, to }, run("layer.move", { layer, to }, what));

/**
 * A slider that is dragged: one command at a time, the latest value last, one step of the history. Several layers: each gets
 * the same.
 */
export function dragged(layers: string | readonly string[], what: string): (fields: Fields) => Promise<void> {
  const gesture = `${what} ${Math.random().toString(36).slice(2)}`;
  let sent = "";
  const changes = new NewestOnly<Fields>(async (fields) => {
    if (JSON.stringify(fields) === sent) return; // let go where it was
    sent = JSON.stringify(fields);
    for (const layer of typeof layers === "string" ? [layers] : layers)
      await setLayer(layer, { ...fields, gesture }, what);
  });
  return (fields) => changes.add(fields);
}

function moved(layers: LayerInfo[], layer: string, to: number): LayerInfo[] {
  const one = layers.find((other) => other.id === layer);
  if (!one) return layers;
  const rest = layers.filter((other) => other !== one);
  return [...rest.slice(0, to), one, ...rest.slice(to)];
}

/** The fields of a layer that a command names. */
function given({ name, visible, opacity, blend }: Fields): Partial<LayerInfo> {
  const fields = { name, visible, opacity, blend };
  return Object.fromEntries(
    Object.entries(fields).filter(([, value]) => value !== undefined && value !== null),
  ) as Partial<LayerInfo>;
}
