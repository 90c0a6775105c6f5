/** The asset as a file: which format, what it costs, and how large it will be. */

import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";

import { download } from "../net/blobs";
import { camera, state, toast } from "../state/store";
import { run } from "../state/studio";
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
  [HTML]: ["Web page", "one file that shows the asset by itself, also from disk"],
};

const chosen = signal("");
const removing = signal(false);
const turning = signal(true);
/** Of several assets the one that is exported alone; ALL: every visible one, in its own range of rows. */
const ALL = "all";
const which = signal(ALL);

/** "1.2 MB". */
export const sizeOf = (bytes: number): string =>
  bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.max(1, Math.round(bytes / 1e3))} kB`;

export function ExportAsset() {
  const now = state.value;
  const [sizes, setSizes] = useState<Record<string, number> | null>(null);
  const version = now?.version ?? 0;
  useEffect(() => {
    let stale = false;
    void run("export.sizes", {}).then((answer) => !stale && answer && setSizes(answer.sizes));
    return () => void (stale = true);
  }, [version]);
  if (!now) return null;
  const formats = [...now.formats, HTML];
  const stem = now.asset.name.replace(/\.[^.]*$/, "");
  const usual = formats.find((one) => one === `.${now.asset.format}`) ?? ".ply";
  const ending = formats.includes(chosen.value) ? chosen.value : usual;
  const give = async () => {
    const alone = now.assets.length > 1 ? now.assets.find((one) => one.id === which.value) : undefined;
    const file = `${alone ? alone.name.replace(/\.[^.]*$/, "") : stem}-edited${ending}`;
    const view = camera.value;
    const label = `Writing ${file}`;
    const page = ending === HTML;
    if (page && !view) return;
    const answer = page
      ? await run("export.html", { file: `${stem}${ending}`, camera: view!, turning: turning.value }, label)
      : await run(
          "export",
          {
            file,
            remove_hidden: removing.value && (alone !== undefined || now.assets.length === 1),
            asset: alone?.id ?? null,
          },
          label,
        );
    if (!answer) return;
    download(answer.url, answer.file);
    toast("info", `${answer.file}, ${sizeOf(answer.bytes)}`, page ? "" : "Its receipt is under Receipt.");
  };
  return (
    <>
      <h3 id="formats">Export the asset</h3>
      {now.assets.length > 1 && (
        <p class="row">
          <Choice
            label="Which"
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
            />
            <b>{WORDS[one]?.[0] ?? one}</b>
            <span class="quiet">{WORDS[one]?.[1] ?? ""}</span>
            <span class="size">{sizes && sizes[one] !== undefined ? `about ${sizeOf(sizes[one])}` : "..."}</span>
          </label>
        ))}
      </div>
      {ending === HTML ? (
        <p class="row">
          <Check label="Turns until it is touched" value={turning.value} onChange={(on) => (turning.value = on)} />
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
          : "Gaussians that no layer touched are written as they were read, bit for bit, where the format is the same (.sog has one palette for all, which moves with new colours)."}
      </p>
    </>
  );
}
