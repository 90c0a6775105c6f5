/** The keyboard. */

import { viewPixels } from "../paint/strokes";
import { commitPlacement, placement } from "../paint/placement";
import { invert, rectangle } from "../paint/select";
import { deselect, selection } from "../paint/selection";
import { brush, help, readOnly, selectedLayer, view } from "../state/store";
import { report, run } from "../state/studio";
import { filesOpen, frameAll, redo, undo } from "./header";
import { cancelDrawing, spaceHeld, turnBy } from "./stage";
import { chooseTool, TOOLS } from "./toolbar";

export const SHORTCUTS: readonly (readonly [string, readonly (readonly [string, string])[]])[] = [
  [
    "Tools",
    [
      ...TOOLS.map(([, label, key]) => [key, label] as const),
      ["[ or ]", "Smaller, larger"],
      ["Shift-[ or Shift-]", "Softer, harder"],
      ["Alt-click", "Take a colour; set the source of clone and heal"],
      ["Enter", "Apply text or stamp"],
      ["Esc", "Cancel what is under way"],
    ],
  ],
  [
    "View",
    [
      ["Space", "Hold and drag: turn the view"],
      ["Shift-drag", "Slide (with Space, or in the turn tool)"],
      ["Wheel", "Nearer, farther"],
      ["← or → or ↑ or ↓", "Turn"],
      ["F", "Show all of the asset"],
      ["G", "Grid"],
      ["T", "True colour"],
      ["B", "Before and after"],
      ["C", "Coverage"],
    ],
  ],
  [
    "Edit",
    [
      ["Ctrl-Z", "Undo"],
      ["Ctrl-Shift-Z", "Redo"],
      ["Ctrl-A", "Select everything"],
      ["Ctrl-D", "Deselect"],
      ["Ctrl-Shift-I", "Invert the selection"],
      ["Delete", "Delete the chosen layer"],
      ["F2", "Rename the layer in focus"],
      ["Alt-↑ or Alt-↓", "Move the layer in focus"],
      ["Ctrl-O", "Open"],
      ["Ctrl-S", "Save, export"],
      ["?", "This sheet"],
    ],
  ],
];

const RESIZE_FACTOR = 1.12;
const TURN_RADIANS = Math.PI / 24;

const toggle = (key: "grid" | "trueColor" | "compare" | "coverage") => () =>
  (view.value = { ...view.value, [key]: !view.value[key] });
const resize = (factor: number) => () =>
  (brush.value = { ...brush.value, size: Math.max(1, Math.min(600, brush.value.size * factor)) });
const harden = (by: number) => () =>
  (brush.value = { ...brush.value, hardness: Math.max(0, Math.min(1, brush.value.hardness + by)) });

const PLAIN: Record<string, () => void> = {
  ...Object.fromEntries(
    TOOLS.map(([key, , name]) => [
      name.toLowerCase(),
      () => void ((!readOnly.value || ["orbit", "pick", "select"].includes(key)) && chooseTool(key)),
    ]),
  ),
  "[": resize(1 / RESIZE_FACTOR),
  "]": resize(RESIZE_FACTOR),
  "{": harden(-0.1),
  "}": harden(0.1),
  f: frameAll,
  g: toggle("grid"),
  t: toggle("trueColor"),
  b: toggle("compare"),
  c: toggle("coverage"),
  "?": () => (help.value = true),
  enter: () => placement.value && void commitPlacement(),
  escape: cancelDrawing,
  delete: () =>
    selectedLayer.value && !readOnly.value && void run("layer.delete", { layer: selectedLayer.value }, "Deleting"),
};

const ARROWS: Record<string, readonly [number, number]> = {
  ArrowLeft: [TURN_RADIANS, 0],
  ArrowRight: [-TURN_RADIANS, 0],
  ArrowUp: [0, TURN_RADIANS],
  ArrowDown: [0, -TURN_RADIANS],
};

const WITH_CONTROL: Record<string, () => void> = {
  z: undo,
  "shift-z": redo,
  y: redo,
  d: deselect,
  a: () =>
    void viewPixels().then(
      ({ width, height }) => (selection.value = rectangle(width, height, { x: 0, y: 0, width, height })),
      report,
    ),
  "shift-i": () => selection.value && (selection.value = invert(selection.value)),
  o: () => (filesOpen.value = "open"),
  s: () => (filesOpen.value = "save"),
};

/** Whether the key belongs to a field that is being written in. */
function writing(target: EventTarget | null): boolean {
  const element = target as HTMLElement | null;
  return (
    !!element &&
    (/^(textarea|select)$/i.test(element.tagName) ||
      (element.tagName === "INPUT" && !/^(range|checkbox|color|file)$/.test((element as HTMLInputElement).type)))
  );
}

export function listen(): void {
  window.addEventListener("keydown", (event) => {
    if (writing(event.target) || document.querySelector("dialog[open]")) return;
    const control = event.ctrlKey || event.metaKey;
    const key = event.key.toLowerCase();
    const onButton = (event.target as HTMLElement).closest?.("button, input, [role=option], [role=slider]");
    if (event.key === " ") {
      if (onButton) return; // space presses it
      spaceHeld.value = true;
      return event.preventDefault();
    }
    if (event.key in ARROWS) {
      if (onButton || control || event.altKey) return;
      turnBy(...ARROWS[event.key]);
      return event.preventDefault();
    }
    if (key === "enter" && onButton) return;
    const action = control
      ? WITH_CONTROL[event.shiftKey ? `shift-${key}` : key]
      : event.altKey
        ? undefined
        : PLAIN[key];
    if (!action) return;
    event.preventDefault();
    action();
  });
  window.addEventListener("keyup", (event) => event.key === " " && (spaceHeld.value = false));
  window.addEventListener("blur", () => (spaceHeld.value = false));
}
