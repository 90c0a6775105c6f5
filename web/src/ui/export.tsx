/** Pictures of the view out: any size, transparent, with more bits, with what compositors want beside them. */

import { signal } from "@preact/signals";

import type { ViewExport } from "../messages";
import { download } from "../net/blobs";
import { camera, state, toast } from "../state/store";
import { run } from "../editor/editor";
import type { CameraJson } from "../view/camera";
import { chosenCamera, FrameSize, frameChoice } from "./frame-size";
import { Button, Check, Choice, Dialog } from "./parts";

type Aov = NonNullable<ViewExport["aovs"]>[number];
type Options = Omit<ViewExport, "camera" | "to" | "name" | "size">;
type Profile = NonNullable<ViewExport["profile"]>;

const KINDS = [
  ["png 8", "PNG, 8 bits"],
  ["png 16", "PNG, 16 bits"],
  ["exr 16", "EXR, 16 bits (half)"],
  ["exr 32", "EXR, 32 bits (float)"],
] as const;
const CLEAR = [
  ["straight", "Transparent"],
  ["premultiplied", "Transparent, premultiplied"],
] as const;
const AOVS: readonly (readonly [Aov, string])[] = [
  ["alpha", "Alpha"],
  ["depth", "Depth"],
  ["normal", "Normals"],
  ["gaussian-ids", "Gaussian ids"],
  ["coverage", "Coverage"],
];
const PROFILES: readonly (readonly [Profile, string])[] = [
  ["inria", "3DGS"],
  ["playcanvas", "PlayCanvas"],
];

const choice = frameChoice();
const kind = signal<(typeof KINDS)[number][0]>("png 8");
const aovs = signal<readonly Aov[]>([]);
const profile = signal<Profile>("inria");

/** Render the present view and give it out. */
export async function exportView(
  to: "download" | "folder",
  options: Options = {},
  from: CameraJson | null = camera.value,
): Promise<boolean> {
  if (!from) return false;
  const name = `view-${new Date().toISOString().slice(0, 19).replace(/[-:T]/g, "")}`;
  const answer = await run("view.export", { camera: from, to, name, ...options }, "Rendering the view");
  if (!answer) return false;
  if (answer.url) download(answer.url, answer.name);
  else
    toast(
      "info",
      `${answer.file ?? name} is in the folder ${state.value?.folder ?? ""}.`,
      "Edit it and save it there: it is loaded by itself.",
    );
  return true;
}

/** What is chosen in the dialog. */
function chosen(): Options {
  const [format, bits] = kind.value.split(" ") as ["png" | "exr", string];
  const background = choice.background.value;
  const clear = background === "straight" || background === "premultiplied" ? background : null;
  return {
    format,
    bits: Number(bits) as 8 | 16 | 32,
    transparent: clear && format === "exr" ? "premultiplied" : clear,
    aovs: [...aovs.value],
    profile: profile.value,
  };
}

export function ViewExportDialog({ onClose }: { onClose: () => void }) {
  const folder = state.value?.folder;
  const framed = chosenCamera(choice, camera.value);
  const give = async (to: "download" | "folder") => {
    if (await exportView(to, chosen(), framed)) onClose();
  };
  return (
    <Dialog title="Export the view" onClose={onClose}>
      <FrameSize choice={choice} view={camera.value} clear={CLEAR} />
      <p class="row">
        <Choice label="File" value={kind.value} options={KINDS} onChange={(value) => (kind.value = value)} />
      </p>
      <h3>Passes</h3>
      <p class="row">
        {AOVS.map(([name, label]) => (
          <Check
            key={name}
            label={label}
            value={aovs.value.includes(name)}
            onChange={(on) => (aovs.value = on ? [...aovs.value, name] : aovs.value.filter((one) => one !== name))}
          />
        ))}
      </p>
      <p class="row">
        <Choice
          label="Rendered like"
          value={profile.value}
          options={PROFILES}
          onChange={(value) => (profile.value = value)}
        />
      </p>
      <p class="quiet">
        To be painted on, pictures are rendered like 3DGS. EXR holds linear light, multiplied by alpha. Passes come with
        the picture in one ZIP.
      </p>
      <p class="row">
        <Button
          label="Download"
          icon="share"
          text="Download"
          primary
          disabled={!framed}
          onClick={() => void give("download")}
        />
        {folder && (
          <Button
            label={`Save it to the folder ${folder}`}
            text="Save to folder"
            disabled={!framed}
            onClick={() => void give("folder")}
          />
        )}
      </p>
    </Dialog>
  );
}
