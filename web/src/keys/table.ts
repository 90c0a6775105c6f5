/**
 * Every command that has a key: its name, what it is called, and the keys that it has at first, which are those of
 * Photoshop where that has the same command; those of the tools stand with these. The one source for key handling,
 * tooltips and the sheet of shortcuts. Names of keys are those of `chord.ts`.
 */

import { ALL_TOOLS } from "../tools";
import type { ToolCommand } from "../tools/tool";

export type Group = "Tools" | "Colour and brush" | "View" | "Selection" | "Layers" | "Edit";

interface Entry {
  id: string;
  group: Group;
  label: string;
  keys: readonly string[];
}

const TABLE = [
  { id: "color.swap", group: "Colour and brush", label: "Swap the two colours", keys: ["X"] },
  { id: "color.default", group: "Colour and brush", label: "Black and white", keys: ["D"] },
  { id: "brush.smaller", group: "Colour and brush", label: "Smaller", keys: ["["] },
  { id: "brush.larger", group: "Colour and brush", label: "Larger", keys: ["]"] },
  { id: "brush.softer", group: "Colour and brush", label: "Softer", keys: ["Shift-["] },
  { id: "brush.harder", group: "Colour and brush", label: "Harder", keys: ["Shift-]"] },

  { id: "view.all", group: "View", label: "Show all of the asset", keys: ["F", "Home"] },
  { id: "view.home", group: "View", label: "First view: the front", keys: ["Num0"] },
  { id: "view.focus", group: "View", label: "Look at what is under the cursor", keys: [".", "Num."] },
  { id: "view.front", group: "View", label: "From the front", keys: ["Num1"] },
  { id: "view.back", group: "View", label: "From the back", keys: ["Ctrl-Num1"] },
  { id: "view.right", group: "View", label: "From the right", keys: ["Num3"] },
  { id: "view.left", group: "View", label: "From the left", keys: ["Ctrl-Num3"] },
  { id: "view.top", group: "View", label: "From above", keys: ["Num7"] },
  { id: "view.bottom", group: "View", label: "From below", keys: ["Ctrl-Num7"] },
  { id: "view.nearer", group: "View", label: "Zoom in", keys: ["Num+"] },
  { id: "view.farther", group: "View", label: "Zoom out", keys: ["Num-"] },
  { id: "view.turnleft", group: "View", label: "Turn left", keys: ["ArrowLeft", "Num4"] },
  { id: "view.turnright", group: "View", label: "Turn right", keys: ["ArrowRight", "Num6"] },
  { id: "view.turnup", group: "View", label: "Turn up", keys: ["ArrowUp", "Num8"] },
  { id: "view.turndown", group: "View", label: "Turn down", keys: ["ArrowDown", "Num2"] },
  { id: "view.grid", group: "View", label: "Grid", keys: ["'", "Ctrl-'"] },
  { id: "view.truecolor", group: "View", label: "True colour: the server's float render", keys: ["Y"] },
  { id: "view.compare", group: "View", label: "Before and after", keys: ["\\"] },
  { id: "view.coverage", group: "View", label: "Coverage: seen and predicted", keys: ["K"] },

  { id: "select.all", group: "Selection", label: "Select everything", keys: ["Ctrl-A"] },
  { id: "select.none", group: "Selection", label: "Deselect", keys: ["Ctrl-D"] },
  { id: "select.again", group: "Selection", label: "Reselect", keys: ["Ctrl-Shift-D"] },
  { id: "select.invert", group: "Selection", label: "Invert the selection", keys: ["Ctrl-Shift-I", "Shift-F7"] },
  { id: "select.tint", group: "Selection", label: "Tint what is selected", keys: ["Ctrl-H"] },
  { id: "select.hide", group: "Selection", label: "Hide what is not selected", keys: ["Shift-Delete"] },
  {
    id: "select.fill",
    group: "Selection",
    label: "Remove what is selected, and fill",
    keys: ["Shift-F5", "Shift-Backspace"],
  },

  { id: "layer.duplicate", group: "Layers", label: "Duplicate the layer", keys: ["Ctrl-J"] },
  { id: "layer.merge", group: "Layers", label: "Merge with the layer below", keys: ["Ctrl-E"] },
  { id: "layer.raise", group: "Layers", label: "Move the layer up", keys: ["Ctrl-]"] },
  { id: "layer.lower", group: "Layers", label: "Move the layer down", keys: ["Ctrl-["] },
  { id: "layer.above", group: "Layers", label: "Choose the layer above", keys: ["Alt-]"] },
  { id: "layer.below", group: "Layers", label: "Choose the layer below", keys: ["Alt-["] },

  { id: "edit.undo", group: "Edit", label: "Undo", keys: ["Ctrl-Z"] },
  { id: "edit.redo", group: "Edit", label: "Redo", keys: ["Ctrl-Shift-Z", "Ctrl-Y"] },
  {
    id: "edit.delete",
    group: "Edit",
    label: "Hide what is selected, else delete the layer",
    keys: ["Delete", "Backspace"],
  },
  { id: "edit.transform", group: "Edit", label: "Free transform of the layer", keys: ["Shift-T", "Ctrl-T"] },
  { id: "edit.apply", group: "Edit", label: "Apply text, stamp or transform", keys: ["Enter", "NumEnter"] },
  { id: "edit.cancel", group: "Edit", label: "Cancel the current action", keys: ["Escape"] },
  { id: "file.open", group: "Edit", label: "Open", keys: ["Ctrl-O"] },
  { id: "file.save", group: "Edit", label: "Save, export", keys: ["Ctrl-S"] },
  { id: "file.batch", group: "Edit", label: "Batch: other assets, variants", keys: ["Ctrl-B"] },
  { id: "help", group: "Edit", label: "Shortcuts", keys: ["?"] },
] as const satisfies readonly Entry[];

export type CommandId = (typeof TABLE)[number]["id"] | ToolCommand["id"];

export interface Command extends Entry {
  id: CommandId;
}

const TOOL_COMMANDS = ALL_TOOLS.flatMap(({ commands }) =>
  commands.map(({ id, label, keys }): Command => ({ id, group: "Tools", label, keys })),
);
export const COMMANDS: readonly Command[] = [...TOOL_COMMANDS, ...TABLE];
export const GROUPS: readonly Group[] = [...new Set(COMMANDS.map(({ group }) => group))];

/** What the mouse, the pen, fingers and held keys do: listed in the sheet, not to be changed. */
export const GESTURES: readonly (readonly [Group, string, string])[] = [
  ["Tools", "Alt-click", "Take a colour; set the source of clone and heal"],
  ["Tools", "Pen's other end", "Eraser"],
  ["Colour and brush", "1 to 9, 0", "Opacity 10 % to 100 %; two digits quickly: 45 %"],
  ["Colour and brush", "Shift-1 to 0", "Flow"],
  ["Edit", "Arrows, with Shift", "Move the text or picture that is placed by 1 or 10 pixels"],
  ["View", "Space-drag, Alt-drag", "Turn about the point under the cursor"],
  ["View", "Right drag", "Turn in any tool"],
  ["View", "Middle or Shift-drag", "Slide (Shift: with Space or in the turn tool)"],
  ["View", "Right button + W A S D", "Fly; Q and E down and up, Shift faster, wheel: speed"],
  ["View", "Wheel", "Zoom to what is under the cursor"],
  ["View", "Double click", "Look at that point (turn tool, right button, Alt)"],
  ["View", "Two fingers", "Turn is one finger; pinch and slide are two"],
  ["Selection", "Shift, Alt, both", "Add to the selection, subtract, intersect"],
  ["Layers", "F2", "Rename the layer in focus"],
  ["Layers", "Alt-↑ Alt-↓", "Move the layer in focus"],
];
