import { describe, expect, it } from "vitest";

import { asAtFirst, commandOf, conflict, keysIn, parseChanged, withKey, withoutKeys } from "../src/keys/bindings";
import { chordOf, spoken } from "../src/keys/chord";
import { COMMANDS } from "../src/keys/table";

const press = (key: string, code: string, ...modifiers: string[]) =>
  chordOf({
    key,
    code,
    ctrlKey: modifiers.includes("Ctrl"),
    metaKey: modifiers.includes("Meta"),
    altKey: modifiers.includes("Alt"),
    shiftKey: modifiers.includes("Shift"),
    getModifierState: (name) => modifiers.includes(name),
  });

describe("names of keys", () => {
  it("does not depend on case, CapsLock or the layout", () => {
    expect(press("b", "KeyB")).toBe("B");
    expect(press("B", "KeyB")).toBe("B"); // CapsLock
    expect(press("I", "KeyI", "Ctrl", "Shift")).toBe("Ctrl-Shift-I");
    expect(press("z", "KeyW", "Meta")).toBe("Ctrl-Z"); // where Z lies elsewhere
    expect(press("и", "KeyB")).toBe("B"); // Cyrillic
    expect(press("4", "Digit4", "Shift")).toBe("4"); // where digits take Shift
    expect(press("$", "Digit4", "Shift")).toBe("Shift-4");
    expect(press("{", "BracketLeft", "Shift")).toBe("Shift-[");
    expect(press("[", "Digit8", "Ctrl", "Alt", "AltGraph")).toBe("[");
    expect(press("?", "Slash", "Shift")).toBe("?");
    expect(press("Shift", "ShiftLeft", "Shift")).toBe("");
  });

  it("tells the number pad from everything else, whatever NumLock says", () => {
    expect(press(".", "NumpadDecimal")).toBe("Num.");
    expect(press("Delete", "NumpadDecimal")).toBe("Num.");
    expect(press("End", "Numpad1")).toBe("Num1");
    expect(press("1", "Numpad1", "Ctrl")).toBe("Ctrl-Num1");
    expect(press("1", "Digit1")).toBe("1");
    expect(spoken("Ctrl-Num1")).toBe("Ctrl-Numpad 1");
    expect(spoken("ArrowLeft")).toBe("←");
  });
});

describe("bindings", () => {
  it("starts without a conflict, and the number pad's point deletes nothing", () => {
    const all = COMMANDS.flatMap(({ keys }) => keys);
    expect(new Set(all).size).toBe(all.length);
    expect(commandOf({}, "Num.")).toBe("view.focus");
    expect(commandOf({}, "Delete")).toBe("edit.delete");
    for (const { id } of COMMANDS) expect(keysIn({}, id).length).toBeGreaterThan(0);
  });

  it("has Photoshop's keys", () => {
    const expected = {
      B: "brush",
      E: "erase",
      G: "fill",
      T: "text",
      I: "pick",
      M: "rectangle",
      L: "lasso",
      S: "clone",
    };
    for (const [key, tool] of Object.entries(expected)) expect(commandOf({}, key)).toBe(`tool.${tool}`);
    expect(commandOf({}, "X")).toBe("color.swap");
    expect(commandOf({}, "Ctrl-J")).toBe("layer.duplicate");
    expect(commandOf({}, "Ctrl-Shift-I")).toBe("select.invert");
  });

  it("says whose a key is, takes it over, and gives it back", () => {
    expect(conflict({}, "tool.fill", "B")).toEqual({ text: "B is Brush.", takes: "tool.brush" });
    expect(conflict({}, "tool.fill", "Ctrl-T").takes).toBeNull();
    expect(conflict({}, "tool.fill", "Ctrl-T").text).toContain("Browsers");
    expect(conflict({}, "tool.fill", "7").text).toContain("opacity");
    expect(conflict({}, "tool.fill", "G").text).toBe("");
    const taken = withKey({}, "tool.fill", "B");
    expect(commandOf(taken, "B")).toBe("tool.fill");
    expect(keysIn(taken, "tool.brush")).toEqual([]);
    expect(commandOf(taken, "G")).toBe("tool.fill"); // its first key works as well
    const back = asAtFirst(taken, "tool.brush");
    expect(commandOf(back, "B")).toBe("tool.brush");
    expect(back).toEqual({ "tool.fill": ["G"] });
    expect(asAtFirst(back, "tool.fill")).toEqual({});
    expect(commandOf(withoutKeys({}, "help"), "?")).toBeNull();
  });

  it("takes from the store only what makes sense", () => {
    expect(parseChanged('{"tool.fill": ["Z"], "gone": ["A"], "tool.text": [3], "help": "x"}')).toEqual({
      "tool.fill": ["Z"],
    });
    for (const text of [null, "", "[", "3", "[1]", "null"]) expect(parseChanged(text)).toEqual({});
  });
});
