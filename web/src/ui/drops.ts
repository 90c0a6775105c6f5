/**
 * Files dropped anywhere on the window, from a folder, another program or another window of a browser. A page that does not
 * answer a drop is left for what was dropped, so every one is answered.
 */

import { toast } from "../state/store";

const LINK = "text/uri-list";

/** The first address in a text/uri-list (RFC 2483: lines that start with # are comments); null: none. */
export function addressIn(list: string): string | null {
  return list.split(/\r?\n/).find((line) => line.trim() && !line.startsWith("#")) ?? null;
}

/** The last part of an address as a file name. */
export function nameIn(address: string): string {
  try {
    return decodeURIComponent(new URL(address).pathname.split("/").pop() ?? "") || "file";
  } catch {
    return "file";
  }
}

/** The files of a drop. A link is one where this browser may read it: from a studio, or a page of its own data. */
async function filesOf(transfer: DataTransfer): Promise<File[]> {
  const files = [...transfer.files];
  const address = addressIn(transfer.getData(LINK));
  if (files.length || !address) return files;
  const readable = /^(data|blob):/.test(address) || new URL(address, location.href).origin === location.origin;
  const answer = readable ? await fetch(address).catch(() => null) : null;
  if (answer?.ok) return [new File([await answer.blob()], nameIn(address))];
  toast("warning", `${nameIn(address)} is a link.`, "Save it as a file, then drop the file here.");
  return [];
}

/** Listen until the returned function is called. onOver: whether something hovers that would be taken. */
export function listenToDrops(onOver: (over: boolean) => void, take: (files: File[]) => void): () => void {
  const taken = (event: DragEvent) => {
    const types = event.dataTransfer?.types ?? [];
    return types.includes("Files") || types.includes(LINK);
  };
  const inField = (event: DragEvent) => (event.target as HTMLElement).closest?.("input[type=text], textarea") !== null;
  const over = (event: DragEvent) => {
    if (!taken(event) || (inField(event) && !event.dataTransfer!.types.includes("Files"))) return;
    event.preventDefault();
    event.dataTransfer!.dropEffect = "copy";
    onOver(true);
  };
  const leave = (event: DragEvent) => event.relatedTarget === null && onOver(false);
  const drop = (event: DragEvent) => {
    onOver(false);
    if (!taken(event) || event.defaultPrevented || (inField(event) && !event.dataTransfer!.files.length)) return;
    event.preventDefault();
    void filesOf(event.dataTransfer!).then((files) => files.length && take(files));
  };
  const pairs = [
    ["dragover", over],
    ["dragleave", leave],
    ["drop", drop],
  ] as const;
  for (const [kind, listener] of pairs) window.addEventListener(kind, listener as (event: DragEvent) => void);
  return () => {
    for (const [kind, listener] of pairs) window.removeEventListener(kind, listener as (event: DragEvent) => void);
  };
}
