/** Gaussians on their way into tables: in order, and a slice at a time, so that a million of them do not stop the page. */

import type { Frame } from "../net/frames";

/** Where Gaussians go. */
export interface Target {
  /** Encode Gaussians `from` to `to` of the frame; nothing of it is shown yet. */
  write(frame: Frame, from: number, to: number): void;
  /** Everything is written: show it. */
  finish(frame: Frame): void;
}

/** Milliseconds that one slice may take: less than a picture at 60 Hz. */
const SLICE_MS = 12;
/** Gaussians between two looks at the clock. */
const CLOCK_STEP = 1024;

/** A small frame is finished before `add` returns; a large one goes on after pauses, and what comes later waits for it. */
export class UploadQueue<T extends Target> {
  private queue: { target: T; frame: Frame; next: number }[] = [];
  private waiting: (() => void)[] = [];
  private paused = false;

  constructor(
    private readonly finished: (target: T, frame: Frame) => void,
    private readonly pause: (go: () => void) => void = (go) => setTimeout(go, 0),
    private readonly clock: () => number = () => performance.now(),
    /** Called after each slice that was not the last. */
    private readonly progressed: () => void = () => {},
  ) {}

  /** Gaussians of what is not shown yet: those that are written, and all. */
  get load(): { written: number; total: number } {
    return this.queue.reduce(
      ({ written, total }, { frame, next }) => ({ written: written + next, total: total + frame.gaussians.count }),
      { written: 0, total: 0 },
    );
  }

  add(target: T, frame: Frame): void {
    this.queue.push({ target, frame, next: 0 });
    if (!this.paused) this.run();
  }

  /** Forget what is not shown yet: a snapshot replaces it. Returns the targets that it was meant for. */
  clear(): T[] {
    const dropped = this.queue.map((one) => one.target);
    this.queue = [];
    return dropped;
  }

  /** Resolves when everything that was added is shown. */
  idle(): Promise<void> {
    return this.queue.length ? new Promise((resolve) => this.waiting.push(resolve)) : Promise.resolve();
  }

  private run(): void {
    const end = this.clock() + SLICE_MS;
    for (let job = this.queue[0]; job; job = this.queue[0]) {
      const { target, frame } = job;
      while (job.next < frame.gaussians.count) {
        if (this.clock() >= end) return this.later();
        const to = Math.min(job.next + CLOCK_STEP, frame.gaussians.count);
        target.write(frame, job.next, to);
        job.next = to;
      }
      this.queue.shift();
      target.finish(frame);
      this.finished(target, frame);
    }
    const waiting = this.waiting;
    this.waiting = [];
    for (const resolve of waiting) resolve();
  }

  private later(): void {
    this.paused = true;
    this.progressed();
    this.pause(() => {
      this.paused = false;
      this.run();
    });
  }
}
