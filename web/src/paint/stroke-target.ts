/** Where a stroke goes: into the chosen layer, into a mask, or into a layer of its own. */

import { brush, maskedLayer, selectedLayer, state } from "../state/store";
import type { LayerInfo } from "../messages";
import type { StrokeTarget } from "./stroke";

/** Name of a layer that a stroke makes; more of them are numbered. */
export const LAYER_OF_STROKES = "Paint";

const chosenLayer = (): LayerInfo | undefined => state.value?.layers.find((one) => one.id === selectedLayer.value);

/** The chosen layer, if it takes strokes. */
export function chosenPaintLayer(): LayerInfo | null {
  const layer = chosenLayer();
  return layer && layer.strokes !== null ? layer : null;
}

/** The chosen layer, if strokes back to the original can go on in it; from another view they make a new one. */
export function chosenEraser(): LayerInfo | null {
  const layer = chosenLayer();
  const fits = layer?.kind === "erase" && layer.visible && layer.opacity === brush.value.opacity;
  return fits ? layer : null;
}

/** The layer whose mask is being painted, while it is the chosen one. */
export function chosenMask(): LayerInfo | null {
  const layer = state.value?.layers.find((one) => one.id === maskedLayer.value);
  return layer?.mask && layer.id === selectedLayer.value ? layer : null;
}

/**
 * The paint layer that a stroke makes while no paint layer is chosen: the strokes that are drawn before its answer comes
 * go there too.
 */
export class FirstPaintLayer {
  private made: { chosen: string | null; session: string; layer: string } | null = null;

  /** Where a stroke that begins now will go, asked when those before it are committed. `unused`: a name for a new layer. */
  target(unused: (name: string) => string): { ask: () => StrokeTarget; note: (layer: string) => void } {
    const [chosen, session] = [selectedLayer.value, state.value!.session];
    const note = (layer: string) => void (this.made = { chosen, session, layer });
    const painted = chosenPaintLayer();
    if (painted) return { ask: () => ({ layer: painted.id }), note };
    const ask = () => {
      const { made } = this;
      const exists = made && state.value?.layers.some((one) => one.id === made.layer);
      if (exists && made.session === session && made.chosen === chosen) return { layer: made.layer };
      return { into_new: unused(LAYER_OF_STROKES) };
    };
    return { ask, note };
  }
}
