/**
 * Drags of what is placed but not laid yet: undo takes them back one after the other, as it does strokes. Where it stands is
 * what counts; words and settings that changed meanwhile stay. Knows no page.
 */

import { signal } from "@preact/signals";

export class PlacedSteps<Stand> {
  private readonly before = signal<readonly Stand[]>([]);
  private readonly after = signal<readonly Stand[]>([]);

  /** A drag begins at `stand`. */
  note(stand: Stand): void {
    this.before.value = [...this.before.value, stand];
    this.after.value = [];
  }

  /** The drag that began last moved nothing, or was taken back by itself. */
  dropLast(): void {
    this.before.value = this.before.value.slice(0, -1);
  }

  /** Where it stood before the latest drag; null: it was not dragged. `now`: where it stands. */
  back(now: Stand): Stand | null {
    return this.step(this.before, this.after, now);
  }

  /** Where it stood before that was taken back; null: nothing was. */
  again(now: Stand): Stand | null {
    return this.step(this.after, this.before, now);
  }

  /** Whether `again` has something. Read inside of an effect. */
  get canAgain(): boolean {
    return this.after.value.length > 0;
  }

  /** Something else is placed, or nothing. */
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
