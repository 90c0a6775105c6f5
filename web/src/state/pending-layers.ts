/**
 * Layers as they were asked to be: what the server has not done yet is shown at once, and marked. Where it refuses, the
 * layer is as it was again.
 */

import { computed } from "@preact/signals";

import type { LayerInfo, LayerSet } from "../messages";
import { NewestOnly } from "./newest-only";
import { painting, state } from "./store";
import { during, isUnderWay, withUnderWay } from "./under-way";
import { run } from "../editor/editor";

type Fields = Omit<LayerSet, "layer">;

const LIST = "layers";
const nameOf = (layer: string): string => `layer ${layer}`;

/** From bottom to top, with what is under way. */
export const shownLayers = computed<LayerInfo[]>(() =>
  withUnderWay(LIST, state.value?.layers ?? []).map((one) => withUnderWay(nameOf(one.id), one)),
);

/** Whether something about a layer is under way. */
export const isPending = (layer: string): boolean => painting.value.includes(layer) || isUnderWay(nameOf(layer));

/** Show a layer with other fields until `work` ends. */
export const duringLayer = <Done>(layer: string, fields: Partial<LayerInfo>, work: Promise<Done>): Promise<Done> =>
  during(nameOf(layer), (one: LayerInfo) => ({ ...one, ...fields }), work);

const send = (layer: string, fields: Fields, what: string) => run("layer.set", { layer, ...fields }, what);

/** Change a layer; `what` says so where it takes a while. */
export const setLayer = (layer: string, fields: Fields, what: string) =>
  during(nameOf(layer), given(fields), send(layer, fields, what));

export const moveLayer = (layer: string, to: number, what: string) => {
  const work = run("layer.move", { layer, to }, what);
  return during(
    LIST,
    (layers: LayerInfo[]) => moved(layers, layer, to),
    during(nameOf(layer), (one: LayerInfo) => one, work),
  );
};

/**
 * A slider that is dragged: one command at a time, the latest value last, one step of the history. Several layers: each gets
 * the same.
 */
export function dragged(layers: string | readonly string[], what: string): (fields: Fields) => Promise<void> {
  const gesture = `${what} ${Math.random().toString(36).slice(2)}`;
  const all = typeof layers === "string" ? [layers] : layers;
  let sent = "";
  const changes = new NewestOnly<Fields>(async (fields) => {
    if (JSON.stringify(fields) === sent) return; // let go where it was
    sent = JSON.stringify(fields);
    for (const layer of all) await send(layer, { ...fields, gesture }, what);
  });
  return (fields) => {
    // Also those that wait for their turn stand, so that nothing jumps back in between.
    const set = given(fields);
    return all.reduce((work, layer) => during(nameOf(layer), set, work), changes.add(fields));
  };
}

function moved(layers: LayerInfo[], layer: string, to: number): LayerInfo[] {
  const one = layers.find((other) => other.id === layer);
  if (!one) return layers;
  const rest = layers.filter((other) => other !== one);
  return [...rest.slice(0, to), one, ...rest.slice(to)];
}

/** A layer with the fields that a command names; of its options those that are given. */
const given =
  ({ name, visible, opacity, blend, parameters }: Fields) =>
  (one: LayerInfo): LayerInfo => ({
    ...one,
    name: name ?? one.name,
    visible: visible ?? one.visible,
    opacity: opacity ?? one.opacity,
    blend: blend ?? one.blend,
    parameters: parameters ? { ...one.parameters, ...parameters } : one.parameters,
  });
