/**
 * Names of keys: "B", "Ctrl-Shift-I", "Shift-[", "Num7". Control and Command are both "Ctrl". Keys of the number pad
 * have names of their own, whatever NumLock makes of them ("Num." is never "Delete"). Pure.
 */

export interface KeyPress {
  key: string;
  code: string;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
  shiftKey: boolean;
  getModifierState?: (name: string) => boolean;
}

const PAD: Record<string, string> = {
  Decimal: ".",
  Comma: ",",
  Add: "+",
  Subtract: "-",
  Multiply: "*",
  Divide: "/",
  Enter: "Enter",
  Equal: "=",
};
const MODIFIERS = ["Control", "Shift", "Alt", "Meta", "AltGraph", "CapsLock", "NumLock", "Dead", "Process"];
const BRACKETS: Record<string, string> = { "{": "[", "}": "]" };

/** Chords that browsers do not give to pages. */
export const BROWSER_CHORDS: readonly string[] = [
  "Ctrl-T",
  "Ctrl-N",
  "Ctrl-W",
  "Ctrl-Q",
  "Ctrl-Shift-T",
  "Ctrl-Shift-N",
  "Ctrl-Shift-W",
  "Ctrl-Tab",
  "Ctrl-Shift-Tab",
  "F11",
];

/** The name of what was pressed; "" for a modifier alone. */
export function chordOf(press: KeyPress): string {
  if (MODIFIERS.includes(press.key) || !press.key) return "";
  const third = press.getModifierState?.("AltGraph") ?? false; // Ctrl and Alt only stand for it then
  const control = (press.ctrlKey || press.metaKey) && !third;
  const alt = press.altKey && !third;
  let shift = press.shiftKey;
  let name: string;
  const pad = /^Numpad(.+)$/.exec(press.code);
  const digit = /^Digit([0-9])$/.exec(press.code);
  if (pad) name = `Num${PAD[pad[1]] ?? pad[1]}`;
  else if (/^[0-9]$/.test(press.key)) {
    name = press.key;
    shift = false; // of keyboards where digits take Shift
  } else if (digit && shift && !third) name = digit[1];
  else if (/^\p{L}$/u.test(press.key)) {
    const latin = /^[a-z]$/i.test(press.key) ? press.key : (/^Key([A-Z])$/.exec(press.code)?.[1] ?? press.key);
    name = latin.toUpperCase();
  } else if (press.key in BRACKETS) name = BRACKETS[press.key];
  else if (press.key === "[" || press.key === "]") {
    name = press.key;
    if (!press.code.startsWith("Bracket")) shift = false; // of keyboards where it takes another key to write it
  } else if (press.key.length === 1 && press.key !== " ") {
    name = press.key;
    shift = false; // it is in the character: "?"
  } else name = press.key === " " ? "Space" : press.key;
  return [control && "Ctrl", alt && "Alt", shift && "Shift", name].filter(Boolean).join("-");
}

const SYMBOLS: Record<string, string> = {
  ArrowLeft: "←",
  ArrowRight: "→",
  ArrowUp: "↑",
  ArrowDown: "↓",
  Escape: "Esc",
};

/** As people read it. */
export function spoken(chord: string): string {
  const at = /^((?:Ctrl-|Alt-|Shift-)*)(.+)$/.exec(chord);
  if (!at) return chord;
  return at[1] + (SYMBOLS[at[2]] ?? at[2].replace(/^Num(?=.)/, "Numpad "));
}
