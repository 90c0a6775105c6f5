/** Small parts that panels are made of. */

import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";

import { Icon, type IconName } from "./icons";

/** The keys go to the view again after a field was written in, or something was clicked on; dialogs keep them. */
export function toStage(from: Element): void {
  if (!from.closest("dialog")) document.getElementById("stage")?.focus({ preventScroll: true });
}

/** Move a list's box just so far that a row of it is seen; nothing around the box moves, as by `scrollIntoView`. */
export function reveal(box: Element | null | undefined, row: Element | null | undefined): void {
  if (!box || !row) return;
  const [seen, one] = [box.getBoundingClientRect(), row.getBoundingClientRect()];
  if (one.top < seen.top) box.scrollTop -= seen.top - one.top;
  else if (one.bottom > seen.bottom) box.scrollTop += Math.min(one.bottom - seen.bottom, one.top - seen.top);
}

export interface ButtonProps {
  icon?: IconName;
  /** What it does. */
  label: string;
  /** Keys that do the same, for the tooltip. */
  keys?: string;
  text?: ComponentChildren;
  pressed?: boolean;
  disabled?: boolean;
  primary?: boolean;
  onClick: () => void;
}

export function Button({ icon, label, keys, text, pressed, disabled, primary, onClick }: ButtonProps) {
  const title = keys ? `${label} (${keys})` : label;
  return (
    <button
      type="button"
      class={`button${primary ? " primary" : ""}${text ? "" : " bare"}`}
      title={title}
      aria-label={text ? undefined : label}
      aria-pressed={pressed}
      disabled={disabled}
      onClick={onClick}
    >
      {icon && <Icon name={icon} />}
      {text && <span>{text}</span>}
    </button>
  );
}

interface SliderProps {
  label: string;
  value: number;
  min: number;
  max: number;
  step?: number;
  /** Steps of the slider are even in the logarithm: sizes. */
  log?: boolean;
  digits?: number;
  unit?: string;
  /** Double click goes there. */
  reset?: number;
  disabled?: boolean;
  onInput: (value: number) => void;
  /** When let go. */
  onChange?: (value: number) => void;
}

export function Slider({
  label,
  value,
  min,
  max,
  step = 0.01,
  log,
  digits = 0,
  unit = "",
  reset,
  disabled,
  onInput,
  onChange,
}: SliderProps) {
  const to = (v: number) => (log ? Math.log(v) : v);
  const from = (v: number) => (log ? Math.exp(v) : v);
  const share = (v: number) => (100 * (to(v) - to(min))) / (to(max) - to(min));
  const zero = !log && min < 0 && max > 0 ? share(0) : 0; // what has two sides is filled from its middle
  const fill = { "--from": `${Math.min(zero, share(value))}%`, "--to": `${Math.max(zero, share(value))}%` };
  return (
    <label class="slider">
      <span class="slider-name">{label}</span>
      <input
        type="range"
        min={to(min)}
        max={to(max)}
        step={log ? 0.001 : step}
        value={to(value)}
        disabled={disabled}
        style={fill}
        aria-label={label}
        aria-valuetext={`${value.toFixed(digits)}${unit}`}
        onInput={(event) => onInput(from(Number(event.currentTarget.value)))}
        onChange={(event) => onChange?.(from(Number(event.currentTarget.value)))}
        onDblClick={() => reset !== undefined && (onInput(reset), onChange?.(reset))}
      />
      <NumberField
        label={label}
        value={value}
        min={min}
        max={max}
        digits={digits}
        unit={unit}
        disabled={disabled}
        onChange={(v) => (onInput(v), onChange?.(v))}
      />
    </label>
  );
}

/** A slider of 0 to 1 in per cent. */
export function Percent({
  value,
  min = 0,
  reset,
  onInput,
  ...rest
}: Pick<SliderProps, "label" | "value" | "reset" | "disabled" | "onInput"> & { min?: number }) {
  return (
    <Slider
      {...rest}
      value={value * 100}
      min={min * 100}
      max={100}
      unit=" %"
      reset={reset === undefined ? undefined : reset * 100}
      onInput={(v) => onInput(v / 100)}
    />
  );
}

interface NumberProps {
  label: string;
  value: number;
  min: number;
  max: number;
  digits: number;
  unit: string;
  disabled?: boolean;
  onChange: (value: number) => void;
}

/** With so many digits behind the point; what rounds to zero has no sign. */
export const rounded = (value: number, digits: number): string => (Number(value.toFixed(digits)) + 0).toFixed(digits);

export function NumberField({ label, value, min, max, digits, unit, disabled, onChange }: NumberProps) {
  const formatted = rounded(value, digits);
  const [draft, setDraft] = useState<string | null>(null);
  const latest = useRef<string | null>(null); // the field is left before it is drawn again
  const entered = useRef(false); // by the click under way
  const write = (text: string | null) => setDraft((latest.current = text));
  const commit = () => {
    const typed = Number.parseFloat(latest.current ?? "");
    write(null);
    if (Number.isFinite(typed)) onChange(Math.max(min, Math.min(max, typed)));
  };
  return (
    <span class="number">
      <input
        type="text"
        inputMode="decimal"
        aria-label={`${label}, number`}
        value={draft ?? formatted}
        disabled={disabled}
        onInput={(event) => write(event.currentTarget.value)}
        onFocus={({ currentTarget: field }) => (field.select(), (entered.current = true))}
        onPointerUp={({ currentTarget: field }) => {
          // the click has put the caret somewhere: what is typed next takes the number's place all the same
          if (entered.current && field.selectionStart === field.selectionEnd) field.select();
          entered.current = false;
        }}
        onBlur={() => latest.current !== null && commit()}
        onKeyDown={(event) => {
          event.stopPropagation();
          if (event.key === "Enter") commit();
          if (event.key === "Escape") write(null);
          if (event.key === "Enter" || event.key === "Escape") toStage(event.currentTarget);
        }}
      />
      {unit}
    </span>
  );
}

interface ChoiceProps<T extends string> {
  label: string;
  value: T;
  options: readonly (readonly [T, string])[];
  disabled?: boolean;
  onChange: (value: T) => void;
}

export function Choice<T extends string>({ label, value, options, disabled, onChange }: ChoiceProps<T>) {
  return (
    <label class="choice">
      <span>{label}</span>
      <select
        value={value}
        disabled={disabled}
        aria-label={label}
        onChange={(event) => onChange(event.currentTarget.value as T)}
      >
        {options.map(([key, name]) => (
          <option key={key} value={key}>
            {name}
          </option>
        ))}
      </select>
    </label>
  );
}

export function Check({
  label,
  value,
  disabled,
  onChange,
}: {
  label: string;
  value: boolean;
  disabled?: boolean;
  onChange: (value: boolean) => void;
}) {
  return (
    <label class="check">
      <input
        type="checkbox"
        checked={value}
        disabled={disabled}
        onChange={(event) => onChange(event.currentTarget.checked)}
      />
      <span>{label}</span>
    </label>
  );
}

/** Opens a file chooser. */
export function FileButton({
  label,
  icon,
  accept,
  multiple,
  bare,
  disabled,
  onFiles,
}: {
  label: string;
  icon?: IconName;
  accept: string;
  multiple?: boolean;
  /** The icon alone; the label is its tooltip. */
  bare?: boolean;
  disabled?: boolean;
  onFiles: (files: File[]) => void;
}) {
  const input = useRef<HTMLInputElement>(null);
  return (
    <>
      <Button
        label={label}
        icon={icon}
        text={bare ? undefined : label}
        disabled={disabled}
        onClick={() => input.current!.click()}
      />
      <input
        ref={input}
        type="file"
        accept={accept}
        multiple={multiple}
        hidden
        aria-hidden="true"
        tabIndex={-1}
        onChange={(event) => {
          onFiles([...(event.currentTarget.files ?? [])]);
          event.currentTarget.value = "";
        }}
      />
    </>
  );
}

/** A modal window; Escape and a click beside it close it. */
export function Dialog({
  title,
  onClose,
  children,
}: {
  title: string;
  onClose: () => void;
  children: ComponentChildren;
}) {
  const box = useRef<HTMLDialogElement>(null);
  useEffect(() => {
    box.current!.showModal();
    // at what is chosen, where the browser would be at the button that closes it
    box.current!.querySelector<HTMLElement>(".dialog-body input:checked")?.focus();
  }, []);
  // At once, and only while it is there: the browser's own `close` event comes a task later, when a key may have opened
  // the next dialog.
  const finish = () => {
    if (!box.current) return;
    box.current.close(); // gives the keys back to what had them
    onClose();
  };
  return (
    <dialog
      ref={box}
      class="dialog"
      aria-label={title}
      onCancel={(event) => {
        if (event.target !== box.current) return; // a file chooser's
        event.preventDefault();
        finish();
      }}
      onClose={(event) => event.target === box.current && finish()}
      onClick={(event) => event.target === box.current && finish()}
      onKeyDown={(event) => event.stopPropagation()}
    >
      <header>
        <h2>{title}</h2>
        <Button icon="close" label="Close" onClick={finish} />
      </header>
      <div class="dialog-body">{children}</div>
    </dialog>
  );
}
