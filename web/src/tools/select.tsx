/** Selecting: a rectangle, a lasso, a colour, or what a brush paints. */

import { signal } from "@preact/signals";

import { editor, report, run } from "../editor/editor";
import { viewScale } from "../paint/brush-settings";
import { likeColor, soften } from "../paint/flood";
import { dab, emptyMask, segment, type Mask } from "../paint/raster";
import { selection, sent } from "../paint/selected";
import { deselect, selectArea } from "../paint/selection";
import { combine, isEmpty, polygon, rectangle, type Combine } from "../paint/selection-masks";
import { brush, camera, selecting, type SelectKind } from "../state/store";
import { Check, Choice, Percent, Slider } from "../ui/parts";
import { OneSided } from "../ui/symmetry";
import type { Pen, ToolCommand, ToolGesture, ToolSpec } from "./tool";

/** What is being drawn: x0, y0, x1, y1 ... of a closed polygon, view pixels; null: nothing. */
export const draft = signal<number[] | null>(null);

/** The disc of a painted selection. */
const disc = () => ({
  radius: Math.max(1, (brush.value.size / 2) * viewScale.value),
  hardness: brush.value.hardness,
  flow: 1,
});

/** A selection that is painted: added to what is selected or, with Alt, taken from it. */
function painted(): ToolGesture {
  let drawn: { before: Mask | null; mask: Mask; last: Pen; left: number; how: Combine } | null = null;
  const show = () => {
    if (!drawn) return;
    const next = combine(drawn.before, drawn.mask, drawn.how);
    selection.value = isEmpty(next) ? null : next;
  };
  return {
    down(pen) {
      const now = camera.value;
      if (!now) return;
      const how = pen.alt || (selecting.value.combine === "subtract" && !pen.shift) ? "subtract" : "add";
      drawn = { before: selection.value, mask: emptyMask(now.width, now.height), last: pen, left: 0, how };
      dab(drawn.mask, pen.x, pen.y, disc());
      show();
    },
    move(pen) {
      if (!drawn) return;
      drawn.left = segment(drawn.mask, drawn.last, pen, disc, drawn.left).left;
      drawn.last = pen;
      show();
    },
    up() {
      if (!drawn) return;
      const { before, mask, how } = drawn;
      drawn = null;
      selection.value = before;
      selectArea(mask, how, selecting.value.through);
    },
    cancel() {
      if (drawn) selection.value = drawn.before;
      drawn = null;
    },
  };
}

/** A rectangle or a lasso; a click without one deselects. */
function outlined(lasso: boolean): ToolGesture {
  let start: Pen | null = null;
  const take = async (points: number[], first: Pen, last: Pen) => {
    const { width, height } = await editor.pixels.now();
    if (points.length < 6) {
      if (!first.shift && !first.alt && selecting.value.combine === "replace") deselect();
      return;
    }
    const [x, y] = [Math.min(first.x, last.x), Math.min(first.y, last.y)];
    const box = { x, y, width: Math.abs(last.x - first.x), height: Math.abs(last.y - first.y) };
    selectDrawn(lasso ? polygon(width, height, points) : rectangle(width, height, box), first);
  };
  return {
    down(pen) {
      start = pen;
      draft.value = [pen.x, pen.y];
    },
    move(pen) {
      if (!start || !draft.value) return;
      if (lasso) draft.value = [...draft.value, pen.x, pen.y];
      else draft.value = [start.x, start.y, pen.x, start.y, pen.x, pen.y, start.x, pen.y];
    },
    up(pen) {
      const [points, first] = [draft.value, start];
      draft.value = start = null;
      if (points && first) void take(points, first, pen).catch(report);
    },
    cancel() {
      draft.value = start = null;
    },
  };
}

/** As seen: the like-coloured pixels of the view, or Gaussians of that colour all over the asset. */
async function selectColor(pen: Pen): Promise<void> {
  const { tolerance, contiguous } = selecting.value;
  const now = camera.value;
  if (!now) return;
  if (!contiguous) {
    const fields = { camera: now, x: pen.x, y: pen.y, tolerance, how: howOf(pen) };
    return void (await sent(() => run("selection.color", fields, "Selecting")));
  }
  const pixels = await editor.pixels.now();
  selectDrawn(likeColor(pixels, Math.floor(pen.x), Math.floor(pen.y), tolerance, true), pen);
}

function howOf(pen: Pen): Combine {
  if (pen.shift && pen.alt) return "intersect";
  return pen.shift ? "add" : pen.alt ? "subtract" : selecting.value.combine;
}

function selectDrawn(mask: Mask, pen: Pen): void {
  selectArea(soften(mask, selecting.value.feather), howOf(pen), selecting.value.through);
}

const nothing = () => {};
const GESTURES: Record<SelectKind, ToolGesture> = {
  rectangle: outlined(false),
  lasso: outlined(true),
  color: { down: (pen) => void selectColor(pen).catch(report), move: nothing, up: nothing, cancel: nothing },
  brush: painted(),
};

/** The kind that is chosen when the pen comes down takes it to the end. */
function byKind(): ToolGesture {
  let current = GESTURES.rectangle;
  return {
    down(pen) {
      current = GESTURES[selecting.value.kind];
      current.down(pen);
    },
    move: (pen) => current.move(pen),
    up: (pen) => current.up(pen),
    cancel: () => current.cancel(),
  };
}

const COMBINE: readonly (readonly [Combine, string])[] = [
  ["replace", "New"],
  ["add", "Add (Shift)"],
  ["subtract", "Subtract (Alt)"],
  ["intersect", "Intersect (both)"],
];
const KINDS: readonly (readonly [SelectKind, string])[] = [
  ["rectangle", "Rectangle"],
  ["lasso", "Lasso"],
  ["color", "By colour"],
  ["brush", "Brush"],
];

function Settings() {
  const s = selecting.value;
  return (
    <>
      {s.kind === "brush" && <Disc />}
      <Choice label="Select" value={s.kind} options={KINDS} onChange={(kind) => (selecting.value = { ...s, kind })} />
      <Choice
        label="Mode"
        value={s.combine}
        options={COMBINE}
        onChange={(combine) => (selecting.value = { ...s, combine })}
      />
      {s.kind === "color" && (
        <>
          <Percent label="Tolerance" value={s.tolerance} onInput={(v) => (selecting.value = { ...s, tolerance: v })} />
          <Check
            label="Connected only"
            value={s.contiguous}
            onChange={(contiguous) => (selecting.value = { ...s, contiguous })}
          />
        </>
      )}
      <Slider
        label="Feather"
        value={s.feather}
        min={0}
        max={40}
        step={1}
        unit=" px"
        onInput={(feather) => (selecting.value = { ...s, feather: Math.round(feather) })}
      />
      {s.kind !== "color" || s.contiguous ? (
        <Check label="Select through" value={s.through} onChange={(through) => (selecting.value = { ...s, through })} />
      ) : null}
      <OneSided why="only this side is selected" />
    </>
  );
}
/** Size and hardness of a painted selection: those of the brush. */
function Disc() {
  const b = brush.value;
  return (
    <>
      <Slider
        label="Size"
        value={b.size}
        min={1}
        max={600}
        log
        unit=" px"
        onInput={(size) => (brush.value = { ...brush.value, size })}
      />
      <Percent
        label="Hardness"
        value={b.hardness}
        onInput={(hardness) => (brush.value = { ...brush.value, hardness })}
      />
    </>
  );
}

const command = (kind: SelectKind, id: ToolCommand["id"], label: string, key: string): ToolCommand => ({
  id,
  label,
  keys: [key],
  before: () => (selecting.value = { ...selecting.value, kind }),
});

export const select: ToolSpec = {
  name: "select",
  icon: "select",
  label: "Select an area to paint in",
  commands: [
    command("rectangle", "tool.rectangle", "Select a rectangle", "M"),
    command("lasso", "tool.lasso", "Lasso", "L"),
    command("color", "tool.wand", "Select by colour", "W"),
    command("brush", "tool.selectbrush", "Paint a selection", "Q"),
  ],
  cursor: () => (selecting.value.kind === "brush" ? "disc" : "cross"),
  Settings,
  gesture: byKind(),
  takesAlt: true,
  onlyLooks: true,
  tab: "select",
};
