/**
 * A bar whose settings go on below it where they do not fit: the first line is always there, "More" (or the keyboard,
 * when it goes there) opens the rest, and the view gets as much lower: it is never covered. Nothing is taken out of the page
 * and put back, so nothing loses focus.
 */

import type { ComponentChildren } from "preact";
import { useEffect, useLayoutEffect, useRef, useState } from "preact/hooks";

import { Button } from "./parts";

/** Pixels by which what is in the next line lies lower at least. */
const NEXT_LINE_PX = 20;

const isBelow = (row: HTMLElement, one: Element): boolean =>
  one.getBoundingClientRect().top - row.getBoundingClientRect().top + row.scrollTop > NEXT_LINE_PX;

interface Props {
  label: string;
  /** What "More" brings out. */
  more: string;
  /** It is folded where this changes. */
  of: string;
  class: string;
  children: ComponentChildren;
}

export function OverflowBar({ label, more: moreLabel, of, class: name, children }: Props) {
  const section = useRef<HTMLElement>(null);
  const row = useRef<HTMLDivElement>(null);
  const [more, setMore] = useState(false);
  const [open, setOpen] = useState(false);
  useEffect(() => setOpen(false), [of]);
  useLayoutEffect(() => {
    const box = row.current!;
    const measure = () => {
      const overflowing = [...box.children].some((one) => isBelow(box, one));
      setMore(overflowing);
      if (!overflowing) setOpen(false);
    };
    const changed = (records: MutationRecord[]) => {
      measure();
      // settings that a click in the bar brought out are to be seen
      const fresh = records.flatMap(({ addedNodes }) => [...addedNodes]).filter((one) => one instanceof Element);
      if (
        (box.contains(document.activeElement) || clicked.current) &&
        fresh.some((one) => box.contains(one) && isBelow(box, one))
      )
        setOpen(true);
    };
    const sizes = new ResizeObserver(measure);
    const contents = new MutationObserver(changed);
    sizes.observe(box);
    contents.observe(box, { childList: true, subtree: true, characterData: true });
    measure();
    return () => (sizes.disconnect(), contents.disconnect());
  }, []);
  // Opening moves what is in the bar: not between the two halves of a click, which would then hit something else.
  const pressed = useRef(false);
  /** Whether the pointer was last used in the bar, and no key since: the view has the focus again after a click. */
  const clicked = useRef(false);
  /** Whether the pointer was last used in the bar, whatever keys came since. */
  const pointed = useRef(false);
  const waiting = useRef<(() => void) | null>(null);
  const whenReleased = (action: () => void) => {
    if (pressed.current) waiting.current = action;
    else action();
  };
  useEffect(() => {
    const press = (event: PointerEvent) => {
      pressed.current = clicked.current = pointed.current = section.current!.contains(event.target as Node);
      waiting.current = null;
    };
    const typed = () => (clicked.current = false);
    const release = () =>
      setTimeout(() => {
        pressed.current = false;
        waiting.current?.();
        waiting.current = null;
      });
    document.addEventListener("pointerdown", press, true);
    document.addEventListener("keydown", typed, true);
    for (const name of ["pointerup", "pointercancel"]) document.addEventListener(name, release, true);
    return () => {
      document.removeEventListener("pointerdown", press, true);
      document.removeEventListener("keydown", typed, true);
      for (const name of ["pointerup", "pointercancel"]) document.removeEventListener(name, release, true);
    };
  }, []);
  // with the settings, not after the browser has drawn them: an Escape right after them was lost
  useLayoutEffect(() => {
    if (!open) return;
    const escape = (event: KeyboardEvent) => {
      if (event.key !== "Escape") return;
      // it is the view's where that was used last, and a field's that is written in
      const target = event.target as HTMLElement;
      const isHere = section.current!.contains(document.activeElement) || pointed.current;
      if (!isHere || (target instanceof HTMLInputElement && target.type === "text")) return;
      event.stopPropagation();
      setOpen(false);
      const bar = section.current!;
      if (bar.contains(document.activeElement)) bar.querySelector<HTMLElement>(".more button")?.focus();
    };
    document.addEventListener("keydown", escape, true);
    return () => document.removeEventListener("keydown", escape, true);
  }, [open]);
  return (
    <section ref={section} class={`settings-bar ${name}`} aria-label={label}>
      <div
        ref={row}
        class={`options-row${open ? " open" : ""}`}
        onFocusIn={(event) => isBelow(row.current!, event.target as Element) && whenReleased(() => setOpen(true))}
        onScroll={() =>
          // a browser scrolled to something in the lines below
          whenReleased(() => {
            row.current!.scrollTop = 0;
            setOpen(true);
          })
        }
      >
        {children}
      </div>
      {more && (
        <span class="more">
          <Button
            label={open ? "Fewer settings" : moreLabel}
            text="More"
            pressed={open}
            onClick={() => setOpen(!open)}
          />
        </span>
      )}
    </section>
  );
}
