/** Words as a picture, in the chosen font and colour, and where the caret in them is. */

import { effect, signal } from "@preact/signals";

import { color, text } from "../state/store";
import { handles, laying, placement, type Placement } from "./placement";

/** Where the words of a text are written: the place of the caret in them; null: nobody writes. */
export const caret = signal<number | null>(null);
/** Gives the keys to the words; set by whoever shows their field. select: all of them, to be replaced. */
export const words: { focus: (select: boolean) => void } = { focus: () => {} };

/** Height of a line, and where the middle of the first one is, of the letters' size. */
const LINE = 1.25;
const FIRST_MIDDLE = 0.72;

/** The CSS font of the text as it is set. */
function textFont(): string {
  const { font, size, bold, italic } = text.value;
  const family = JSON.stringify(font).replace(/^"(serif|sans-serif|monospace|cursive)"$/, "$1");
  return `${italic ? "italic " : ""}${bold ? "bold " : ""}${size}px ${family}`;
}

/** The text in its font and colour on a canvas that just holds it. */
export function textImage(): HTMLCanvasElement {
  const { text: written, size } = text.value;
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d")!;
  const lines = (written || " ").split("\n");
  context.font = textFont();
  const width = Math.max(...lines.map((line) => context.measureText(line).width));
  canvas.width = Math.ceil(width + size * 0.4);
  canvas.height = Math.ceil(size * LINE * lines.length + size * 0.2);
  context.font = textFont();
  context.textBaseline = "middle";
  context.textAlign = "center";
  context.fillStyle = color.value;
  lines.forEach((line, k) => context.fillText(line, canvas.width / 2, size * (FIRST_MIDDLE + LINE * k)));
  return canvas;
}

/** The two ends of the caret in the words that are being written, view pixels; null: there is none. */
export function caretLine(p: Placement): [number, number, number, number] | null {
  const at = caret.value;
  if (at === null || p.kind !== "text" || laying.value) return null;
  const context = (p.image as HTMLCanvasElement).getContext("2d")!;
  const { text: written, size } = text.value;
  const before = written.slice(0, at).split("\n");
  const line = written.split("\n")[before.length - 1];
  const { width, height } = p.image;
  const x = (width - context.measureText(line).width) / 2 + context.measureText(before.at(-1)!).width;
  const middle = size * (FIRST_MIDDLE + LINE * (before.length - 1));
  const [leftUpper, rightUpper, rightLower, leftLower] = handles(p).corners;
  const toView = (u: number, v: number): [number, number] =>
    [0, 1].map((k) => {
      const [above, below] = [
        leftUpper[k] + (rightUpper[k] - leftUpper[k]) * u,
        leftLower[k] + (rightLower[k] - leftLower[k]) * u,
      ];
      return above + (below - above) * v;
    }) as [number, number];
  return [...toView(x / width, (middle - 0.55 * size) / height), ...toView(x / width, (middle + 0.55 * size) / height)];
}

effect(() => {
  // the settings or the colour changed while a text is being placed
  void [text.value, color.value];
  const p = placement.peek();
  if (p?.kind === "text") placement.value = { ...p, image: textImage() };
});
