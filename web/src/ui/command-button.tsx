/** A button that does what a command does: its name and its key are in the tooltip. */

import { keyOf, labelOf } from "../keys/bindings";
import { spoken } from "../keys/chord";
import type { CommandId } from "../keys/table";
import { Button, type ButtonProps } from "./parts";

type Props = Omit<ButtonProps, "label" | "keys"> & {
  command: CommandId;
  /** In place of what the command is called. */
  label?: string;
};

export function CommandButton({ command, label, ...button }: Props) {
  return <Button {...button} label={label ?? labelOf(command)} keys={spoken(keyOf(command))} />;
}
