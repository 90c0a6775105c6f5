/** Which keys the commands have now: those of the table, and those that were changed, which this browser remembers. */

import { computed, signal } from "@preact/signals";

import { BROWSER_CHORDS } from "./chord";
import { COMMANDS, type CommandId } from "./table";

const STORE = "splatpainter.shortcuts";
const MAX_KEYS = 4;
const IDS = new Set<string>(COMMANDS.map(({ id }) => id));

export type Changed = Partial<Record<CommandId, readonly string[]>>;

/** What was stored, as far as it makes sense. */
export function parseChanged(text: string | null): Changed {
  let data: unknown;
  try {
    data = JSON.parse(text ?? "{}");
  } catch {
    return {};
  }
  if (typeof data !== "object" || data === null || Array.isArray(data)) return {};
  const sound = (keys: unknown) =>
    Array.isArray(keys) && keys.length <= MAX_KEYS && keys.every((key) => typeof key === "string" && key.length < 40);
  return Object.fromEntries(Object.entries(data).filter(([id, keys]) => IDS.has(id) && sound(keys))) as Changed;
}

function stored(): Changed {
  try {
    return parseChanged(localStorage.getItem(STORE));
  } catch {
    return {}; // no storage: private windows of some browsers, tests
  }
}

export const changed = signal<Changed>(stored());

/** Keys of a command, the first one for tooltips. */
export function keysIn(changes: Changed, id: CommandId): readonly string[] {
  return changes[id] ?? COMMANDS.find((command) => command.id === id)!.keys;
}

/** What a chord does. Where two commands have it, the one that was changed; else the first of the table. */
export function commandOf(changes: Changed, chord: string): CommandId | null {
  const all = COMMANDS.filter(({ id }) => keysIn(changes, id).includes(chord)).map(({ id }) => id);
  return all.find((id) => changes[id]) ?? all[0] ?? null;
}

/** With one more chord on a command, taken from whichever had it. */
export function withKey(changes: Changed, id: CommandId, chord: string): Changed {
  const before = commandOf(changes, chord);
  const without: Changed =
    before && before !== id
      ? { ...changes, [before]: keysIn(changes, before).filter((key) => key !== chord) }
      : { ...changes };
  const keys = keysIn(without, id).filter((key) => key !== chord);
  return { ...without, [id]: [chord, ...keys].slice(0, MAX_KEYS) };
}

/** Without the keys of a command. */
export const withoutKeys = (changes: Changed, id: CommandId): Changed => ({ ...changes, [id]: [] });

/** With a command's first keys again, taken from whichever has them now. */
export function asAtFirst(changes: Changed, id: CommandId): Changed {
  const keys = COMMANDS.find((command) => command.id === id)!.keys;
  const next = keys.reduceRight<Changed>((now, key) => withKey(now, id, key), { ...changes, [id]: [] });
  delete next[id];
  return next;
}

/** Why a chord cannot be used, or whose it is; "" where nothing is in the way. */
export function conflict(changes: Changed, id: CommandId, chord: string): { text: string; takes: CommandId | null } {
  if (BROWSER_CHORDS.includes(chord)) return { text: `Browsers keep ${chord} for themselves.`, takes: null };
  if (/^(Shift-)?[0-9]$/.test(chord)) return { text: "Digits set the opacity and the flow.", takes: null };
  if (chord === "Space") return { text: "Space turns the view while it is held.", takes: null };
  const owner = commandOf(changes, chord);
  if (!owner || owner === id) return { text: "", takes: null };
  return { text: `${chord} is ${COMMANDS.find((one) => one.id === owner)!.label}.`, takes: owner };
}

/** Change the keys, for good. */
export function change(next: Changed): void {
  changed.value = next;
  try {
    if (Object.keys(next).length) localStorage.setItem(STORE, JSON.stringify(next));
    else localStorage.removeItem(STORE);
  } catch {
    // they last as long as the page
  }
}

const table = computed(() => {
  const out = new Map<string, CommandId>();
  for (const { id } of COMMANDS)
    for (const chord of keysIn(changed.value, id))
      if (!out.has(chord)) out.set(chord, commandOf(changed.value, chord)!);
  return out;
});

export const commandFor = (chord: string): CommandId | null => table.value.get(chord) ?? null;
/** The key that a tooltip shows: the first one that a browser gives to pages; "" where there is none. */
export const keyOf = (id: CommandId): string =>
  keysIn(changed.value, id).find((chord) => !BROWSER_CHORDS.includes(chord)) ?? "";
export const labelOf = (id: CommandId): string => COMMANDS.find((command) => command.id === id)!.label;
