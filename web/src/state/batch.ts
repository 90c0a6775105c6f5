/** The studio's batch as the server tells it, and the rows of a table of variants. Pure but for its signals. */

import { signal } from "@preact/signals";

import type { BatchAnswer, BatchEvent, BatchInfo, BatchVariant } from "../messages";

/** null: there is none. */
export const batch = signal<BatchInfo | null>(null);
export const batchOpen = signal(false);

/** Of what `batch` holds, and the highest of events about jobs of a batch that was not known yet. */
let revision = -1;
let missed = -1;

/** Answers and events overtake one another: what is older than what is there already is left out. */
export function applyBatch(news: BatchAnswer | BatchEvent): void {
  if (news.revision < revision) return;
  const now = batch.value;
  if ("job" in news && news.job && !news.batch) {
    const { id, job, zip_url } = news;
    if (now?.id !== id) return void (missed = Math.max(missed, news.revision));
    batch.value = { ...now, zip_url, jobs: now.jobs.map((one) => (one.number === job.number ? job : one)) };
  } else batch.value = news.batch;
  revision = news.revision;
}

/** What a server says that may be another one: its revisions begin anew. `ask`: for the batch as it is. */
export async function learnBatch(ask: () => Promise<BatchAnswer>): Promise<void> {
  revision = missed = -1;
  do applyBatch(await ask());
  while (revision < missed);
}

export const atWork = (one: BatchInfo | null): boolean => one?.state === "running" || one?.state === "cancelling";

/** How many jobs are in one of some states. */
export const countOf = (one: BatchInfo, ...states: string[]): number =>
  one.jobs.filter((job) => states.includes(job.state)).length;

export type VariantKind = "color" | "sliders" | "file" | "none";

export interface VariantRow {
  id: number;
  name: string;
  kind: VariantKind;
  color: string;
  exposure: number;
  temperature: number;
  saturation: number;
  hue: number;
  /** A LUT, or a picture whose colours are taken. */
  file: { blob: string; name: string; kind: "lut" | "match" } | null;
  /** What changes: "everything", "selected", "selection:NAME" or "layer:ID". */
  region: string;
}

let nextId = 1;

export const newRow = (part: Partial<VariantRow> = {}): VariantRow => ({
  name: "",
  kind: "color",
  color: "#2040a0",
  exposure: 0,
  temperature: 0,
  saturation: 0,
  hue: 0,
  file: null,
  region: "everything",
  ...part,
  id: nextId++,
});

/** Width of a band of hues that is all of them. */
const ALL_HUES = 1e6;

/** A row as the server takes it. Throws an Error that says what is missing. */
export function variantOf(row: VariantRow): BatchVariant {
  const name = row.name.trim();
  if (!name) throw new Error("Every row needs a name.");
  const [on, of] = split(row.region);
  const target = { name, on, of };
  if (row.kind === "none") return target;
  if (row.kind === "color") return { ...target, transfer: { kind: "recolor", color: row.color } };
  if (row.kind === "file") {
    if (!row.file) throw new Error(`${name}: choose a .cube table or a picture.`);
    return { ...target, transfer: { kind: row.file.kind, file: row.file.blob } };
  }
  const { exposure, temperature, saturation, hue } = row;
  if (!(exposure || temperature || saturation || hue)) throw new Error(`${name}: set at least one number.`);
  const hues = hue ? [{ hue: 0, width: ALL_HUES, shift: hue }] : [];
  return { ...target, look: { exposure, temperature, saturation, hues } };
}

function split(region: string): [NonNullable<BatchVariant["on"]>, string] {
  const at = region.indexOf(":");
  const kind = at < 0 ? region : region.slice(0, at);
  return [kind as NonNullable<BatchVariant["on"]>, at < 0 ? "" : region.slice(at + 1)];
}

/**
 * Rows of a CSV: name, colour, and (if there is a third column) what changes, by its name in `regions`. A first line of
 * words is a head. Throws an Error with the line.
 */
export function rowsFromCsv(
  text: string,
  regions: readonly (readonly [string, string])[],
  region: string,
): VariantRow[] {
  const rows: VariantRow[] = [];
  text.split(/\r?\n/).forEach((line, index) => {
    if (!line.trim()) return;
    const separator = ["\t", ";", ","].find((one) => line.includes(one)) ?? ",";
    const cells = line.split(separator).map((cell) => cell.trim().replace(/^"(.*)"$/, "$1"));
    const [name, given = "", where = ""] = cells;
    const color = /^#?[0-9a-f]{6}$/i.test(given) ? `#${given.replace("#", "").toLowerCase()}` : null;
    if (!color && rows.length === 0 && /^colou?r$/i.test(given)) return;
    const at = `Line ${index + 1}:`;
    if (!name) throw new Error(`${at} expected a name before the colour.`);
    if (!color) throw new Error(`${at} expected a colour like #2040a0, got "${given.slice(0, 40)}".`);
    const chosen = regions.find(([, label]) => label.toLowerCase() === where.toLowerCase());
    if (where && !chosen) throw new Error(`${at} there is no selection or layer called "${where.slice(0, 40)}".`);
    rows.push(newRow({ name, color, region: chosen?.[0] ?? region }));
  });
  if (!rows.length) throw new Error("There is no line of a name and a colour.");
  return rows;
}
