/** Five steps for those who see the studio for the first time. Skipped by Escape; shown again from the sheet of shortcuts. */

import { signal } from "@preact/signals";
import { useEffect, useLayoutEffect, useRef, useState } from "preact/hooks";

import { keyOf } from "../keys/bindings";
import { spoken } from "../keys/chord";
import { state } from "../state/store";
import { brush } from "../tools/brush";
import { Button } from "./parts";

const STORE = "splatpainter.tour";

interface Step {
  /** What it is about: a selector of an element that is framed. */
  about: string;
  title: string;
  text: () => string;
}

const STEPS: readonly Step[] = [
  {
    about: "#stage",
    title: "Look around",
    text: () =>
      "Hold Alt, Space or the right button and drag to turn the asset about the point under the cursor. The wheel zooms to it; click an axis at the upper right to see a side.",
  },
  {
    about: ".toolbar",
    title: "Paint",
    text: () =>
      `Pick the brush (${spoken(keyOf(brush.commands[0].id))}) and paint on the asset. The paint stays on its surface from every side; text, stickers, clone and heal are here too.`,
  },
  {
    about: ".panel.layers",
    title: "Layers",
    text: () =>
      "Every stroke goes into the chosen layer. Opacity, blend, masks and the eraser work on it; hide a layer, and the asset below is back bit for bit.",
  },
  {
    about: ".panel.tabs",
    title: "Nothing is lost",
    text: () =>
      `Each edit is saved as it is made, and ${spoken(keyOf("edit.undo"))} undoes it, even tomorrow. Next to the history are adjustments, selections, edited pictures and views.`,
  },
  {
    about: ".header",
    title: "Share it",
    text: () =>
      `Save, export (${spoken(keyOf("file.save"))}) writes every format with a receipt of what changed, or a web page. Drop an asset, a project or an edited picture onto the window to open it. The keys are under ${spoken(keyOf("help"))}.`,
  },
];

/** The step that is shown; null: none. */
const step = signal<number | null>(null);

export const startTour = (): void => void (step.value = 0);

/** Whether it comes by itself: the first time in this browser, and never where a program drives it. */
function isFirst(): boolean {
  try {
    return !navigator.webdriver && localStorage.getItem(STORE) === null;
  } catch {
    return false; // nothing can be remembered: it would come every time
  }
}

function end(): void {
  step.value = null;
  try {
    localStorage.setItem(STORE, "seen");
  } catch {
    // it comes again
  }
  document.getElementById("stage")?.focus({ preventScroll: true });
}

const MARGIN_PX = 12;
const CARD_PX = 340;

export function Tour() {
  const now = state.value;
  const ready = now !== null;
  useEffect(() => {
    const requested = new URLSearchParams(location.search).has("tour");
    if (ready && (requested || (isFirst() && state.peek()!.earlier.length === 0))) startTour();
  }, [ready]);
  if (step.value === null || !ready) return null;
  return <Card key={step.value} at={step.value} />;
}

function Card({ at }: { at: number }) {
  const { about, title, text } = STEPS[at];
  const box = useRef<HTMLDivElement>(null);
  const [frame, setFrame] = useState<DOMRect | null>(null);
  useLayoutEffect(() => {
    const measure = () => setFrame(document.querySelector(about)?.getBoundingClientRect() ?? null);
    measure();
    window.addEventListener("resize", measure);
    return () => window.removeEventListener("resize", measure);
  }, [about]);
  useEffect(() => box.current?.querySelector<HTMLElement>("button.primary")?.focus(), []);
  const last = at === STEPS.length - 1;
  const next = () => (last ? end() : (step.value = at + 1));
  const back = () => (step.value = Math.max(0, at - 1));
  const onKeyDown = (event: KeyboardEvent) => {
    event.stopPropagation(); // the studio's keys rest meanwhile
    if (event.key === "Escape") end();
    else if (event.key === "ArrowRight") next();
    else if (event.key === "ArrowLeft") back();
    else return;
    event.preventDefault();
  };
  return (
    <>
      {frame && (
        <div
          class="tour-frame"
          aria-hidden="true"
          style={{
            left: `${frame.left}px`,
            top: `${frame.top}px`,
            width: `${frame.width}px`,
            height: `${frame.height}px`,
          }}
        />
      )}
      <div
        ref={box}
        class="tour"
        role="dialog"
        aria-labelledby="tour-title"
        aria-describedby="tour-text"
        style={frame ? beside(frame) : {}}
        onKeyDown={onKeyDown}
      >
        <p class="quiet">
          {at + 1} of {STEPS.length}
        </p>
        <h2 id="tour-title">{title}</h2>
        <p id="tour-text">{text()}</p>
        <p class="row">
          <Button label="Skip the tour" keys="Esc" text="Skip" onClick={end} />
          <span class="gap" />
          {at > 0 && <Button label="The step before" text="Back" onClick={back} />}
          <Button
            label={last ? "Start painting" : "The next step"}
            text={last ? "Start" : "Next"}
            primary
            onClick={next}
          />
        </p>
      </div>
    </>
  );
}

/** Where the card lies: beside what it is about, inside the window. */
function beside(frame: DOMRect): { left: string; top: string } {
  const [wide, high] = [window.innerWidth, window.innerHeight];
  let left = frame.left + (frame.width - CARD_PX) / 2;
  let top = frame.top + frame.height / 3;
  if (frame.right + CARD_PX + 2 * MARGIN_PX < wide && frame.width < wide / 2) left = frame.right + MARGIN_PX;
  else if (frame.left - CARD_PX - 2 * MARGIN_PX > 0 && frame.width < wide / 2) left = frame.left - CARD_PX - MARGIN_PX;
  else if (frame.height < high / 4) [left, top] = [frame.left + MARGIN_PX, frame.bottom + MARGIN_PX];
  const inside = (value: number, size: number, room: number) =>
    Math.max(MARGIN_PX, Math.min(value, room - size - MARGIN_PX));
  return { left: `${inside(left, CARD_PX, wide)}px`, top: `${inside(top, 220, high)}px` };
}
