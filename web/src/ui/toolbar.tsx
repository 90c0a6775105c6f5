/** The tools at the left. */

import { keyOf } from "../keys/bindings";
import { spoken } from "../keys/chord";
import type { CommandId } from "../keys/table";
import { discardPlacement } from "../paint/placement";
import { color, readOnly, secondColor, tab, tool, type SelectKind, type Tool } from "../state/store";
import { setColor } from "../paint/point-tools";
import type { IconName } from "./icons";
import { Button } from "./parts";

/** Every tool with its command and its icon, from above. */
const TOOLS: readonly (readonly [Tool, CommandId, IconName])[] = [
  ["orbit", "tool.orbit", "orbit"],
  ["brush", "tool.brush", "brush"],
  ["erase", "tool.erase", "erase"],
  ["fill", "tool.fill", "fill"],
  ["line", "tool.line", "line"],
  ["text", "tool.text", "text"],
  ["stamp", "tool.stamp", "stamp"],
  ["clone", "tool.clone", "clone"],
  ["heal", "tool.heal", "heal"],
  ["pick", "tool.pick", "pick"],
];
/** The select tool's icon stands for its kinds. */
const SELECT_COMMANDS: readonly (readonly [SelectKind, CommandId])[] = [
  ["rectangle", "tool.rectangle"],
  ["lasso", "tool.lasso"],
  ["color", "tool.wand"],
  ["brush", "tool.selectbrush"],
];

export function chooseTool(next: Tool): void {
  if (tool.value !== next) void discardPlacement();
  if (next === "select" && tool.value !== next) tab.value = "select";
  tool.value = next;
}

export function Toolbar() {
  return (
    <nav class="toolbar" aria-label="Tools">
      {TOOLS.map(([key, command, icon]) => (
        <Button
          key={key}
          icon={icon}
          command={command}
          pressed={tool.value === key}
          disabled={readOnly.value && !["orbit", "pick"].includes(key)}
          onClick={() => chooseTool(key)}
        />
      ))}
      <Button
        icon="select"
        label="Select an area to paint in"
        keys={SELECT_COMMANDS.map(([, command]) => spoken(keyOf(command))).join(", ")}
        pressed={tool.value === "select"}
        onClick={() => chooseTool("select")}
      />
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
      <Button
        icon="swap"
        command="color.swap"
        onClick={() => {
          const second = secondColor.value;
          secondColor.value = color.value;
          setColor(second);
        }}
      />
    </nav>
  );
}
