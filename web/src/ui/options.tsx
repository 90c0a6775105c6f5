/** The bar under the header: settings of the tool in hand. */

import { signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { shadingApplies } from "../paint/brush";
import { chosenMask, cloneFrom, SPREADING_TOOLS } from "../paint/stroke-queue";
import { choosingSource } from "../paint/freehand";
import {
  caret,
  commitPlacement,
  discardPlacement,
  editedLayer,
  placement,
  startStamp,
  words,
} from "../paint/placement";
import { LIMITED_TOOLS, MAX_ANGLE_DEGREES, MAX_DEPTH_EDGE_PX } from "../paint/limits";
import { setColor } from "../paint/point-tools";
import { relief } from "../paint/relief";
import type { Combine } from "../paint/selection-masks";
import { wrapping } from "../paint/view-surface";
import {
  brush,
  camera,
  color,
  fill,
  limits,
  maskShows,
  method,
  paintMode,
  recentColors,
  selecting,
  spreading,
  state,
  tab,
  text,
  tool,
  type PaintMode,
  type SelectKind,
} from "../state/store";
import { report } from "../state/studio";
import { BrushSize, KeepShading } from "./brush-size";
import { OneSided, SymmetryButton } from "./symmetry";
import { fonts, loadFont, systemFonts } from "./fonts";
import { OverflowBar } from "./overflow-bar";
import { Button, Check, Choice, FileButton, Percent, Slider, toStage } from "./parts";

const MODES: readonly (readonly [PaintMode, string])[] = [
  ["normal", "Normal"],
  ["color", "Colour only"],
  ["darken", "Darken"],
  ["lighten", "Lighten"],
];
const METHODS = { auto: "Auto", ttt: "Network", lift: "Lift", fit: "Fit" } as const;
const PAINTS = ["brush", "erase", "line", "clone", "heal", "fill", "text", "stamp"];
/** Why a tool paints on one side only. */
const ONE_SIDED: Partial<Record<string, string>> = {
  heal: "healing stays on this side, whose tone and texture it takes",
  text: "text is placed on this side only",
  stamp: "pictures are placed on this side only",
  select: "only this side is selected",
};
const limiting = signal(false);

export function Options() {
  const current = tool.value;
  const round = ["brush", "erase", "line", "clone", "heal"].includes(current);
  const colored = ["brush", "line", "fill", "text", "stamp"].includes(current);
  return (
    <OverflowBar class="options" label="Tool settings" more="More settings of the tool" of={current}>
      {round && <Round />}
      {current === "select" && selecting.value.kind === "brush" && <Tip />}
      {current === "fill" && <Fill />}
      {current === "text" && <Text />}
      {current === "stamp" && <Stamp />}
      {(current === "clone" || current === "heal") && (
        <Button
          label="The next click sets where to copy from"
          keys="Alt-click"
          icon="pick"
          text={cloneFrom.value ? "Another source" : "Set the source"}
          pressed={choosingSource.value}
          onClick={() => (choosingSource.value = !choosingSource.value)}
        />
      )}
      {current === "clone" && <Check label="With relief" value={relief.value} onChange={(on) => (relief.value = on)} />}
      {current === "select" && <Select />}
      {round && chosenMask() ? (
        <OneSided why="masks are painted on this side only" />
      ) : current === "clone" && relief.value ? (
        <OneSided why="relief is copied to this side only" />
      ) : (
        ONE_SIDED[current] && <OneSided why={ONE_SIDED[current]} />
      )}
      {current === "orbit" && (
        <span class="hint">
          Drag to turn about the point under the cursor, Shift-drag to slide, wheel to zoom, double click to look at a
          point
        </span>
      )}
      {round && chosenMask() && (
        <span class="hint">
          Mask of {chosenMask()!.name}: {maskShows.value === (current === "erase") ? "hides" : "shows"} it
        </span>
      )}
      {current === "erase" && !chosenMask() && (
        <span class="hint">This layer's paint; Shift: back to the original</span>
      )}
      {current === "pick" && <span class="hint">Click: pick the colour as it is seen</span>}
      {colored && !placement.value?.anchor && (
        <Choice label="Mode" value={paintMode.value} options={MODES} onChange={(value) => (paintMode.value = value)} />
      )}
      {colored && current !== "stamp" && <Recent />}
      {PAINTS.includes(current) && <Methods />}
      {LIMITED_TOOLS.includes(current) && <Limits />}
      {SPREADING_TOOLS.includes(current) && <Spreading />}
    </OverflowBar>
  );
}

function Round() {
  const b = brush.value;
  const set = (part: Partial<typeof b>) => (brush.value = { ...brush.value, ...part });
  return (
    <>
      <BrushSize />
      <Percent label="Hardness" value={b.hardness} onInput={(v) => set({ hardness: v })} />
      <Percent label="Opacity" value={b.opacity} min={0.01} onInput={(v) => set({ opacity: v })} />
      <Percent label="Flow" value={b.flow} min={0.01} onInput={(v) => set({ flow: v })} />
      {shadingApplies() && <KeepShading />}
      {tool.value !== "heal" && <SymmetryButton />}
      <Button
        label="Tip, dabs, texture and smoothing of the brush"
        icon="brush"
        text="Tip"
        pressed={tab.value === "brush"}
        onClick={() => (tab.value = "brush")}
      />
    </>
  );
}

/** Size and hardness of a painted selection: those of the brush. */
function Tip() {
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

function Fill() {
  const f = fill.value;
  return (
    <>
      <Percent label="Tolerance" value={f.tolerance} onInput={(v) => (fill.value = { ...f, tolerance: v })} />
      <Percent
        label="Opacity"
        value={brush.value.opacity}
        min={0.01}
        onInput={(v) => (brush.value = { ...brush.value, opacity: v })}
      />
      <Check
        label="Connected only"
        value={f.contiguous}
        onChange={(contiguous) => (fill.value = { ...f, contiguous })}
      />
      {shadingApplies() && <KeepShading />}
      <SymmetryButton />
    </>
  );
}

function Text() {
  const t = text.value;
  const set = (part: Partial<typeof t>) => (text.value = { ...text.value, ...part });
  const field = useRef<HTMLInputElement>(null);
  const follow = () => (caret.value = document.activeElement === field.current ? field.current!.selectionEnd : null);
  useEffect(() => {
    words.focus = (select) => {
      field.current?.focus({ preventScroll: true });
      const end = field.current?.value.length ?? 0;
      field.current?.setSelectionRange(select ? 0 : end, end);
    };
    document.addEventListener("selectionchange", follow);
    return () => {
      words.focus = () => {};
      caret.value = null;
      document.removeEventListener("selectionchange", follow);
    };
  }, []);
  return (
    <>
      {placement.value && <Place />}
      <input
        ref={field}
        class="words"
        type="text"
        onFocus={follow}
        onBlur={follow}
        aria-label="Text"
        value={t.text}
        onKeyDown={(event) => {
          event.stopPropagation();
          if (event.key === "Enter" && placement.value) void commitPlacement();
          if (event.key === "Escape") void discardPlacement();
          if (event.key === "Enter" || event.key === "Escape") toStage(event.currentTarget);
        }}
        onInput={(event) => {
          set({ text: event.currentTarget.value });
          follow();
        }}
      />
      <Choice
        label="Font"
        value={t.font}
        options={fonts.value.map((name) => [name, name] as const)}
        onChange={(font) => set({ font })}
      />
      {"queryLocalFonts" in window && (
        <Button
          label="List the fonts of this computer"
          text="System fonts"
          onClick={() => void systemFonts().catch(report)}
        />
      )}
      <FileButton
        label="Font file"
        accept=".ttf,.otf,.woff,.woff2"
        onFiles={([file]) =>
          void loadFont(file)
            .then((font) => set({ font }))
            .catch(report)
        }
      />
      <Slider label="Size" value={t.size} min={8} max={400} log unit=" px" onInput={(size) => set({ size })} />
      <Check label="Bold" value={t.bold} onChange={(bold) => set({ bold })} />
      <Check label="Italic" value={t.italic} onChange={(italic) => set({ italic })} />
      {!placement.value?.flat && <OnSurface />}
      {!placement.value && <span class="hint">Click on the asset and write</span>}
    </>
  );
}

function Stamp() {
  const start = ([file]: File[]) => {
    const now = camera.value;
    if (file && now)
      void startStamp(file, file.name, now).catch(() =>
        report(new Error(`${file.name} is not a picture that this browser reads.`)),
      );
  };
  return (
    <>
      {placement.value && <Place />}
      <FileButton
        label="Choose a picture"
        icon="open"
        accept="image/png,image/jpeg,image/webp,image/avif"
        onFiles={start}
      />
      {!placement.value?.flat && <OnSurface />}
      {!placement.value && <span class="hint">or paste one</span>}
    </>
  );
}

/** Whether it lies on the surface, and how far round. */
function OnSurface() {
  const { on, limit } = wrapping.value;
  return (
    <>
      <Check
        label="On the surface"
        value={on}
        onChange={(next) => (wrapping.value = { ...wrapping.value, on: next })}
      />
      {on && (
        <Slider
          label="Wrap"
          value={limit}
          min={5}
          max={180}
          step={5}
          unit="°"
          reset={180}
          onInput={(v) => (wrapping.value = { ...wrapping.value, limit: Math.round(v) })}
        />
      )}
      {on && placement.value && !placement.value.anchor && <span class="hint">No surface under it yet</span>}
    </>
  );
}

function Place() {
  return (
    <span class="group">
      <Button
        label="Apply"
        command="edit.apply"
        icon="check"
        text="Apply"
        primary
        onClick={() => void commitPlacement()}
      />
      <Button
        label={editedLayer.value ? "Leave it unchanged" : "Discard it"}
        command="edit.cancel"
        icon="close"
        onClick={() => void discardPlacement()}
      />
    </span>
  );
}

const COMBINE: readonly (readonly [Combine, string])[] = [
  ["replace", "New"],
  ["add", "Add (Shift)"],
  ["subtract", "Subtract (Alt)"],
  ["intersect", "Intersect (both)"],
];

function Select() {
  const s = selecting.value;
  const kinds: readonly (readonly [SelectKind, string])[] = [
    ["rectangle", "Rectangle"],
    ["lasso", "Lasso"],
    ["color", "By colour"],
    ["brush", "Brush"],
  ];
  return (
    <>
      <Choice label="Select" value={s.kind} options={kinds} onChange={(kind) => (selecting.value = { ...s, kind })} />
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
    </>
  );
}

function Recent() {
  return (
    <span class="recent">
      {recentColors.value.slice(0, 6).map((value) => (
        <button
          type="button"
          key={value}
          aria-label={`Colour ${value}`}
          title={value}
          style={{ background: value }}
          aria-pressed={value === color.value}
          onClick={() => setColor(value)}
        />
      ))}
    </span>
  );
}

function Methods() {
  const there = state.value?.methods ?? ["auto"];
  return (
    <Choice
      label="Method"
      value={method.value}
      options={there.map((key) => [key, METHODS[key]] as const)}
      onChange={(value) => (method.value = value)}
    />
  );
}

/** Paint that goes on over the material that it lies on. */
function Spreading() {
  const s = spreading.value;
  const set = (part: Partial<typeof s>) => (spreading.value = { ...spreading.value, ...part });
  return (
    <>
      <Button
        label="Treat paint as a material, which changes all around; each stroke is a layer"
        text="Spread"
        pressed={s.on}
        onClick={() => set({ on: !s.on })}
      />
      {s.on && (
        <span class="group">
          <Percent label="Threshold" value={s.threshold} onInput={(threshold) => set({ threshold })} />
          <Check label="Show confidence" value={s.show} onChange={(show) => set({ show })} />
        </span>
      )}
    </>
  );
}

function Limits() {
  const l = limits.value;
  const set = (part: Partial<typeof l>) => (limits.value = { ...limits.value, ...part });
  return (
    <>
      <Button
        label="Limits of what one view may paint"
        text="Limits"
        pressed={limiting.value}
        onClick={() => (limiting.value = !limiting.value)}
      />
      {limiting.value && (
        <span class="group">
          <Slider
            label="Angle limit"
            value={l.angle}
            min={0}
            max={MAX_ANGLE_DEGREES}
            step={1}
            unit="°"
            reset={80}
            onInput={(angle) => set({ angle: Math.round(angle) })}
          />
          <Slider
            label="Depth-edge limit"
            value={l.depthEdge}
            min={0}
            max={MAX_DEPTH_EDGE_PX}
            step={1}
            unit=" px"
            reset={0}
            onInput={(depthEdge) => set({ depthEdge: Math.round(depthEdge) })}
          />
          <Check label="Show what will not be painted" value={l.show} onChange={(show) => set({ show })} />
        </span>
      )}
    </>
  );
}
