/** The disk is full, or refuses to be written: what was drawn is kept until it can be saved, here or elsewhere. */

import { signal } from "@preact/signals";

import type { FolderInfo } from "../messages";

/** Why the project cannot be written; null: it can, as far as is known. */
export const storageProblem = signal<{ message: string; hint: string } | null>(null);
/** Folders in which it could go on; null: not known yet. */
export const roomyFolders = signal<readonly FolderInfo[] | null>(null);

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
