/** The disk is full, or refuses to be written: what was drawn is kept until it can be saved, here or elsewhere. */

import { signal } from "@preact/signals";

import type { FolderInfo } from "../messages";

/** Why the project cannot be written; null: it can, as far as is known. */
export const storageProblem = signal<{ message: string; hint: string } | null>(null);
/** Folders in which it could go on; null: not known yet. */
export const roomyFolders = signal<readonly FolderInfo[] | null>(null);

/** What a server says of a disk without room. */
const FULL = /disk is full|no space|no room|quota/i;

/**
 * What has happened, and what becomes of the strokes that wait: room can come back by itself; a project that was deleted,
 * replaced or made read-only has to be saved elsewhere, or given back first.
 */
export function storageWords(message: string, drawn: number): string {
  const reason = message.replace(/,? and nothing was changed\.?$|; nothing was changed\.?$|\.$/, "");
  const first = `The project cannot be saved where it is: ${reason}.`;
  if (drawn === 0) return `${first} Nothing was changed.`;
  const kept = drawn === 1 ? "The stroke is kept" : `${drawn} strokes are kept`;
  const until = FULL.test(message) ? "there is room" : "the project can be written again, or is saved elsewhere";
  return `${first} ${kept}, and saved as soon as ${until}.`;
}

let waiting: ((again: boolean) => void)[] = [];

/** Say that it cannot be written. */
export function noteStorage(message: string, hint: string): void {
  roomyFolders.value = null;
  storageProblem.value = { message, hint };
}

/** Resolves when it is to be tried again: true; or false when what waits is given up. */
export const storageAnswered = (): Promise<boolean> => new Promise((resolve) => waiting.push(resolve));

/** The user's answer, for all that waits. */
export function answerStorage(again: boolean): void {
  const all = waiting;
  waiting = [];
  storageProblem.value = null;
  for (const resolve of all) resolve(again);
}
