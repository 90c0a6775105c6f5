/** The table of variants of a batch: a name, one change, and what it changes; by hand or from CSV. */

import { signal } from "@preact/signals";

import { selectedCount } from "../paint/selected";
import { sendBlob } from "../net/blobs";
import { batchAsset } from "../state/assets";
import { newRow, rowsFromCsv, type VariantKind, type VariantRow } from "../state/batch";
import { state } from "../state/store";
import { Button, FileButton } from "./parts";

const KINDS: readonly (readonly [VariantKind, string])[] = [
  ["color", "New colour"],
  ["sliders", "Adjustment"],
  ["file", "LUT or picture"],
  ["none", "As it is"],
];
const NUMBERS = [
  ["exposure", "Exposure", 5, 0.1],
  ["temperature", "Temperature", 1, 0.05],
  ["saturation", "Saturation", 1, 0.05],
  ["hue", "Hue, degrees", 180, 1],
] as const;
/** As the server allows. */
const MAX_ROWS = 200;
/** Layers that paint, whose Gaussians can be changed by themselves. */
const PAINTS = ["paint", "picture", "clone", "merged"];

export const rows = signal<VariantRow[]>([newRow()]);
const csv = signal("");
const csvOpen = signal(false);
const problem = signal("");

/** Value and name of what a row may change. */
function regions(): (readonly [string, string])[] {
  const now = state.value;
  return [
    ["everything", "Everything"],
    ...(selectedCount.value > 0 ? [["selected", "What is selected"] as const] : []),
    ...(now?.selection.names ?? []).map((name) => [`selection:${name}`, name] as const),
    ...(now?.layers ?? [])
      .filter((layer) => layer.visible && PAINTS.includes(layer.kind))
      .filter((layer) => !batchAsset.value || layer.asset === batchAsset.value.id)
      .map((layer) => [`layer:${layer.id}`, `Layer ${layer.name}`] as const),
  ];
}

const change = (id: number, part: Partial<VariantRow>) =>
  (rows.value = rows.value.map((row) => (row.id === id ? { ...row, ...part } : row)));

async function takeFile(id: number, file: File | undefined): Promise<void> {
  if (!file) return;
  problem.value = "";
  try {
    const kind = /\.cube$/i.test(file.name) ? "lut" : "match";
    change(id, { file: { blob: await sendBlob(file, file.name), name: file.name, kind } });
  } catch (error) {
    problem.value = (error as Error).message;
  }
}

function importCsv(): void {
  try {
    const region = rows.value.at(-1)?.region ?? "everything";
    const more = rowsFromCsv(csv.value, regions(), region);
    const filled = rows.value.filter((row) => row.name.trim());
    rows.value = [...filled, ...more].slice(0, MAX_ROWS);
    csv.value = problem.value = "";
    csvOpen.value = false;
  } catch (error) {
    problem.value = (error as Error).message;
  }
}

export function BatchVariants() {
  const places = regions();
  const add = () => (rows.value = [...rows.value, newRow({ region: rows.value.at(-1)?.region })]);
  return (
    <>
      <div class="batch-list" tabIndex={0} role="region" aria-label="Variants">
        <table class="variants">
          <thead>
            <tr>
              <th scope="col">Name</th>
              <th scope="col">Change</th>
              <th scope="col">To</th>
              <th scope="col">Where</th>
              <th scope="col">
                <span class="unseen">Row</span>
              </th>
            </tr>
          </thead>
          <tbody>
            {rows.value.map((row, index) => (
              <Row key={row.id} row={row} number={index + 1} places={places} />
            ))}
          </tbody>
        </table>
      </div>
      <p class="row">
        <Button label="Add a row" icon="plus" text="Row" disabled={rows.value.length >= MAX_ROWS} onClick={add} />
        <Button
          label="Names and colours as CSV"
          text="From CSV"
          pressed={csvOpen.value}
          onClick={() => (csvOpen.value = !csvOpen.value)}
        />
        {rows.value.length > 1 && (
          <Button label="Remove all rows" text="Clear" onClick={() => (rows.value = [newRow()])} />
        )}
      </p>
      {csvOpen.value && (
        <>
          <textarea
            aria-label="CSV: a name and a colour in each line"
            rows={5}
            placeholder={"navy,#1f2a44\nbrick,#a0432c,Layer sole"}
            value={csv.value}
            onInput={(event) => (csv.value = event.currentTarget.value)}
          />
          <p class="row">
            <Button label="Make rows" text="Make rows" disabled={!csv.value.trim()} onClick={importCsv} />
            <FileButton
              label="CSV file"
              accept=".csv,.txt,text/csv,text/plain"
              onFiles={([file]) => void file?.text().then((text) => (csv.value = text.slice(0, 100_000)))}
            />
            <span class="quiet">name, colour, and (optional) a selection or layer</span>
          </p>
        </>
      )}
      {problem.value && (
        <p class="problem" role="alert">
          {problem.value}
        </p>
      )}
    </>
  );
}

function Row({
  row,
  number,
  places,
}: {
  row: VariantRow;
  number: number;
  places: readonly (readonly [string, string])[];
}) {
  const set = (part: Partial<VariantRow>) => change(row.id, part);
  const there = places.some(([key]) => key === row.region);
  return (
    <tr>
      <td>
        <input
          type="text"
          aria-label={`Name ${number}`}
          placeholder="navy"
          maxLength={100}
          value={row.name}
          onInput={(event) => set({ name: event.currentTarget.value })}
        />
      </td>
      <td>
        <select
          aria-label={`Change ${number}`}
          value={row.kind}
          onChange={(event) => set({ kind: event.currentTarget.value as VariantKind })}
        >
          {KINDS.map(([key, name]) => (
            <option key={key} value={key}>
              {name}
            </option>
          ))}
        </select>
      </td>
      <td>
        {row.kind === "color" && (
          <span class="group">
            <input
              type="color"
              aria-label={`Colour ${number}`}
              value={row.color}
              onInput={(event) => set({ color: event.currentTarget.value })}
            />
            <code>{row.color}</code>
          </span>
        )}
        {row.kind === "sliders" && (
          <span class="numbers">
            {NUMBERS.map(([key, label, limit, step]) => (
              <label key={key}>
                <span class="quiet">{label}</span>
                <input
                  type="number"
                  min={-limit}
                  max={limit}
                  step={step}
                  value={row[key]}
                  onInput={(event) => {
                    const typed = event.currentTarget.valueAsNumber;
                    if (Number.isFinite(typed)) set({ [key]: Math.max(-limit, Math.min(limit, typed)) });
                  }}
                />
              </label>
            ))}
          </span>
        )}
        {row.kind === "file" && (
          <span class="group">
            <FileButton
              label={row.file ? row.file.name : "Choose"}
              accept=".cube,image/png,image/jpeg,image/webp"
              onFiles={([file]) => void takeFile(row.id, file)}
            />
          </span>
        )}
      </td>
      <td>
        {row.kind !== "none" && (
          <select
            aria-label={`What changes ${number}`}
            value={there ? row.region : "everything"}
            onChange={(event) => set({ region: event.currentTarget.value })}
          >
            {places.map(([key, name]) => (
              <option key={key} value={key}>
                {name}
              </option>
            ))}
          </select>
        )}
      </td>
      <td>
        <Button
          icon="close"
          label={`Remove row ${number}`}
          disabled={rows.value.length === 1}
          onClick={() => (rows.value = rows.value.filter((one) => one.id !== row.id))}
        />
      </td>
    </tr>
  );
}
