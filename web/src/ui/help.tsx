/** The sheet of shortcuts: every command with its keys, which can be changed, and what the mouse and fingers do. */

import { signal } from "@preact/signals";

import { asAtFirst, change, changed, conflict, keysIn, withKey, withoutKeys } from "../keys/bindings";
import { chordOf, spoken } from "../keys/chord";
import { COMMANDS, GESTURES, GROUPS, type CommandId, type Group } from "../keys/table";
import { help } from "../state/store";
import { Button, Dialog } from "./parts";
import { startTour } from "./tour";

/** The command whose new key is awaited, and what was pressed where something is in the way. */
const asking = signal<{ id: CommandId; chord: string } | null>(null);

export function Help() {
  if (!help.value) return null;
  const close = () => {
    asking.value = null;
    help.value = false;
  };
  return (
    <Dialog title="Shortcuts" onClose={close}>
      <p class="row">
        <span class="quiet">Click a key to change it. The browser remembers the keys.</span>
        <span class="gap" />
        <Button label="A tour of five steps" text="Tour" onClick={() => (close(), startTour())} />
        <Button
          label="Give every command its default keys"
          text="Reset all"
          disabled={Object.keys(changed.value).length === 0}
          onClick={() => change({})}
        />
      </p>
      <div class="shortcuts">
        {GROUPS.map((group) => (
          <Section key={group} group={group} />
        ))}
      </div>
    </Dialog>
  );
}

function Section({ group }: { group: Group }) {
  return (
    <section>
      <h3>{group}</h3>
      <dl>
        {COMMANDS.filter((command) => command.group === group).map(({ id, label }) => (
          <Row key={id} id={id} label={label} />
        ))}
        {GESTURES.filter(([of]) => of === group).map(([, how, what]) => (
          <div key={how} class="gesture">
            <dt>{how}</dt>
            <dd>{what}</dd>
          </div>
        ))}
      </dl>
    </section>
  );
}

function Row({ id, label }: { id: CommandId; label: string }) {
  const keys = keysIn(changed.value, id);
  const capture = asking.value?.id === id ? asking.value : null;
  const clash = capture?.chord ? conflict(changed.value, id, capture.chord) : null;
  const accept = (chord: string) => {
    change(withKey(changed.value, id, chord));
    asking.value = null;
  };
  const onKeyDown = (event: KeyboardEvent) => {
    if (!capture) return;
    event.preventDefault();
    event.stopPropagation();
    const chord = chordOf(event);
    if (!chord) return;
    if (chord === "Escape" && id !== "edit.cancel") return void (asking.value = null);
    if (conflict(changed.value, id, chord).text) asking.value = { id, chord };
    else accept(chord);
  };
  return (
    <div>
      <dt>
        <button
          type="button"
          class="keys"
          aria-label={`${capture ? "Press a key" : keys.map(spoken).join(" ") || "none"}: ${label}. Change the key`}
          aria-pressed={capture !== null}
          onClick={() => (asking.value = capture ? null : { id, chord: "" })}
          onKeyDown={onKeyDown}
          onBlur={() => !clash && capture && (asking.value = null)}
        >
          {capture ? (
            <em>Press a key</em>
          ) : keys.length ? (
            keys.flatMap((key) => [<kbd key={key}>{spoken(key)}</kbd>, " "])
          ) : (
            "none"
          )}
        </button>
      </dt>
      <dd>
        {label}
        {clash && (
          <span class="clash" role="alert">
            {clash.text}
            {clash.takes && (
              <Button label={`Use it for ${label}`} text="Use it here" onClick={() => accept(capture!.chord)} />
            )}
            <Button label="Cancel" icon="close" onClick={() => (asking.value = null)} />
          </span>
        )}
        {capture && !clash && (
          <span class="clash">
            {keys.length > 0 && (
              <Button
                label={`No key for ${label}`}
                text="None"
                onClick={() => (change(withoutKeys(changed.value, id)), (asking.value = null))}
              />
            )}
            {changed.value[id] && (
              <Button
                label={`Default keys of ${label}`}
                text="Reset"
                onClick={() => (change(asAtFirst(changed.value, id)), (asking.value = null))}
              />
            )}
          </span>
        )}
      </dd>
    </div>
  );
}
