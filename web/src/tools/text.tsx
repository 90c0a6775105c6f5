/** Text: a click is a caret, and what is typed then is laid on the view or on the surface. */

import { useEffect, useRef } from "preact/hooks";

import { report } from "../editor/editor";
import { viewScale } from "../paint/brush-settings";
import { commitPlacement, discardPlacement } from "../paint/lay-placement";
import { placement } from "../paint/placement";
import { caret, textImage, words } from "../paint/text-image";
import { wrapping } from "../paint/view-surface";
import { text } from "../state/store";
import { fonts, loadFont, systemFonts } from "../ui/fonts";
import { Button, Check, Choice, FileButton, Slider, toStage } from "../ui/parts";
import { OneSided } from "../ui/symmetry";
import { OnSurface, placing } from "./placing";
import { Limits, Methods, PaintModes, RecentColors } from "./settings";
import type { Pen, ToolSpec } from "./tool";

function start(pen: Pen): void {
  const scale = viewScale.value; // letters are as large as their pixels are on the screen
  placement.value = { kind: "text", image: textImage(), name: "Text", x: pen.x, y: pen.y, scale, angle: 0 };
}

/** Where the caret is in the field of the words; null: the keys are elsewhere. */
function followCaret(field: HTMLInputElement | null): void {
  caret.value = field && document.activeElement === field ? field.selectionEnd : null;
}

function Settings() {
  const t = text.value;
  const set = (part: Partial<typeof t>) => (text.value = { ...text.value, ...part });
  const field = useRef<HTMLInputElement>(null);
  const follow = () => followCaret(field.current);
  useEffect(() => {
    words.focus = (select) => {
      field.current?.focus({ preventScroll: true });
      const end = field.current?.value.length ?? 0;
      field.current?.setSelectionRange(select ? 0 : end, end);
    };
    const changed = () => followCaret(field.current);
    document.addEventListener("selectionchange", changed);
    return () => {
      words.focus = () => {};
      caret.value = null;
      document.removeEventListener("selectionchange", changed);
    };
  }, []);
  return (
    <>
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
      <OnSurface />
      {!placement.value && <span class="hint">Click on the asset and write</span>}
      <OneSided why="text is placed on this side only" />
      {!placement.value?.anchor && <PaintModes />}
      <RecentColors />
      <Methods />
      <Limits />
    </>
  );
}

export const textTool: ToolSpec = {
  name: "text",
  icon: "text",
  commands: [{ id: "tool.text", label: "Text", keys: ["T"] }],
  cursor: () => "none",
  Settings,
  // not before the click is over, or the view would take the keys again
  gesture: placing(start, () => words.focus(true)),
  limited: true,
  needsSurface: () => wrapping.value.on,
};
