/**
 * New light on an asset: a sky, suns on a ball, lamps, exposure, and how much of it. Controlled from outside: it knows no
 * server, and asks for nothing.
 */

import type { ComponentChildren } from "preact";

import {
  AIMED,
  asHex,
  asKelvin,
  changedLamp,
  changedSun,
  EXPOSURE_RANGE,
  hexOf,
  INTENSITY_RANGE,
  isFull,
  MIN_MIX,
  LAMP_FILL,
  SIZE_NAMES,
  SUN_DEGREES,
  without,
  withLamp,
  withSun,
  type LampKind,
  type LampLight,
  type LightColor,
  type LightSettings,
  type SunLight,
} from "../lights/lights";
import { KELVIN_RANGE } from "../lights/kelvin";
import "../style/lights.css";
import { Button, Check, Choice, FileButton, NumberField, Percent, Slider } from "./parts";
import { SunBall } from "./sun-ball";

export interface Sky {
  /** As the operation takes it. */
  name: string;
  /** Of one from a file: what the project holds of it; "": it needs no file. */
  held: string;
  label: string;
  /** Address of its thumbnail. */
  picture: string;
}

interface Props {
  lights: LightSettings;
  skies: readonly Sky[];
  /** Names of rigs that need no file. */
  rigs: readonly string[];
  /** What files and the server know; they end in `onChange`. */
  onSkyFile: (file: File) => void;
  onRig: (rig: string | File) => void;
  onMatch: (files: File[]) => void;
  /** Beside the numbers of a sun. */
  placeOfSun: (sun: SunLight) => ComponentChildren;
  /** The lamp that is chosen, by its id. */
  lamp?: number | null;
  onLamp?: (id: number | null) => void;
  /** What lamps are placed around: world units. */
  asset: { center: readonly number[]; radius: number; up: readonly number[] };
  /** Azimuth of the view, degrees: the balls are seen from there. */
  viewAzimuth?: number;
  disabled?: boolean;
  /** Also while something is dragged. */
  onChange: (lights: LightSettings) => void;
  /** Above everything: what is being set. */
  children?: ComponentChildren;
}

const LAMP_NAMES: readonly (readonly [LampKind, string])[] = [
  ["point", "Point"],
  ["spot", "Spot"],
  ["rect", "Rectangle"],
  ["disk", "Disk"],
  ["sphere", "Sphere"],
];
const AXES = ["X", "Y", "Z"] as const;

export function LightPanel(props: Props) {
  const { lights, asset, viewAzimuth = 0, disabled, onChange } = props;
  const set = (part: Partial<LightSettings>) => onChange({ ...lights, ...part });
  const add = (kind: LampKind) => {
    const next = withLamp(lights, kind, asset);
    onChange(next);
    props.onLamp?.(next.lamps.filter((one) => one.kind === kind).at(-1)!.id);
  };
  const full = disabled || isFull(lights);
  return (
    <div class="light-panel">
      {props.children}
      <h3>Sky</h3>
      <SkyPicker {...props} />
      <p class="row">
        <FileButton
          label="Sky from a file..."
          accept=".hdr,.exr,.png,.jpg,.jpeg,.webp"
          disabled={disabled}
          onFiles={([file]) => file && props.onSkyFile(file)}
        />
        <FileButton
          label="Match pictures..."
          accept="image/*,.exr,.psd"
          multiple
          disabled={disabled}
          onFiles={(files) => files.length > 0 && props.onMatch(files)}
        />
      </p>
      {lights.source && (
        <p class="row quiet">
          The light before is known: {lights.source.name}
          <Button
            icon="close"
            label="Estimate the light before"
            disabled={disabled}
            onClick={() => set({ source: null })}
          />
        </p>
      )}
      {lights.sky !== "" && (
        <Slider
          label="Turned"
          value={lights.rotate}
          min={0}
          max={360}
          step={1}
          unit="°"
          reset={0}
          disabled={disabled}
          onInput={(rotate) => set({ rotate: Math.round(rotate) })}
        />
      )}
      <h3>Rigs</h3>
      <p class="row">
        <select
          aria-label="Lights of a rig"
          disabled={disabled}
          value=""
          onChange={(event) => {
            const name = event.currentTarget.value;
            event.currentTarget.value = "";
            if (name) props.onRig(name);
          }}
        >
          <option value="">Lights of a rig...</option>
          {props.rigs.map((name) => (
            <option key={name} value={name}>
              {name[0].toUpperCase() + name.slice(1)}
            </option>
          ))}
        </select>
        <FileButton
          label="Rig from a file..."
          accept=".json,.usda,.usd,.glb,.gltf"
          disabled={disabled}
          onFiles={([file]) => file && props.onRig(file)}
        />
      </p>
      <h3>Suns</h3>
      {lights.suns.map((sun, k) => (
        <SunRow
          key={sun.id}
          name={lights.suns.length > 1 ? `Sun ${k + 1}` : "Sun"}
          sun={sun}
          viewAzimuth={viewAzimuth}
          disabled={disabled}
          place={props.placeOfSun(sun)}
          onChange={(part) => onChange(changedSun(lights, sun.id, part))}
          onRemove={() => onChange(without(lights, sun.id))}
        />
      ))}
      <p class="row">
        <Button
          icon="plus"
          label="Add a sun"
          text="Sun"
          disabled={full}
          onClick={() => onChange(withSun(lights, viewAzimuth + 45))}
        />
      </p>
      <h3>Lamps</h3>
      {lights.lamps.map((lamp, k) => (
        <LampRow
          key={lamp.id}
          number={k + 1}
          lamp={lamp}
          asset={asset}
          disabled={disabled}
          chosen={props.lamp === lamp.id}
          onChoose={() => props.onLamp?.(lamp.id)}
          onChange={(part) => onChange(changedLamp(lights, lamp.id, part))}
          onRemove={() => onChange(without(lights, lamp.id))}
        />
      ))}
      <p class="row">
        {LAMP_NAMES.map(([kind, label]) => (
          <Button
            key={kind}
            label={`Add a lamp: ${label.toLowerCase()}`}
            text={label}
            disabled={full}
            onClick={() => add(kind)}
          />
        ))}
      </p>
      <h3>All of it</h3>
      <Slider
        label="Exposure"
        value={lights.exposure}
        min={EXPOSURE_RANGE[0]}
        max={EXPOSURE_RANGE[1]}
        step={0.05}
        digits={2}
        reset={0}
        disabled={disabled}
        onInput={(exposure) => set({ exposure })}
      />
      <Percent
        label="New light"
        value={lights.mix}
        min={MIN_MIX}
        reset={1}
        disabled={disabled}
        onInput={(mix) => set({ mix })}
      />
      {!lights.add && (
        <Percent
          label="All around"
          value={lights.fill ?? (lights.sky === "" ? LAMP_FILL : 0)}
          reset={lights.sky === "" ? LAMP_FILL : 0}
          disabled={disabled}
          onInput={(fill) => set({ fill })}
        />
      )}
      <Check
        label="Add to the light that is there"
        value={lights.add}
        disabled={disabled}
        onChange={(add) => set({ add })}
      />
      <Check label="Shadows" value={lights.shadows} disabled={disabled} onChange={(shadows) => set({ shadows })} />
    </div>
  );
}

function SkyPicker({ lights, skies, disabled, onChange }: Props) {
  return (
    <div class="skies" role="radiogroup" aria-label="Sky">
      <button
        type="button"
        role="radio"
        aria-checked={lights.sky === ""}
        disabled={disabled}
        onClick={() => onChange({ ...lights, sky: "", held: "" })}
      >
        <span class="none" aria-hidden="true" />
        None
      </button>
      {skies.map(({ name, label, picture, held }) => (
        <button
          type="button"
          role="radio"
          key={held + name}
          title={label}
          aria-checked={lights.sky === name && lights.held === held}
          disabled={disabled}
          onClick={() => onChange({ ...lights, sky: name, held })}
        >
          <img src={picture} alt="" />
          {label}
        </button>
      ))}
    </div>
  );
}

interface ColorProps {
  name: string;
  color: LightColor;
  intensity: number;
  disabled?: boolean;
  onChange: (part: { color?: LightColor; intensity?: number }) => void;
}

/** A colour or a temperature, and how bright. */
function ColorAndIntensity({ name, color, intensity, disabled, onChange }: ColorProps) {
  const warm = "kelvin" in color;
  return (
    <>
      <p class="row">
        <Choice
          label={`Colour of ${name}`}
          value={warm ? "kelvin" : "hex"}
          options={[
            ["hex", "Colour"],
            ["kelvin", "Temperature"],
          ]}
          disabled={disabled}
          onChange={(kind) => onChange({ color: kind === "hex" ? asHex(color) : asKelvin(color) })}
        />
        {warm ? (
          <span class="swatch-of-light" style={{ background: hexOf(color) }} />
        ) : (
          <input
            type="color"
            aria-label={`Colour of ${name}, picked`}
            value={hexOf(color)}
            disabled={disabled}
            onInput={(event) => onChange({ color: { hex: event.currentTarget.value } })}
          />
        )}
      </p>
      {warm && (
        <Slider
          label="Kelvin"
          value={color.kelvin}
          min={KELVIN_RANGE[0]}
          max={KELVIN_RANGE[1]}
          log
          reset={6500}
          unit=" K"
          disabled={disabled}
          onInput={(kelvin) => onChange({ color: { kelvin: Math.round(kelvin) } })}
        />
      )}
      <Slider
        label="Intensity"
        value={intensity}
        min={INTENSITY_RANGE[0]}
        max={INTENSITY_RANGE[1]}
        log
        digits={2}
        reset={1}
        disabled={disabled}
        onInput={(next) => onChange({ intensity: next })}
      />
    </>
  );
}

interface SunProps {
  name: string;
  sun: SunLight;
  viewAzimuth: number;
  place: ComponentChildren;
  disabled?: boolean;
  onChange: (part: Partial<SunLight>) => void;
  onRemove: () => void;
}

function SunRow({ name, sun, viewAzimuth, place, disabled, onChange, onRemove }: SunProps) {
  return (
    <div class="light" role="group" aria-label={name}>
      <header>
        <b>{name}</b>
        <Button icon="close" label={`Remove ${name}`} disabled={disabled} onClick={onRemove} />
      </header>
      <div class="sun-row">
        <SunBall
          label={`${name}: drag it where the light comes from`}
          sun={sun}
          color={hexOf(sun.color)}
          viewAzimuth={viewAzimuth}
          disabled={disabled}
          onInput={onChange}
        />
        <span class="sun-numbers">
          <label>
            Azimuth
            <NumberField
              label={`Azimuth of ${name}`}
              value={sun.azimuth}
              min={-180}
              max={180}
              digits={0}
              unit="°"
              disabled={disabled}
              onChange={(azimuth) => onChange({ azimuth })}
            />
          </label>
          <label>
            Elevation
            <NumberField
              label={`Elevation of ${name}`}
              value={sun.elevation}
              min={-90}
              max={90}
              digits={0}
              unit="°"
              disabled={disabled}
              onChange={(elevation) => onChange({ elevation })}
            />
          </label>
        </span>
      </div>
      {place}
      <Slider
        label="Size"
        value={sun.size}
        min={SUN_DEGREES}
        max={90}
        log
        digits={1}
        unit="°"
        reset={SUN_DEGREES}
        disabled={disabled}
        onInput={(size) => onChange({ size })}
      />
      <ColorAndIntensity name={name} {...sun} disabled={disabled} onChange={onChange} />
    </div>
  );
}

interface LampProps {
  number: number;
  lamp: LampLight;
  asset: Props["asset"];
  chosen: boolean;
  onChoose: () => void;
  disabled?: boolean;
  onChange: (part: Partial<LampLight>) => void;
  onRemove: () => void;
}

function LampRow({
  number,
  lamp,
  asset: { center, radius },
  chosen,
  onChoose,
  disabled,
  onChange,
  onRemove,
}: LampProps) {
  const name = `${LAMP_NAMES.find(([kind]) => kind === lamp.kind)![1]} ${number}`;
  const digits = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(radius))));
  const far = 100 * radius;
  const vector = (label: string, key: "position" | "target") => (
    <p class="row vector">
      <span class="quiet">{label}</span>
      {AXES.map((axis, k) => (
        <NumberField
          key={axis}
          label={`${label} of ${name}, ${axis}`}
          value={lamp[key][k]}
          min={center[k] - far}
          max={center[k] + far}
          digits={digits}
          unit=""
          disabled={disabled}
          onChange={(value) => onChange({ [key]: lamp[key].map((one, at) => (at === k ? value : one)) })}
        />
      ))}
    </p>
  );
  return (
    <div
      class={`light${chosen ? " chosen" : ""}`}
      role="group"
      aria-label={name}
      onPointerDown={onChoose}
      onFocusCapture={onChoose}
    >
      <header>
        <b>{name}</b>
        <Button icon="close" label={`Remove ${name}`} disabled={disabled} onClick={onRemove} />
      </header>
      {vector("At", "position")}
      {AIMED.includes(lamp.kind) && vector("Looks at", "target")}
      {SIZE_NAMES[lamp.kind].map(([label, unit], k) => (
        <Slider
          key={label}
          label={label}
          value={lamp.sizes[k]}
          min={unit === "°" ? 1 : 0.01 * radius}
          max={unit === "°" ? 170 : 4 * radius}
          log={unit !== "°"}
          step={1}
          digits={unit === "°" ? 0 : digits}
          unit={unit}
          disabled={disabled}
          onInput={(value) => onChange({ sizes: lamp.sizes.map((one, at) => (at === k ? value : one)) })}
        />
      ))}
      <ColorAndIntensity name={name} {...lamp} disabled={disabled} onChange={onChange} />
    </div>
  );
}
