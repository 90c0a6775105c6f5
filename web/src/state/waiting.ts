/**
 * What was drawn while its project was away: the server ended, or shows another project. It waits until its own project
 * (by id) is back, or until the user gives it up; it never goes into another one.
 */

import { computed, effect, signal } from "@preact/signals";

import type { State } from "../messages";
import { state, status, swapped, type LeftProject } from "./store";

interface Waiting {
  project: string;
  resolve: (back: boolean) => void;
}

const waiting = signal<readonly Waiting[]>([]);

/** Projects that took the place of others in which nothing had been done. */
const successors = new Map<string, string>();
/** Projects whose strokes were given up, until they are shown again. */
const givenUp = new Set<string>();

/** Projects that this page was in, as they were left, by their ids. */
const leftProjects = new Map<string, LeftProject>();
/** When the layers of the project that is shown were last changed: seconds since 1970. */
const lastChange = { seconds: 0 };

export const noteChange = (): void => void (lastChange.seconds = Date.now() / 1000);

/** The project of a state, as it is left now. */
export function leftNow({ project, asset, layers, history }: State): LeftProject {
  const { id, name, file } = project;
  const [changed, steps] = [lastChange.seconds, history.length];
  const title = file ?? asset.name ?? name;
  return { id, name: title, file, layers: layers.length, changed, steps, sha256: asset.sha256 };
}

/** A project with its id, as it is or as it was left; null: this page does not know it. */
export function projectOf(id: string): LeftProject | null {
  const shown = state.value;
  return shown?.project.id === id ? leftNow(shown) : (leftProjects.get(id) ?? null);
}

/** A project as it was left, and the one that the studio shows instead. */
export function noteLeft(left: LeftProject, shown: State): void {
  leftProjects.set(left.id, left);
  if (nothingDone(left) && left.sha256 === shown.asset.sha256) successors.set(left.id, shown.project.id);
}

export const nothingDone = ({ steps }: LeftProject): boolean => steps < 2;

/** Whether a project is the one that is open, as far as this page knows. */
export function isShown(project: string): boolean {
  const shown = state.value?.project?.id;
  return status.value === "open" && (shown === project || (shown !== undefined && successors.get(project) === shown));
}

/** The project for which something waits while another one is shown; null: there is none. */
export const waitingElsewhere = computed(() =>
  status.value === "open" ? (waiting.value.find(({ project }) => !isShown(project))?.project ?? null) : null,
);

/** Resolves when the project is open again: true; or false when what waits for it was given up. */
export function projectIsBack(project: string): Promise<boolean> {
  if (isShown(project)) return Promise.resolve(true);
  if (givenUp.has(project)) return Promise.resolve(false);
  return new Promise((resolve) => {
    waiting.value = [...waiting.value, { project, resolve }];
  });
}

/** What is said of `what` while it is asked whether to go back to the project that it is for; null: nothing is asked. */
export function waitsForAnswer(what: string): [string, string] | null {
  const left = swapped.value;
  return left && [`${what} waits for your answer above.`, `Go back to ${left.name}, or stay here.`];
}

/** Give up all that waits, and what is still to come of the same projects. */
export function giveUpWaiting(): void {
  const all = waiting.value;
  waiting.value = [];
  for (const { project, resolve } of all) {
    givenUp.add(project);
    resolve(false);
  }
}

effect(() => {
  const shown = state.value?.project?.id;
  if (shown !== undefined) givenUp.delete(shown);
  const back = waiting.value.filter(({ project }) => isShown(project));
  if (back.length === 0) return;
  waiting.value = waiting.value.filter((one) => !back.includes(one));
  for (const { resolve } of back) resolve(true);
});
