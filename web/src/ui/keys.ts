/** The keyboard: what each command of `keys/table.ts` does. */

import { chordOf } from "../keys/chord";
import { commandFor } from "../keys/bindings";
import type { CommandId } from "../keys/table";
import { resizeBrush } from "../paint/brush-settings";
import { commitPlacement, deletePlacement } from "../paint/lay-placement";
import { laying, placement } from "../paint/placement";
import { tinted } from "../paint/selected";
import { changeSelection, deselect, fillSelected, hideSelected, withSelection } from "../paint/selection";
import { words } from "../paint/text-image";
import { brush, help, pose, readOnly, secondColor, selectedLayer, setColor, state, view } from "../state/store";
import { batchOpen } from "../state/batch";
import { glide, homePose } from "../editor/camera-moves";
import { report, run } from "../editor/editor";
import { ALL_TOOLS, chooseTool, inHand } from "../tools";
import { focusAtCursor, gestures, penInput, spaceHeld, turnBy } from "../tools/pen-input";
import { nudge } from "../tools/placing";
import { transformLayer } from "../tools/replacing";
import type { ToolCommand } from "../tools/tool";
import { lookAlong, type Vec3 } from "../view/camera";
import { FLY_KEYS } from "../view/gestures";
import { axesOf, type Side } from "../view/sides";
import { filesOpen, frameAll, redo, undo } from "./header";
import { toStage } from "./parts";
import { swapColors } from "./toolbar";

const RESIZE_FACTOR = 1.12;
const TURN_RADIANS = Math.PI / 24;
const ZOOM_FACTOR = 1.25;
/** Two digits within so much time are one number. */
const DIGITS_MS = 600;

const TOOL_ACTIONS = Object.fromEntries(
  ALL_TOOLS.flatMap((spec) =>
    spec.commands.map(({ id, before }) => [
      id,
      () => {
        if (readOnly.value && !spec.onlyLooks) return;
        before?.();
        chooseTool(spec);
      },
    ]),
  ),
) as Record<ToolCommand["id"], () => void>;
const toggle = (key: "grid" | "trueColor" | "compare" | "coverage") => () =>
  (view.value = { ...view.value, [key]: !view.value[key] });
const resize = (factor: number) => () => resizeBrush(factor);
const harden = (by: number) => () =>
  (brush.value = { ...brush.value, hardness: Math.max(0, Math.min(1, brush.value.hardness + by)) });

/** Look at the present target from a side of the asset. */
export function viewFrom(side: Side | Vec3): void {
  const now = pose.value;
  const asset = state.value?.asset;
  if (!now || !asset || !penInput.cameraFree) return;
  const { forward, up, ahead } = axesOf(asset, side);
  glide(lookAlong(now, forward, up, ahead));
}

/** The view with which the asset was opened. */
export function goHome(): void {
  const asset = state.value?.asset;
  if (asset && penInput.cameraFree) glide(homePose(asset));
}

function layerAt(by: number): { index: number; id: string | undefined; count: number } {
  const layers = state.value?.layers ?? [];
  const index = layers.findIndex((layer) => layer.id === selectedLayer.value);
  return { index, id: layers[index + by]?.id, count: layers.length };
}

function onLayer(action: (id: string) => Promise<unknown>): () => void {
  return () => void (selectedLayer.value && !readOnly.value && layerAt(0).id && action(selectedLayer.value));
}

function neighbour(by: number): () => void {
  return () => {
    const { id } = layerAt(by);
    if (id) selectedLayer.value = id;
  };
}

function shift(by: number): () => void {
  return onLayer(async (layer) => {
    const { index, count } = layerAt(0);
    const to = index + by;
    if (to >= 0 && to < count) await run("layer.move", { layer, to }, "Reordering");
  });
}

/** Whether a slider or a handle is held: what it changes becomes a step when it is let go. */
const held = { slides: false };
const SLIDES = "input[type=range], [role=slider], svg";

function followSlides(): void {
  window.addEventListener(
    "pointerdown",
    (event) => (held.slides = !!(event.target as Element).closest?.(SLIDES)),
    true,
  );
  for (const name of ["pointerup", "pointercancel"]) window.addEventListener(name, () => (held.slides = false), true);
  window.addEventListener("blur", () => (held.slides = false)); // of the window, not of what is in it
  window.addEventListener("pointermove", (event) => (held.slides &&= event.buttons > 0), true);
}

const deleteLayer = onLayer((layer) => run("layer.delete", { layer }, "Deleting"));

const ACTIONS: Record<CommandId, () => unknown> = {
  ...TOOL_ACTIONS,
  "color.swap": swapColors,
  "color.default": () => {
    setColor("#000000");
    secondColor.value = "#ffffff";
  },
  "brush.smaller": resize(1 / RESIZE_FACTOR),
  "brush.larger": resize(RESIZE_FACTOR),
  "brush.softer": harden(-0.1),
  "brush.harder": harden(0.1),
  "view.all": frameAll,
  "view.home": goHome,
  "view.focus": focusAtCursor,
  "view.front": () => viewFrom("front"),
  "view.back": () => viewFrom("back"),
  "view.right": () => viewFrom("right"),
  "view.left": () => viewFrom("left"),
  "view.top": () => viewFrom("top"),
  "view.bottom": () => viewFrom("bottom"),
  "view.nearer": () => penInput.cameraFree && gestures.zoom(1 / ZOOM_FACTOR),
  "view.farther": () => penInput.cameraFree && gestures.zoom(ZOOM_FACTOR),
  "view.turnleft": () => turnBy(TURN_RADIANS, 0),
  "view.turnright": () => turnBy(-TURN_RADIANS, 0),
  "view.turnup": () => turnBy(0, TURN_RADIANS),
  "view.turndown": () => turnBy(0, -TURN_RADIANS),
  "view.grid": toggle("grid"),
  "view.truecolor": toggle("trueColor"),
  "view.compare": toggle("compare"),
  "view.coverage": toggle("coverage"),
  "select.all": () => changeSelection("all"),
  "select.none": deselect,
  "select.again": () => changeSelection("again"),
  "select.invert": () => void withSelection((count) => count > 0 && changeSelection("invert")),
  "select.tint": () => (tinted.value = !tinted.value),
  "select.fill": () => void withSelection((count) => count > 0 && fillSelected(true)),
  "select.hide": () => void withSelection((count) => count > 0 && hideSelected(true, "Crop")),
  "layer.duplicate": onLayer(async (layer) => {
    const answer = await run("layer.duplicate", { layer }, "Duplicating");
    if (answer) selectedLayer.value = answer.layer.id;
  }),
  "layer.merge": onLayer(async (layer) => {
    const { id: below } = layerAt(-1);
    const name = state.value?.layers.find((one) => one.id === below)?.name; // of the one that stays
    const answer = below ? await run("layer.merge", { layers: [below, layer], name }, "Merging") : null;
    if (answer) selectedLayer.value = answer.layer.id;
  }),
  "layer.raise": shift(1),
  "layer.lower": shift(-1),
  "layer.above": neighbour(1),
  "layer.below": neighbour(-1),
  // what is dragged outside of the view ends first, or it would go on from something that is no more
  "edit.undo": () => held.slides || undo(),
  "edit.redo": () => held.slides || redo(),
  "edit.delete": () =>
    placement.value
      ? deletePlacement() // what the handles are on, no layer beside it
      : withSelection((count) => (count > 0 ? hideSelected(false, "Hide") : deleteLayer())),
  "edit.transform": () => void transformLayer().catch(report),
  "edit.apply": () => placement.value && void commitPlacement(),
  "edit.cancel": () => penInput.cancel(),
  "file.open": () => (filesOpen.value = "open"),
  "file.save": () => (filesOpen.value = "save"),
  "file.batch": () => (batchOpen.value = state.value !== null),
  help: () => (help.value = true),
};

/** What has keys itself: rows of layers and assets (F2, Alt-arrows), and what opens a field or a menu. */
const KEEPS_KEYS = ".layer-list, .asset-list, [role=tab], .more";

/** Opacity (of the layer where the tool has none) or flow by digits: 4 is 40 %, 4 5 is 45 %, 0 is 100 %, 0 0 is 0 or 1 %. */
function digitEntry(): (digit: number, flow: boolean, time: number) => void {
  let first = { time: -Infinity, value: 0, flow: false };
  return (digit, flow, time) => {
    const second = time - first.time < DIGITS_MS && first.flow === flow;
    const percent = second ? first.value * 10 + digit : digit === 0 ? 100 : digit * 10;
    first = { time: second ? -Infinity : time, value: digit, flow };
    const value = Math.max(0.01, percent / 100);
    if (flow) brush.value = { ...brush.value, flow: value };
    else if (!inHand().onlyLooks) brush.value = { ...brush.value, opacity: value };
    else if (selectedLayer.value && !readOnly.value && layerAt(0).id)
      void run("layer.set", { layer: selectedLayer.value, opacity: percent / 100, gesture: "digits" }, "Layer");
  };
}
const setByDigit = digitEntry();

/** Pixels of the screen by which an arrow moves what is placed; with Shift. */
const NUDGES_PX = [1, 10] as const;
const ARROWS: Readonly<Record<string, readonly [number, number]>> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
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

/**
 * Whether a key writes although the view has the keys, as after the text was moved: letters are its words then, and no
 * shortcuts. Digits are its opacity.
 */
function writesWords(event: KeyboardEvent): boolean {
  if (placement.value?.kind !== "text" || laying.value) return false;
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  return /^(\p{L}|Backspace|Delete)$/u.test(event.key);
}

/** Saving and opening are the studio's in a field, too: the browser would save its page. What was written there counts. */
function saveFromFields(event: KeyboardEvent): void {
  if (!writing(event.target) || !(event.ctrlKey || event.metaKey) || document.querySelector("dialog[open]")) return;
  const command = commandFor(chordOf(event));
  if (!command?.startsWith("file.")) return;
  (event.target as HTMLElement).blur();
  event.preventDefault();
  event.stopPropagation();
  ACTIONS[command]();
}

export function listen(): void {
  followSlides();
  window.addEventListener("keydown", saveFromFields, true);
  window.addEventListener("keydown", (event) => {
    if (writing(event.target) || document.querySelector("dialog[open]")) return;
    if (writesWords(event)) return words.focus(false); // the key itself goes there then
    const chord = chordOf(event);
    if (!event.ctrlKey && !event.metaKey && (FLY_KEYS.includes(event.code) || event.key === "Shift")) {
      if (gestures.fly(event.code, true)) return event.preventDefault();
    }
    const onButton = (event.target as HTMLElement).closest?.("button, input, [role=option], [role=slider]");
    if (chord === "Space") {
      if (onButton) return; // space presses it
      spaceHeld.value = true;
      return event.preventDefault();
    }
    if (/^(Arrow\w+|Enter|NumEnter)$/.test(chord) && onButton) return;
    const arrow = /^(Shift-)?(Arrow\w+)$/.exec(chord);
    if (arrow && placement.value) {
      const [right, down] = ARROWS[arrow[2]];
      const by = NUDGES_PX[arrow[1] ? 1 : 0];
      nudge(right * by, down * by, event.repeat);
      return event.preventDefault();
    }
    const digit = /^(Shift-)?([0-9])$/.exec(chord);
    const command = commandFor(chord);
    if (digit && !command) setByDigit(Number(digit[2]), digit[1] !== undefined, event.timeStamp);
    else if (command) ACTIONS[command]();
    else return;
    event.preventDefault();
  });
  window.addEventListener("keyup", (event) => {
    if (event.key === " ") spaceHeld.value = false;
    gestures.fly(event.code, false);
  });
  // what was pressed by hand does not keep the keys: Space turns the view, letters choose tools
  let pointed = false;
  for (const [name, by] of [
    ["pointerdown", true],
    ["keydown", false],
  ] as const)
    window.addEventListener(name, () => (pointed = by), true);
  for (const name of ["click", "change"])
    window.addEventListener(name, (event) => {
      const from = event.target as Element;
      const held = name === "change" ? "select, input[type=range]" : "button, input[type=checkbox], input[type=range]";
      if (pointed && from.closest?.(held) === document.activeElement && !from.closest(KEEPS_KEYS)) toStage(from);
    });
  window.addEventListener("blur", () => {
    spaceHeld.value = false;
    gestures.stop();
  });
}
