/** What this browser remembers of a person's tools: brushes and colours. Nothing of it belongs to a project. */

import { effect, signal, type Signal } from "@preact/signals";

import { parsePresets, presetsText, type Preset } from "../paint/brush-settings";

const COLOR = /^#[0-9a-f]{6}$/;
export const MAX_SWATCHES = 60;

/** Colours of a stored text, as far as it makes sense. */
export function parseColors(text: string | null): string[] {
  let data: unknown;
  try {
    data = JSON.parse(text ?? "[]");
  } catch {
    return [];
  }
  if (!Array.isArray(data)) return [];
  const colors = data.filter((one): one is string => typeof one === "string" && COLOR.test(one));
  return [...new Set(colors)].slice(0, MAX_SWATCHES);
}

/** A signal that starts as it was stored and is stored when it changes. */
function remembered<T>(key: string, parse: (text: string | null) => T, write: (value: T) => string): Signal<T> {
  let text: string | null = null;
  try {
    text = localStorage.getItem(key);
  } catch {
    // no storage: private windows of some browsers, tests
  }
  const value = signal(parse(text));
  let first = true;
  effect(() => {
    const next = write(value.value);
    if (first) return void (first = false);
    try {
      localStorage.setItem(key, next);
    } catch {
      // as above, or full
    }
  });
  return value;
}

function parseStored(text: string | null): Preset[] {
  try {
    return text === null ? [] : parsePresets(text);
  } catch {
    return [];
  }
}

export const presets = remembered<Preset[]>("splatpainter.brushes", parseStored, presetsText);
export const swatches = remembered<string[]>("splatpainter.swatches", parseColors, (colors) => JSON.stringify(colors));
