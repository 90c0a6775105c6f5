/** Where things stand, so that they stay there: a tool is one file, and what changes lives in something that owns it. */

import { describe, expect, it } from "vitest";

import { TOOLS } from "../src/tools";

/** Generated from the server, whose layers and strokes have kinds of the same names. */
const GENERATED = "messages.ts";
const SOURCES: Record<string, string> = import.meta.glob("../src/**/*.{ts,tsx}", {
  query: "?raw",
  import: "default",
  eager: true,
});
const FILES = Object.entries(SOURCES)
  .map(([path, text]) => ({ name: path.replace("../src/", ""), text }))
  .filter(({ name }) => name !== GENERATED);

/** Files that choose or ask for a tool by its name: compare `tool.value`, list tools, or have one's command. */
const naming = (tool: string): string[] => {
  const patterns = [
    new RegExp(`\\btool(\\.value)?\\s*(===|!==|=)\\s*"${tool}"`),
    new RegExp(`\\b(chooseTool|choose)\\("${tool}"`),
    new RegExp(`"tool\\.${tool}"`),
    new RegExp(`signal<Tool>\\("${tool}"\\)`),
    new RegExp(`^  name: "${tool}",`, "m"),
  ];
  return FILES.filter(({ text }) => patterns.some((one) => one.test(text))).map(({ name }) => name);
};

describe("a tool", () => {
  it.each(Object.keys(TOOLS))("is named in its own file: %s", (tool) => {
    const files = naming(tool).filter((name) => name !== "tools/tool.ts" && name !== "tools/index.ts");
    expect(files.filter((name) => !name.startsWith("tools/"))).toEqual([]);
    expect(files.length).toBe(1);
  });

  it("says its name as it is listed, and has a command with a key", () => {
    for (const [name, spec] of Object.entries(TOOLS)) {
      expect(spec.name).toBe(name);
      expect(spec.commands.length).toBeGreaterThan(0);
      for (const { id, keys } of spec.commands) expect([id.startsWith("tool."), keys.length > 0]).toEqual([true, true]);
    }
  });
});

it("few variables belong to nobody", () => {
  const free = FILES.flatMap(({ name, text }) =>
    [...text.matchAll(/^(?:export )?let (\w+)/gm)].map((match) => `${name}: ${match[1]}`),
  );
  expect(free.length, free.join("\n")).toBeLessThanOrEqual(12);
});
