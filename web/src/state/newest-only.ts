/** Work of which only the newest counts, one at a time: sliders that are dragged, previews. */

export class NewestOnly<Item> {
  private next: { item: Item } | null = null;
  private running: Promise<void> | null = null;

  constructor(private readonly work: (item: Item) => Promise<unknown>) {}

  /** Do it next, in place of what was to be next. Resolves when nothing is left to do. */
  add(item: Item): Promise<void> {
    this.next = { item };
    return (this.running ??= this.run());
  }

  /** Leave out what is next. */
  skip(): void {
    this.next = null;
  }

  private async run(): Promise<void> {
    try {
      while (this.next) {
        const { item } = this.next;
        this.next = null;
        await this.work(item);
      }
    } finally {
      this.running = null;
    }
  }
}
