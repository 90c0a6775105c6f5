/** Every step, oldest first; a click goes there. */

import { useLayoutEffect, useRef } from "preact/hooks";

import { pythonLog, state } from "../state/store";
import { run } from "../editor/editor";
import { copy } from "./feedback";
import { Button, reveal } from "./parts";

const capital = (text: string): string => text.charAt(0).toUpperCase() + text.slice(1);

export function History() {
  const now = state.value;
  const list = useRef<HTMLOListElement>(null);
  const current = now?.history[now.cursor]?.id;
  useLayoutEffect(() => {
    reveal(list.current?.closest(".tab-panel"), list.current?.querySelector("[aria-current=true]"));
  }, [current]);
  if (!now) return null;
  const jump = (cursor: number) => void (cursor !== now.cursor && run("jump", { cursor }, "History"));
  return (
    <>
      <ol ref={list} class="history" aria-label="History">
        {now.history.map((step, k) => (
          <li key={step.id}>
            <button
              type="button"
              class={k > now.cursor ? "undone" : ""}
              aria-current={now.cursor === k}
              onClick={() => jump(k)}
            >
              {k === 0 ? "Original" : capital(step.label)}
              {k === now.cursor && now.selection.undo + now.selection.redo > 0 && (
                <span class="quiet">
                  {now.selection.undo} of {now.selection.undo + now.selection.redo} selections
                </span>
              )}
            </button>
          </li>
        ))}
      </ol>
      {pythonLog.value.length > 0 && (
        <p class="row">
          <Button
            label="Everything done from this window, as Python lines"
            icon="copy"
            text="Copy as Python"
            onClick={() => void copy(pythonLog.value.join("\n"))}
          />
        </p>
      )}
    </>
  );
}
