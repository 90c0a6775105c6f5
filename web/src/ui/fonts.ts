/** Fonts to write with: the browser's families, those of the computer where it may list them, and uploaded files. */

import { signal } from "@preact/signals";

export const fonts = signal<string[]>(["sans-serif", "serif", "monospace", "cursive"]);

interface LocalFont {
  family: string;
}

/** Ask for the computer's fonts (the browser asks the user). */
export async function systemFonts(): Promise<void> {
  const list = (await (window as unknown as { queryLocalFonts: () => Promise<LocalFont[]> }).queryLocalFonts()).map(
    (font) => font.family,
  );
  add([...new Set(list)].sort());
}

/** Use a font file; returns the family to name it by. Throws an Error for what is no font. */
export async function loadFont(file: File): Promise<string> {
  const family = file.name.replace(/\.[^.]*$/, "").replace(/[^\w -]/g, " ");
  const face = new FontFace(family, await file.arrayBuffer());
  await face.load().catch(() => {
    throw new Error(`${file.name} is not a font that this browser reads.`);
  });
  document.fonts.add(face);
  add([family]);
  return family;
}

function add(families: string[]): void {
  fonts.value = [...new Set([...families, ...fonts.value])];
}
