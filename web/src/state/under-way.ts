/**
 * What was set and the server has not done yet: it stands at once, over what the server says, and the newest of it counts.
 * An answer to an earlier change takes nothing back; where a change is refused, what the server says is there again.
 */

import { signal } from "@preact/signals";

interface Change {
  of: string;
  set: (said: never) => unknown;
}

const changes = signal<readonly Change[]>([]);

/** Show `of` as `set` makes it from what the server says, until `work` ends, well or not. */
export async function during<T, Done>(of: string, set: (said: T) => T, work: Promise<Done>): Promise<Done> {
  const change = { of, set };
  changes.value = [...changes.value, change];
  try {
    return await work;
  } finally {
    // The state that knows of it came before the answer.
    changes.value = changes.value.filter((one) => one !== change);
  }
}

/** What the server says of `of`, with all that is under way. */
export const withUnderWay = <T>(of: string, said: T): T =>
  changes.value.reduce((value, change) => (change.of === of ? (change.set(value as never) as T) : value), said);

/** Whether something of it is under way. */
export const isUnderWay = (of: string): boolean => changes.value.some((change) => change.of === of);
