/** Pixels or a blur over what is selected, as a layer. */

import { signal } from "@preact/signals";

import type { PixelateOptions } from "../messages";
import { pixelateSelected } from "../paint/selection";
import { Button, Check, Choice, Slider } from "./parts";

type Style = NonNullable<PixelateOptions["style"]>;
const STYLES: readonly (readonly [Style, string])[] = [
  ["cells", "Cells"],
  ["blur", "Blur"],
];
/** Edge of a cell, per cent of the asset's diameter. */
const SIZE_RANGE = [0.5, 50] as const;

const size = signal(5);
const style = signal<Style>("cells");
const merge = signal(false);

export function PixelateSelected({ off }: { off: boolean }) {
  return (
    <details>
      <summary>Pixelate</summary>
      <Slider
        label="Cell"
        value={size.value}
        min={SIZE_RANGE[0]}
        max={SIZE_RANGE[1]}
        log
        digits={1}
        unit=" %"
        reset={5}
        onInput={(to) => (size.value = to)}
      />
      <p class="row">
        <Choice label="Style" value={style.value} options={STYLES} onChange={(to) => (style.value = to)} />
      </p>
      <Check
        label="One Gaussian per cell: hides shapes, too"
        value={merge.value}
        onChange={(to) => (merge.value = to)}
      />
      <p class="row">
        <Button
          label="Make what is selected unreadable from all sides, as a layer"
          text="Pixelate"
          disabled={off}
          onClick={() => void pixelateSelected(size.value, { style: style.value, merge: merge.value })}
        />
      </p>
    </details>
  );
}
