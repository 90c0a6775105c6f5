/** Colours to paint with: latest ones, swatches that this browser keeps, and those of the asset. */

import { signal } from "@preact/signals";

import { MAX_SWATCHES, swatches } from "../state/remembered";
import { color, hex, recentColors, secondColor, state, setColor } from "../state/store";
import { run } from "../editor/editor";
import { Button } from "./parts";

/** The asset's colours, and of which session and version. */
const palette = signal<{ key: string; colors: string[] } | null>(null);

async function ask(): Promise<void> {
  const now = state.value;
  const answer = now && (await run("asset.palette", { count: 18 }, "Colours of the asset"));
  if (answer) palette.value = { key: now.session, colors: answer.colors.map((one) => hex(one)) };
}

function Swatches({
  label,
  colors,
  onForget,
}: {
  label: string;
  colors: readonly string[];
  onForget?: (one: string) => void;
}) {
  return (
    <div class="swatches" role="group" aria-label={label}>
      {colors.map((one) => (
        <button
          type="button"
          key={one}
          aria-label={`Colour ${one}`}
          title={onForget ? `${one} (Alt-click: remove it)` : one}
          style={{ background: one }}
          aria-pressed={one === color.value}
          onClick={(event) => (event.altKey && onForget ? onForget(one) : setColor(one))}
          onContextMenu={(event) => {
            event.preventDefault();
            secondColor.value = one;
          }}
        />
      ))}
    </div>
  );
}

export function ColorsPanel() {
  const fresh = palette.value?.key === state.value?.session ? palette.value : null;
  const has = swatches.value.includes(color.value);
  return (
    <div class="colors-panel">
      <h3>Recent</h3>
      {recentColors.value.length ? (
        <Swatches label="Recent colours" colors={recentColors.value} />
      ) : (
        <p class="quiet">None yet</p>
      )}
      <h3>From the asset</h3>
      {fresh && <Swatches label="Colours of the asset" colors={fresh.colors} />}
      <p class="row">
        <Button
          label="Find the main colours of the asset"
          icon="pick"
          text={fresh ? "Again" : "Find"}
          disabled={!state.value}
          onClick={() => void ask()}
        />
        {fresh && (
          <Button
            label="Keep these colours as swatches"
            icon="plus"
            text="Keep all"
            onClick={() => (swatches.value = [...new Set([...swatches.value, ...fresh.colors])].slice(-MAX_SWATCHES))}
          />
        )}
      </p>
      <h3>Swatches</h3>
      <Swatches
        label="Swatches"
        colors={swatches.value}
        onForget={(one) => (swatches.value = swatches.value.filter((other) => other !== one))}
      />
      <p class="row">
        <Button
          label="Add the current colour"
          icon="plus"
          text="Add"
          disabled={has}
          onClick={() => (swatches.value = [...swatches.value, color.value].slice(-MAX_SWATCHES))}
        />
        <Button
          label="Remove the current colour"
          icon="minus"
          text="Remove"
          disabled={!has}
          onClick={() => (swatches.value = swatches.value.filter((one) => one !== color.value))}
        />
      </p>
    </div>
  );
}
