/** The tools at the left. */

import { keyOf } from "../keys/bindings";
import { spoken } from "../keys/chord";
import { color, readOnly, secondColor, setColor } from "../state/store";
import { ALL_TOOLS, chooseTool } from "../tools";
import { tool, type ToolSpec } from "../tools/tool";
import { CommandButton } from "./command-button";
import { Button } from "./parts";

const keysOf = ({ commands }: ToolSpec): string => commands.map(({ id }) => spoken(keyOf(id))).join(", ");

export function Toolbar() {
  return (
    <nav class="toolbar" aria-label="Tools">
      {ALL_TOOLS.map((spec) => (
        <Button
          key={spec.name}
          icon={spec.icon}
          label={spec.label ?? spec.commands[0].label}
          keys={keysOf(spec)}
          pressed={tool.value === spec.name}
          disabled={readOnly.value && !spec.onlyLooks}
          onClick={() => chooseTool(spec)}
        />
      ))}
      <label class="swatch" title="Colour">
        <input
          type="color"
          aria-label="Colour"
          value={color.value}
          onInput={(event) => (color.value = event.currentTarget.value)}
          onChange={(event) => setColor(event.currentTarget.value)}
        />
      </label>
      <span
        class="second-color"
        title={`Second colour: ${secondColor.value}`}
        style={{ background: secondColor.value }}
      />
      <CommandButton icon="swap" command="color.swap" onClick={swapColors} />
    </nav>
  );
}

/** The two colours change places. */
export function swapColors(): void {
  const second = secondColor.value;
  secondColor.value = color.value;
  setColor(second);
}
