/**
 * Changes of what is shown but is no step of the history yet, as where a picture is placed: undo takes them back first, one
 * after the other. Knows no page.
 */

import { signal } from "@preact/signals";

/** Something that is not applied yet, with an undo of its own. All but `back` and `again` may be read inside of an effect. */
export interface Draft {
  canBack: () => boolean;
  back: () => void;
  canAgain: () => boolean;
  again: () => void;
}

/** All that there are; undo and redo ask them before the history. */
export const drafts: Draft[] = [];

/** `Stand`: all of it that a change may change. */
export class DraftSteps<Stand> {
  private readonly before = signal<readonly Stand[]>([]);
  private readonly after = signal<readonly Stand[]>([]);

  /** A change begins at `stand`. */
  note(stand: Stand): void {
    this.before.value = [...this.before.value, stand];
    this.after.value = [];
  }

  /** The change that began last changed nothing, or was taken back by itself. */
  dropLast(): void {
    this.before.value = this.before.value.slice(0, -1);
  }

  /** How it stood before the latest change; null: there was none. `now`: how it stands. */
  back(now: Stand): Stand | null {
    return this.step(this.before, this.after, now);
  }

  /** How it stood before that was taken back; null: nothing was. */
  again(now: Stand): Stand | null {
    return this.step(this.after, this.before, now);
  }

  /** Whether `again` has something. */
  get canAgain(): boolean {
    return this.after.value.length > 0;
  }

  /** Something else is changed from now on, or nothing. */
  forget(): void {
    this.before.value = this.after.value = [];
  }

  private step(from: { value: readonly Stand[] }, to: { value: readonly Stand[] }, now: Stand): Stand | null {
    const stand = from.value.at(-1);
    if (stand === undefined) return null;
    from.value = from.value.slice(0, -1);
    to.value = [...to.value, now];
    return stand;
  }
}
