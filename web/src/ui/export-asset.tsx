/** The asset as a file: which format, what it costs, and how large it will be. */

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";

import { download } from "../net/blobs";
import { camera, state, toast } from "../state/store";
import { run } from "../editor/editor";
import type { AssetExport, ExportOptions } from "../messages";
import { Button, Check, Choice } from "./parts";

const HTML = ".html";
/** Format -> name, and what is lost in it. */
const WORDS: Record<string, readonly [string, string]> = {
  ".ply": ["PLY", "everything, as trained; every program reads it"],
  ".compressed.ply": ["Compressed PLY", "8 to 11 bits; PlayCanvas, SuperSplat"],
  ".splat": ["splat", "8-bit colours, no view dependence"],
  ".spz": ["SPZ", "8 bits and fewer; Niantic, three.js"],
  ".sog": ["SOG", "smallest; one palette for all; PlayCanvas"],
  ".glb": ["glTF", "KHR_gaussian_splatting"],
  [HTML]: ["Web page", "one file that shows the asset in any browser, also from disk"],
};

const chosen = signal("");
const removing = signal(false);
/** Format -> what of it was chosen; nothing: as the asset has it, or as the format is usually written. */
const choices = signal<Record<string, ExportOptions>>({});
/** Which way the numbers of the file point. */
type Axes = NonNullable<AssetExport["axes"]>;
const axes = signal<Axes>("auto");
const AXES: readonly (readonly [Axes, string])[] = [
  ["auto", "as the format usually has them"],
  ["rdf", "y down, z forward (3DGS, as trained)"],
  ["rub", "y up, z back (OpenGL, three.js)"],
];
const turning = signal(true);
/** Of several assets the one that is exported alone; ALL: every visible one, in its own range of rows. */
const ALL = "all";
const which = signal(ALL);

/** SH degrees above it do not fit in. */
const MAX_DEGREE: Record<string, number> = { ".sog": 3, ".glb": 3, [HTML]: 3 };
const USUAL = "";
const PALETTES = [1024, 4096, 16384, 65536];

/** "1.2 MB". */
export const sizeOf = (bytes: number): string =>
  bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.max(1, Math.round(bytes / 1e3))} kB`;

/** What is asked of the server: what was chosen, and no degree that the format cannot hold. */
function optionsOf(ending: string, degree: number, single: boolean): ExportOptions {
  if (!single && ending !== HTML) return {};
  const most = MAX_DEGREE[ending] ?? degree;
  const value = { ...(degree > most ? { sh_degree: most } : {}) };
  const picked = Object.entries(choices.value[ending] ?? {}).filter(([, one]) => one !== null);
  return { ...value, ...Object.fromEntries(picked) };
}

/** The options that the chosen format has; `degree`: of the asset. */
function FormatOptions(given: {
  holds: readonly string[];
  degree: number;
  antialiased: boolean;
  value: ExportOptions;
  onChange: (value: ExportOptions) => void;
}) {
  const { holds, degree, value } = given;
  const number = (name: "sh_degree" | "spz_version" | "sh_bits" | "sh_palette") => ({
    value: String(value[name] ?? USUAL),
    onChange: (text: string) => given.onChange({ ...value, [name]: text === USUAL ? null : Number(text) }),
  });
  return (
    <p class="format-options">
      {holds.includes("sh_degree") && degree > 0 && (
        <Choice
          label="SH degree"
          {...number("sh_degree")}
          options={[
            [USUAL, `all (${degree})`],
            ...Array.from({ length: degree }, (_, k) => degree - 1 - k).map(
              (k) => [String(k), k ? String(k) : "0, no view dependence"] as const,
            ),
          ]}
        />
      )}
      {holds.includes("sh_bits") && degree > 0 && value.sh_degree !== 0 && (
        <Choice
          label="SH precision"
          {...number("sh_bits")}
          options={[
            [USUAL, "default"],
            ["8", "8 bits, largest"],
            ["7", "7 bits"],
            ["6", "6 bits"],
            ["5", "5 bits"],
            ["4", "4 bits, smallest"],
          ]}
        />
      )}
      {holds.includes("sh_palette") && degree > 0 && value.sh_degree !== 0 && (
        <Choice
          label="SH palette"
          {...number("sh_palette")}
          options={[
            [USUAL, "default"],
            ...PALETTES.map((count) => [String(count), `${count.toLocaleString("en")} entries`] as const),
          ]}
        />
      )}
      {holds.includes("spz_version") && (
        <Choice
          label="Version"
          {...number("spz_version")}
          options={[
            [USUAL, "default"],
            ["2", "2, oldest viewers"],
            ["3", "3, most viewers"],
            ["4", "4, smaller, newest viewers"],
          ]}
        />
      )}
      {holds.includes("antialiased") && (
        <Choice
          label="Trained antialiased"
          value={value.antialiased === true ? "yes" : value.antialiased === false ? "no" : USUAL}
          options={[
            [USUAL, `unchanged (${given.antialiased ? "yes" : "no"})`],
            ["yes", "yes (Mip-Splatting)"],
            ["no", "no"],
          ]}
          onChange={(text) => given.onChange({ ...value, antialiased: text === USUAL ? null : text === "yes" })}
        />
      )}
    </p>
  );
}

export function ExportAsset() {
  const now = state.value;
  const [sizes, setSizes] = useState<Record<string, number> | null>(null);
  /** Of formats with options. */
  const [chosenSizes, setChosenSizes] = useState<Record<string, number>>({});
  const [holds, setHolds] = useState<Record<string, string[]>>({});
  const version = now?.version ?? 0;
  const formats = [...(now?.formats ?? []), HTML];
  const usual = formats.find((one) => one === `.${now?.asset.format}`) ?? ".ply";
  const ending = formats.includes(chosen.value) ? chosen.value : usual;
  const degree = Math.sqrt(now?.asset.sh_coefficients ?? 1) - 1;
  const alone = now && now.assets.length > 1 ? now.assets.find((one) => one.id === which.value) : undefined;
  const single = alone !== undefined || now?.assets.length === 1;
  const [remove_hidden, asset] = [removing.value && single, alone?.id ?? null];
  const request = { remove_hidden, asset };
  useEffect(() => {
    let stale = false;
    void run("export.sizes", { remove_hidden, asset }).then((answer) => {
      if (stale || !answer) return;
      setHolds(answer.choices);
      setSizes(answer.sizes);
    });
    return () => void (stale = true);
  }, [version, remove_hidden, asset]);
  const keyOf = (one: string) => JSON.stringify([version, request, one, optionsOf(one, degree, single)]);
  const options = optionsOf(ending, degree, single);
  // biome-ignore lint/correctness/useExhaustiveDependencies: the key names everything that it depends on
  useEffect(() => {
    if (!Object.keys(options).length || chosenSizes[keyOf(ending)] !== undefined) return;
    const key = keyOf(ending);
    void run("export.sizes", { ending, options, ...request }).then(
      (answer) => answer && setChosenSizes((before) => ({ ...before, [key]: answer.sizes[ending]! })),
    );
  }, [keyOf(ending)]);
  const bytesOf = (one: string) =>
    Object.keys(optionsOf(one, degree, single)).length ? chosenSizes[keyOf(one)] : sizes?.[one];
  if (!now) return null;
  const stem = now.asset.name.replace(/\.[^.]*$/, "");
  const give = async () => {
    const file = `${alone ? alone.name.replace(/\.[^.]*$/, "") : stem}-edited${ending}`;
    const view = camera.value;
    const label = `Writing ${file}`;
    const page = ending === HTML;
    if (page && !view) return;
    const answer = page
      ? await run("export.html", { file: `${stem}${ending}`, camera: view!, turning: turning.value, options }, label)
      : await run("export", { file, options, axes: single ? axes.value : "auto", ...request }, label);
    if (!answer) return;
    download(answer.url, answer.file);
    const lost = answer.lost && `This format rounds: ${answer.lost}. `;
    toast("info", `${answer.file}, ${sizeOf(answer.bytes)}`, page ? "" : `${lost}Its receipt is under Receipt.`);
  };
  return (
    <>
      <h3 id="formats">Export the asset</h3>
      {now.assets.length > 1 && (
        <p class="row">
          <Choice
            label="Assets"
            value={which.value}
            options={[[ALL, "All visible"], ...now.assets.map((one) => [one.id, `${one.name} alone`] as const)]}
            onChange={(id) => (which.value = id)}
          />
        </p>
      )}
      <div class="formats" role="radiogroup" aria-labelledby="formats">
        {formats.map((one) => (
          <label key={one}>
            <input
              type="radio"
              name="format"
              value={one}
              checked={one === ending}
              onChange={() => (chosen.value = one)}
              onKeyDown={(event) => event.key === "Enter" && !event.repeat && void give()}
            />
            <b>{WORDS[one]?.[0] ?? one}</b>
            <span class="quiet">{WORDS[one]?.[1] ?? ""}</span>
            <span class="size">{bytesOf(one) === undefined ? "..." : `about ${sizeOf(bytesOf(one)!)}`}</span>
          </label>
        ))}
      </div>
      {(single || ending === HTML) && (
        <FormatOptions
          holds={holds[ending] ?? []}
          degree={Math.min(degree, MAX_DEGREE[ending] ?? degree)}
          antialiased={now.asset.antialiased}
          value={choices.value[ending] ?? {}}
          onChange={(value) => (choices.value = { ...choices.value, [ending]: value })}
        />
      )}
      {single && ending !== HTML && (
        <p class="format-options">
          <Choice label="Axes" value={axes.value} options={AXES} onChange={(value) => (axes.value = value)} />
          {axes.value !== "auto" && <span class="quiet">To verify the file later, say --axes {axes.value}.</span>}
        </p>
      )}
      {ending === HTML ? (
        <p class="row">
          <Check label="Turns until touched" value={turning.value} onChange={(on) => (turning.value = on)} />
        </p>
      ) : (
        now.layers.some((layer) => layer.kind === "hide") && (
          <p class="row">
            <Check
              label="Remove hidden Gaussians for good (the receipt says so)"
              value={removing.value}
              onChange={(on) => (removing.value = on)}
            />
          </p>
        )
      )}
      <p class="row">
        <Button label="Export" icon="share" text="Export" primary onClick={() => void give()} />
      </p>
      <p class="quiet">
        {ending === HTML
          ? "It opens in any browser of 2023 or later, sends nothing anywhere, and starts with this view. Up to 3 million Gaussians with full colours."
          : Object.keys(options).length
            ? "Gaussians that no layer touched are compared with the asset written the same way; the receipt lists what was left out."
            : "Gaussians that no layer touched are written as they were read, bit for bit, where the format is the same (.sog has one palette for all, which moves with new colours)."}
      </p>
    </>
  );
}
