/** The options of a layer whose kind has no panel of its own: controls made from what the server says of them. */

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";

import type { LayerInfo, OptionInfo } from "../messages";
import { run } from "../editor/editor";
import { readOnly } from "../state/store";
import { during, withUnderWay } from "../state/under-way";
import { Check, Choice, NumberField, Slider } from "./parts";

/** Kinds whose options have controls elsewhere. */
const OWN_PANELS = new Set(["paint", "picture", "clone", "look", "erase", "hide", "fill", "relief", "merged", "light"]);

/** Of which layer these are the options, as the server said last. */
const listed = signal<{ layer: string; options: OptionInfo[] }>({ layer: "", options: [] });

/** The layer whose panel is open: answers about another come too late. */
let open = "";

async function list(layer: string): Promise<void> {
  if (layer !== open) return;
  const answer = await run("layer.options", { layer });
  if (!answer || layer !== open) return;
  listed.value = { layer, options: answer.options };
}

const nameOf = (layer: string, option: string): string => `option ${layer} ${option}`;

async function change(layer: LayerInfo, name: string, value: OptionInfo["value"]): Promise<void> {
  await run("layer.set", { layer: layer.id, parameters: { [name]: value } }, layer.name);
  // Also after a refusal, and where a value was brought into its range: the list knows.
  await list(layer.id);
}

const set = (layer: LayerInfo, name: string, value: OptionInfo["value"]) =>
  void during(nameOf(layer.id, name), (one: OptionInfo) => ({ ...one, value }), change(layer, name, value));

export function OptionSettings({ layer }: { layer: LayerInfo | null }) {
  const id = layer && !OWN_PANELS.has(layer.kind) ? layer.id : "";
  const parameters = id && JSON.stringify(layer?.parameters);
  useEffect(() => {
    open = id;
    if (id) void list(id);
  }, [id, parameters]);
  // While the newest are on their way the controls of the same layer stay where they are.
  if (!layer || !id || listed.value.layer !== id) return null;
  const options = listed.value.options.map((one) => withUnderWay(nameOf(id, one.name), one));
  return (
    <details class="layer-mask" open>
      <summary>Options of {layer.kind}</summary>
      {options.map((option) => (
        <div key={option.name} title={option.help}>
          {option.optional && <OptionalCheck option={option} onChange={(value) => set(layer, option.name, value)} />}
          {option.value !== null && (
            <OptionControl option={option} onChange={(value) => set(layer, option.name, value)} />
          )}
        </div>
      ))}
    </details>
  );
}

interface ControlProps {
  option: OptionInfo;
  onChange: (value: OptionInfo["value"]) => void;
}

/** What may be left open is set or not; once set, its control stands below. */
function OptionalCheck({ option, onChange }: ControlProps) {
  const first = { number: option.low ?? 0, whole: option.low ?? 0, flag: true, choice: option.choices[0] ?? "" };
  const begin = option.default ?? (option.kind === "lines" ? [] : option.kind === "text" ? "" : first[option.kind]);
  return (
    <Check
      label={`Set ${option.label.toLowerCase()}`}
      value={option.value !== null}
      disabled={readOnly.value}
      onChange={(set) => onChange(set ? begin : null)}
    />
  );
}

function OptionControl({ option, onChange }: ControlProps) {
  const { label, kind, value, low, high } = option;
  const disabled = readOnly.value;
  if (kind === "flag") return <Check label={label} value={Boolean(value)} disabled={disabled} onChange={onChange} />;
  if (kind === "choice") {
    const options = option.choices.map((one) => [one, one] as const);
    return <Choice label={label} value={String(value)} options={options} disabled={disabled} onChange={onChange} />;
  }
  if (kind === "lines" || kind === "text") return <TextControl option={option} onChange={onChange} />;
  const digits = kind === "whole" ? 0 : 2;
  const rounded = (to: number) => onChange(kind === "whole" ? Math.round(to) : to);
  if (low !== null && high !== null) {
    const step = kind === "whole" ? 1 : (high - low) / 200;
    const reset = Number(option.default);
    return (
      <Slider
        {...{ label, digits, step, disabled, reset }}
        value={Number(value)}
        min={low}
        max={high}
        onInput={() => undefined}
        onChange={rounded}
      />
    );
  }
  return (
    <label class="choice">
      <span>{label}</span>
      <NumberField
        {...{ label, digits, disabled }}
        unit=""
        value={Number(value)}
        min={low ?? -Infinity}
        max={high ?? Infinity}
        onChange={rounded}
      />
    </label>
  );
}

/** Words, or a list of them, one in a line. What is being typed stays while answers to other changes come in. */
function TextControl({ option, onChange }: ControlProps) {
  const { label, value } = option;
  const [draft, setDraft] = useState<string | null>(null);
  const lines = Array.isArray(value) ? value : null;
  const shown = draft ?? (lines ? lines.join("\n") : String(value));
  const field = {
    "aria-label": lines ? `${label}, one in a line` : label,
    value: shown,
    disabled: readOnly.value,
    onKeyDown: (event: KeyboardEvent) => event.stopPropagation(),
  };
  const commit = (text: string) => {
    setDraft(null);
    const words = text.split("\n").map((one) => one.trim());
    onChange(lines ? words.filter(Boolean) : text);
  };
  return (
    <label class="choice">
      <span>{label}</span>
      {lines ? (
        <textarea
          {...field}
          rows={Math.min(shown.split("\n").length + 1, 6)}
          onInput={(event) => setDraft(event.currentTarget.value)}
          onBlur={(event) => draft !== null && commit(event.currentTarget.value)}
        />
      ) : (
        <input
          type="text"
          {...field}
          onInput={(event) => setDraft(event.currentTarget.value)}
          onBlur={(event) => draft !== null && commit(event.currentTarget.value)}
          onChange={(event) => draft !== null && commit(event.currentTarget.value)}
        />
      )}
    </label>
  );
}
