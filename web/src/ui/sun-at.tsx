/** A sun by date, time and place. */

import { signal } from "@preact/signals";

import { placeSun, type SunPlaceAndTime } from "../lights/light-files";
import { Button, NumberField } from "./parts";

const two = (value: number): string => String(value).padStart(2, "0");
function now(): SunPlaceAndTime {
  const date = new Date();
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return { time: `${day}T12:00`, zone: -date.getTimezoneOffset() / 60, latitude: 48.1, longitude: 11.6, north: 180 };
}
/** The same for all suns: an asset stands in one place. */
const place = signal<SunPlaceAndTime>(now());

interface Props {
  id: number;
  name: string;
  disabled?: boolean;
}

export function SunAt({ id, name, disabled }: Props) {
  const set = (part: Partial<SunPlaceAndTime>) => (place.value = { ...place.value, ...part });
  const { time, zone, latitude, longitude, north } = place.value;
  const number = (label: string, value: number, low: number, high: number, key: keyof SunPlaceAndTime, digits = 2) => (
    <label>
      {label}
      <NumberField
        label={`${label} of ${name}`}
        value={value}
        min={low}
        max={high}
        digits={digits}
        unit=""
        disabled={disabled}
        onChange={(next) => set({ [key]: next })}
      />
    </label>
  );
  return (
    <details class="sun-at">
      <summary>By date and place</summary>
      <label>
        Time
        <input
          type="datetime-local"
          aria-label={`Time of ${name}`}
          value={time}
          disabled={disabled}
          onChange={(event) => event.currentTarget.value && set({ time: event.currentTarget.value.slice(0, 16) })}
        />
      </label>
      {number("UTC +", zone, -12, 14, "zone")}
      {number("Latitude", latitude, -90, 90, "latitude")}
      {number("Longitude", longitude, -180, 180, "longitude")}
      {number("North at", north, -360, 360, "north", 0)}
      <p class="row">
        <Button
          label={`Put ${name} there`}
          text="Put it there"
          disabled={disabled}
          onClick={() => void placeSun(id, place.value)}
        />
      </p>
    </details>
  );
}
