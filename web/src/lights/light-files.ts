/** Lights that come from files, from the sky at some hour, or from pictures: what the server reads of them, for the panel. */

import { signal } from "@preact/signals";

import { run } from "../editor/editor";
import { sendWithBar } from "../editor/sending";
import type { SkyInfo } from "../messages";
import { camera, toast } from "../state/store";
import { changeLights, shownLights } from "./light-layers";
import { changedSun, lightsOf, NO_LIGHT, type LightSettings } from "./lights";

/** Environments to choose from; null: not asked for yet. */
export const skies = signal<readonly SkyInfo[] | null>(null);
export const rigs = signal<readonly string[]>([]);

export async function learnSkies(): Promise<void> {
  const answer = await run("light.skies", {});
  if (!answer) return;
  const known = new Set(answer.skies.map((one) => one.held));
  // Those that were read and are in no layer (any more) stay for this visit.
  const others = (skies.peek() ?? []).filter((one) => one.held && !known.has(one.held));
  skies.value = [...answer.skies, ...others];
  rigs.value = answer.rigs;
}

const remember = (sky: SkyInfo): void => {
  skies.value = [...(skies.peek() ?? []).filter((one) => one.held !== sky.held), sky];
};

export async function skyFromFile(file: File): Promise<void> {
  const blob = await sendWithBar(file);
  const answer = blob && (await run("light.sky", { file: blob }, `Reading ${file.name}`));
  if (!answer) return;
  remember(answer.sky);
  if (answer.note) toast("info", answer.note);
  await changeLights({ ...shownLights.peek(), sky: answer.sky.name, held: answer.sky.held ?? "" });
}

/** The lights of a rig in place of those that there are; a sky stays, unless the rig has one. */
export async function lightsOfRig(rig: string | File): Promise<void> {
  const file = typeof rig === "string" ? null : await sendWithBar(rig);
  if (typeof rig !== "string" && !file) return;
  const answer = await run("light.rig", typeof rig === "string" ? { name: rig } : { file }, "Reading the rig");
  if (!answer) return;
  for (const note of answer.notes) toast("info", note);
  const now = shownLights.peek();
  const { suns, lamps, fill, add, exposure, sky, rotate } = lightsOf(answer.operation, now.mix);
  const own: LightSettings = { ...now, suns, lamps, fill, add, exposure };
  await changeLights(sky ? { ...own, sky, held: "", rotate } : own);
}

/** The light of pictures of the asset that were relit elsewhere. */
export async function matchPictures(files: File[]): Promise<void> {
  const view = camera.peek();
  if (!view) return;
  const sent = await Promise.all(files.slice(0, 4).map(sendWithBar));
  const pictures = sent.filter((blob): blob is string => blob !== null);
  if (!pictures.length) return;
  const answer = await run("light.match", { pictures, camera: view }, "Finding the light");
  if (!answer) return;
  remember(answer.sky);
  if (answer.note) toast("info", answer.note);
  await changeLights({
    ...NO_LIGHT,
    mix: shownLights.peek().mix,
    sky: answer.sky.name,
    held: answer.sky.held ?? "",
    source: { name: "before.png", held: answer.source },
    exposure: answer.exposure,
  });
}

export interface SunPlaceAndTime {
  /** Local, "2026-06-21T15:00". */
  time: string;
  /** Hours east of Greenwich. */
  zone: number;
  latitude: number;
  longitude: number;
  /** Azimuth at which north lies, degrees. */
  north: number;
}

/** A time with its zone, as ISO 8601 has it. */
export function zoned({ time, zone }: Pick<SunPlaceAndTime, "time" | "zone">): string {
  const minutes = Math.round(Math.abs(zone) * 60);
  const two = (value: number) => String(value).padStart(2, "0");
  return `${time}${zone < 0 ? "-" : "+"}${two(Math.floor(minutes / 60))}:${two(minutes % 60)}`;
}

/** Put a sun where it stands there and then. */
export async function placeSun(id: number, place: SunPlaceAndTime): Promise<void> {
  const { latitude, longitude, north } = place;
  const answer = await run("light.sun_at", { time: zoned(place), latitude, longitude, north }, "The sun's place");
  if (answer) await changeLights(changedSun(shownLights.peek(), id, at(answer)));
}
const at = ({ azimuth, elevation }: { azimuth: number; elevation: number }) => ({ azimuth, elevation });
