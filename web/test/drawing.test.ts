import { describe, expect, it } from "vitest";

import { Drawing, NO_PRESSURE, UNPRESSED_SAMPLES, type PenKnowledge } from "../src/tools/drawing";
import type { Pen, ToolGesture } from "../src/tools/tool";

const pen = (x: number, pressure: number): Pen => ({ x, y: 0, pressure, shift: false, alt: false });

/** A tool that notes what it is given. */
function noting(): { handler: ToolGesture; notes: string[] } {
  const notes: string[] = [];
  const note = (what: string) => (at: Pen) => void notes.push(`${what} ${at.x} ${at.pressure}`);
  const handler = { down: note("down"), move: note("move"), up: note("up"), cancel: () => void notes.push("cancel") };
  return { handler, notes };
}

/** One drag of a pen; what the tool got. */
function drag(knowledge: PenKnowledge, pressures: number[], isPen = true): string[] {
  const { handler, notes } = noting();
  const drawing = new Drawing(handler, pen(0, pressures[0]), isPen, knowledge);
  pressures.slice(1).forEach((pressure, k) => drawing.move(pen(k + 1, pressure)));
  drawing.up(pen(pressures.length, 0));
  return notes;
}

describe("pressure of a pen", () => {
  it("begins with the 0 of its first contact, not with a half", () => {
    const knowledge: PenKnowledge = { pressed: null };
    expect(drag(knowledge, [0, 0.04, 0.04])).toEqual(["down 0 0", "move 1 0.04", "move 2 0.04", "up 3 0.04"]);
    expect(knowledge.pressed).toBe(true);
    expect(drag(knowledge, [0, 0, 0, 0, 0, 0, 0, 0])[0]).toBe("down 0 0"); // it is pressed lightly, no other pen
  });

  it("is taken as a half where it is 0 all the time, for the first stroke already and at once for the next", () => {
    const knowledge: PenKnowledge = { pressed: null };
    const first = drag(knowledge, Array<number>(UNPRESSED_SAMPLES + 3).fill(0));
    expect(first.length).toBe(UNPRESSED_SAMPLES + 4);
    expect(first.every((note) => note.endsWith(String(NO_PRESSURE)))).toBe(true);
    const { handler, notes } = noting();
    const second = new Drawing(handler, pen(0, 0), true, knowledge);
    expect(notes).toEqual([`down 0 ${NO_PRESSURE}`]);
    second.move(pen(1, 0.2));
    expect(notes[1]).toBe("move 1 0.2");
    expect(knowledge.pressed).toBe(true);
  });

  it("of a tap that says nothing is a half; mice and fingers are taken as they are", () => {
    expect(drag({ pressed: null }, [0])).toEqual([`down 0 ${NO_PRESSURE}`, `up 1 ${NO_PRESSURE}`]);
    expect(drag({ pressed: null }, [1, 1], false)).toEqual(["down 0 1", "move 1 1", "up 2 1"]);
  });
});

describe("the end of a drag", () => {
  it("is where it was last, when the pointer is taken away", () => {
    const { handler, notes } = noting();
    const drawing = new Drawing(handler, pen(0, 0.5), true, { pressed: true });
    drawing.move(pen(4, 0.7));
    drawing.up();
    expect(notes.at(-1)).toBe("up 4 0.7");
  });

  it("takes back what was begun, and nothing where nothing was", () => {
    const one = noting();
    const drawing = new Drawing(one.handler, pen(0, 0), true, { pressed: null });
    drawing.cancel();
    expect(one.notes).toEqual([]);
    const two = noting();
    new Drawing(two.handler, pen(0, 0.5), true, { pressed: null }).cancel();
    expect(two.notes).toEqual(["down 0 0.5", "cancel"]);
  });
});
