import { expect, it } from "vitest";

import { storageWords } from "../src/state/storage";

it.each([
  [
    "a.splatproj: the disk is full, and nothing was changed",
    1,
    "full. The stroke is kept, and saved as soon as there is room.",
  ],
  [
    "a.splatproj: was deleted or moved, and nothing was changed",
    2,
    "moved. 2 strokes are kept, and saved as soon as the project can be written again, or is saved elsewhere.",
  ],
  ["a.splatproj: cannot be read or written (no locks); nothing was changed", 0, "(no locks). Nothing was changed."],
])("a project that cannot be saved: %s", (message, drawn, end) => {
  const words = storageWords(message, drawn);
  expect(words.startsWith("The project cannot be saved where it is: a.splatproj: ")).toBe(true);
  expect(words.endsWith(end), words).toBe(true);
});
