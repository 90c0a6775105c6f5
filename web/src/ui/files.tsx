/** Open and save: assets, projects, single layers, exports. */

import { signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";

import type { RecentInfo, RecentProjects } from "../messages";
import { blobUrl, download } from "../net/blobs";
import { pendingStrokes, readOnly, selectedLayer, state, swapped } from "../state/store";
import { editor, run } from "../editor/editor";
import { sendWithBar } from "../editor/sending";
import { ExportAsset } from "./export-asset";
import { Button, Dialog, FileButton } from "./parts";

/** Open a file that the user chose or dropped. */
export async function openFile(file: File): Promise<void> {
  const blob = await sendWithBar(file);
  if (!blob) return;
  if (/\.splatlayer$/i.test(file.name)) {
    const answer = await run("layer.import", { blob }, `Adding ${file.name}`);
    if (answer) selectedLayer.value = answer.layer.id;
  } else if (/\.splatproj$/i.test(file.name)) await run("project.open", { blob }, `Opening ${file.name}`);
  else await run("asset.open", { blob }, `Opening ${file.name}`);
}

export function Files({ saving, onClose }: { saving: boolean; onClose: () => void }) {
  return (
    <Dialog title={saving ? "Save and export" : "Open"} onClose={onClose}>
      {saving ? <Saving onClose={onClose} /> : <Opening onClose={onClose} />}
    </Dialog>
  );
}

function Opening({ onClose }: { onClose: () => void }) {
  const [projects, setProjects] = useState<RecentProjects | null>(null);
  useEffect(() => void run("project.recent", {}).then(setProjects), []);
  // at once: the bar and its Cancel are beside the view
  const open = (_begun: Promise<unknown>) => onClose();
  const isProject = (name: string) => /\.splatproj$/i.test(name);
  return (
    <>
      <p class="row">
        <FileButton
          label="Choose a file"
          icon="open"
          accept=".ply,.splat,.ksplat,.spz,.sog,.glb,.gltf,.zip,.splatproj"
          onFiles={([file]) => file && open(openFile(file))}
        />
        <Button
          label="The demo asset"
          text="Demo asset"
          onClick={() => open(run("asset.open", { demo: true }, "Demo asset"))}
        />
      </p>
      <p class="quiet">
        Every edit is saved in a project file as it is made. What is open now stays in the list below.
      </p>
      <h3>Recent projects</h3>
      <ul class="list">
        {projects?.recent.map((one) => (
          <li key={one.id}>
            <button type="button" disabled={one.is_open} onClick={() => open(openRecent(one))}>
              <RecentEntry project={one} />
            </button>
          </li>
        ))}
        {projects && projects.recent.length === 0 && <li class="quiet">None yet</li>}
      </ul>
      {projects && projects.files.length > 0 && (
        <>
          <h3>In the studio's folder</h3>
          <ul class="list">
            {projects.files.map((file) => (
              <li key={file}>
                <button
                  type="button"
                  onClick={() =>
                    open(
                      isProject(file)
                        ? run("project.open", { file }, `Opening ${file}`)
                        : run("asset.open", { file }, `Opening ${file}`),
                    )
                  }
                >
                  <span>{file}</span>
                </button>
              </li>
            ))}
          </ul>
        </>
      )}
    </>
  );
}

const openRecent = (one: RecentInfo) => run("project.open", { recent: one.id }, `Opening ${one.name}`);

/** "13:12" of today, else with its date. */
export function timeOf(seconds: number, now = new Date()): string {
  const time = new Date(seconds * 1000);
  const clock = time.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  if (time.toDateString() === now.toDateString()) return clock;
  return `${time.toLocaleDateString([], { day: "numeric", month: "short", year: "numeric" })}, ${clock}`;
}

const layersOf = (count: number | null): string =>
  count === null ? "" : count === 1 ? "1 layer, " : `${count} layers, `;

function RecentEntry({ project }: { project: RecentInfo }) {
  return (
    <>
      {project.picture ? (
        <img class="thumbnail" src={blobUrl(project.picture)} alt="" />
      ) : (
        <span class="thumbnail none" aria-hidden="true" />
      )}
      <span>{project.name}</span>
      <span class="quiet">
        {layersOf(project.layers)}
        {timeOf(project.changed)}
        {project.is_open ? ", open now" : ""}
      </span>
    </>
  );
}

/** The session whose user said that it is not to go on with what was painted before: here, or where it was left. */
const declined = signal("");
const decline = (): void => void (declined.value = state.value?.session ?? "");

/** An asset that was painted before: go on with that, or start anew. */
export function Continue() {
  const now = state.value;
  if (!now || now.earlier.length === 0 || declined.value === now.session || swapped.value) return null;
  return (
    <Dialog title={`${now.asset.name} was painted before`} onClose={decline}>
      <ul class="list">
        {now.earlier.map((one, k) => (
          <li key={one.id}>
            <button type="button" autofocus={k === 0} onClick={() => void openRecent(one)}>
              {one.picture && <img class="thumbnail" src={blobUrl(one.picture)} alt="" />}
              <span>
                Continue ({layersOf(one.layers)}
                {timeOf(one.changed)})
              </span>
            </button>
          </li>
        ))}
      </ul>
      <p class="row">
        <Button label="Start over" text="Start over" onClick={decline} />
        <span class="quiet">What was painted before stays under Open.</span>
      </p>
    </Dialog>
  );
}

const strokesOf = (count: number): string => (count === 1 ? "1 stroke" : `${count} strokes`);

/** The studio shows another project than this page was in when it lost it. */
export function Swapped() {
  const before = swapped.value;
  const now = state.value;
  const answer = useRef<HTMLDivElement>(null);
  const asked = before !== null && now !== null;
  useEffect(() => {
    if (asked) answer.current?.querySelector<HTMLElement>("button")?.focus();
  }, [asked, before?.id]);
  if (!before || !now) return null;
  const back = async () => {
    const fields = before.file ? { file: before.file } : { recent: before.id };
    const answer = await run("project.open", fields, `Opening ${before.name}`);
    if (answer) swapped.value = null;
  };
  const earlier = now.earlier.find((one) => one.id === before.id); // of the same asset
  const changed = earlier?.changed ?? before.changed;
  const drawn = pendingStrokes.value;
  const words = earlier ? `Continue (${layersOf(earlier.layers)}${timeOf(changed)})` : `Back to ${before.name}`;
  return (
    <div class="elsewhere swapped" role="alert" ref={answer}>
      <span>
        {earlier ? "The studio was started again." : `The studio has another project open now: ${now.project.name}.`}{" "}
        You were in {before.name} ({layersOf(before.layers)}
        {changed > 0 && `last change ${timeOf(changed)}, `}
        nothing of it is lost).
        {drawn > 0 && ` ${strokesOf(drawn)} drawn since ${drawn === 1 ? "waits" : "wait"} to go into it.`}
      </span>
      {before.id && <Button label={words} text={words} primary onClick={() => void back()} />}
      <Button
        label="Stay here"
        text={drawn > 0 ? `Stay here without the ${strokesOf(drawn)}` : "Stay here"}
        onClick={() => {
          decline();
          editor.strokes.giveUp();
        }}
      />
    </div>
  );
}

function Saving({ onClose }: { onClose: () => void }) {
  const now = state.value;
  const stem = (now?.asset.name ?? "asset").replace(/(\.compressed)?\.[^.]*$/, "");
  const [name, setName] = useState(`${stem}.splatproj`);
  if (!now) return null;
  const save = async () => {
    const answer = await run(
      "project.save_as",
      { file: /\.splatproj$/i.test(name) ? name : `${name}.splatproj` },
      "Saving",
    );
    if (answer) onClose();
  };
  const copyProject = async () => {
    const answer = await run("project.download", {}, "Copying the project");
    if (answer) download(answer.url, answer.file);
  };
  return (
    <>
      <ExportAsset />
      <h3>Project</h3>
      <p class="quiet">
        {now.project.file
          ? `Saved in ${now.project.file} with every edit.`
          : "Saved in the studio's own folder with every edit."}
      </p>
      {now.folder && (
        <p class="row wide">
          <input
            type="text"
            aria-label={`Project file in ${now.folder}`}
            value={name}
            disabled={readOnly.value}
            onInput={(event) => setName(event.currentTarget.value)}
            onKeyDown={(event) => event.key === "Enter" && void save()}
          />
          <Button
            label={`Move the project into ${now.folder}`}
            icon="save"
            text="Save as"
            onClick={() => void save()}
          />
        </p>
      )}
      <p class="row">
        <Button
          label="A copy of the project file"
          icon="share"
          text="Download a copy"
          onClick={() => void copyProject()}
        />
      </p>
    </>
  );
}
