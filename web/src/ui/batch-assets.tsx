/** The assets of a batch: files that are sent, assets of recent projects, files of the studio's folder. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import type { BatchAsset, RecentProjects } from "../messages";
import { sendBlob } from "../net/blobs";
import { state } from "../state/store";
import { run } from "../editor/editor";
import { timeOf } from "./files";
import { Button, Check, FileButton } from "./parts";

const ACCEPTED = ".ply,.splat,.ksplat,.spz,.sog,.glb,.gltf,.zip";
const IS_PROJECT = /\.splatproj$/i;
/** As the server allows. */
const MAX_ASSETS = 500;

interface Sent {
  id: number;
  name: string;
  /** null: on its way, or refused. */
  blob: string | null;
  problem: string;
  stop: () => void;
}

const sent = signal<Sent[]>([]);
const recents = signal<readonly string[]>([]);
const folderFiles = signal<readonly string[]>([]);
const lists = signal<RecentProjects | null>(null);
/** Files are sent one after the other. */
const queue = { nextId: 1, sending: Promise.resolve() as Promise<void> };

/** Those that can be planned with. */
export const chosenAssets = (): BatchAsset[] => [
  ...sent.value.filter(({ blob }) => blob).map(({ blob, name }) => ({ blob, name: name.slice(0, 300) })),
  ...recents.value.map((recent) => ({ recent })),
  ...folderFiles.value.map((file) => ({ file })),
];

/** Send files, one after the other. */
function add(files: readonly File[]): void {
  for (const file of files.slice(0, MAX_ASSETS - sent.value.length)) {
    const id = queue.nextId++;
    const controller = new AbortController();
    const set = (part: Partial<Sent>) =>
      (sent.value = sent.value.map((one) => (one.id === id ? { ...one, ...part } : one)));
    const stop = () => {
      controller.abort();
      sent.value = sent.value.filter((one) => one.id !== id);
    };
    sent.value = [...sent.value, { id, name: file.name, blob: null, problem: "", stop }];
    queue.sending = queue.sending.then(async () => {
      if (controller.signal.aborted) return;
      try {
        set({ blob: await sendBlob(file, file.name, controller.signal) });
      } catch (error) {
        if (!controller.signal.aborted) set({ problem: error instanceof Error ? error.message : String(error) });
      }
    });
  }
}

const toggled = (list: readonly string[], one: string, on: boolean): readonly string[] =>
  on ? [...list, one] : list.filter((other) => other !== one);

export function BatchAssets() {
  useEffect(() => void run("project.recent", {}).then((answer) => (lists.value = answer)), []);
  const project = state.value?.project.id;
  const otherProjects = lists.value?.recent.filter((one) => one.id !== project) ?? [];
  const files = lists.value?.files.filter((name) => !IS_PROJECT.test(name)) ?? [];
  const drop = (event: DragEvent) => {
    const dropped = [...(event.dataTransfer?.files ?? [])];
    if (!dropped.length) return;
    event.preventDefault();
    add(dropped);
  };
  return (
    <div class="batch-assets" onDrop={drop}>
      <p class="row">
        <FileButton label="Choose assets" icon="open" accept={ACCEPTED} multiple onFiles={add} />
        <span class="quiet">or drop them here</span>
        {sent.value.length > 1 && (
          <Button label="Remove all files" text="Clear" onClick={() => sent.value.forEach(({ stop }) => stop())} />
        )}
      </p>
      <ul class="list" aria-label="Files">
        {sent.value.map((one) => (
          <li key={one.id}>
            <span class="name">{one.name}</span>
            <span class={one.problem ? "problem" : "quiet"} role={one.problem ? "alert" : undefined}>
              {one.problem || (one.blob ? "ready" : "sending ...")}
            </span>
            <Button icon="close" label={`Remove ${one.name}`} onClick={one.stop} />
          </li>
        ))}
      </ul>
      {otherProjects.length > 0 && (
        <details>
          <summary>Assets of recent projects{recents.value.length > 0 && `: ${recents.value.length} chosen`}</summary>
          <ul class="list" aria-label="Recent projects">
            {otherProjects.map((one) => (
              <li key={one.id}>
                <Check
                  label={one.name}
                  value={recents.value.includes(one.id)}
                  onChange={(on) => (recents.value = toggled(recents.value, one.id, on))}
                />
                <span class="quiet">{timeOf(one.changed)}</span>
              </li>
            ))}
          </ul>
        </details>
      )}
      {files.length > 0 && (
        <details>
          <summary>
            In the studio's folder{folderFiles.value.length > 0 && `: ${folderFiles.value.length} chosen`}
          </summary>
          <ul class="list" aria-label="Files of the folder">
            {files.map((name) => (
              <li key={name}>
                <Check
                  label={name}
                  value={folderFiles.value.includes(name)}
                  onChange={(on) => (folderFiles.value = toggled(folderFiles.value, name, on))}
                />
              </li>
            ))}
          </ul>
        </details>
      )}
    </div>
  );
}
