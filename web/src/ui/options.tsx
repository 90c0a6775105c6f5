/** The bar under the header: settings of the tool in hand. */

import { commitPlacement, discardPlacement } from "../paint/lay-placement";
import { editedLayer, placement } from "../paint/placement";
import { inHand } from "../tools";
import { CommandButton } from "./command-button";
import { OverflowBar } from "./overflow-bar";

export function Options() {
  const { name, Settings } = inHand();
  return (
    <OverflowBar class="options" label="Tool settings" more="More settings of the tool" of={name}>
      {placement.value && <Place />}
      <Settings key={name} />
    </OverflowBar>
  );
}

/** Apply or discard the text or the picture that is being placed. */
function Place() {
  return (
    <span class="group">
      <CommandButton
        label="Apply"
        command="edit.apply"
        icon="check"
        text="Apply"
        primary
        onClick={() => void commitPlacement()}
      />
      <CommandButton
        label={editedLayer.value ? "Leave it unchanged" : "Discard it"}
        command="edit.cancel"
        icon="close"
        onClick={() => void discardPlacement()}
      />
    </span>
  );
}
