/**
 * From one pointer to one tool: a drag from where it comes down until it goes up, with the pressure that the pen means.
 * Pens say 0 on contact and rise from there; a pen that says 0 all the time has no pressure at all. Knows no page.
 */

import type { Pen, ToolGesture } from "./tool";

/** Samples of 0 after which a pen is taken as one without pressure. */
export const UNPRESSED_SAMPLES = 6;
/** What browsers say of pointers that are down and know no pressure. */
export const NO_PRESSURE = 0.5;

/** What is known of the pens of this page; a drag learns it, and those after it know. */
export interface PenKnowledge {
  /** Whether they say how hard they are pressed; null: not known yet. */
  pressed: boolean | null;
}

export class Drawing {
  /** Samples of 0 that wait until it is known what they mean. */
  private held: Pen[] = [];
  private begun = false;
  private last: Pen;

  /** isPen: its pressure may be 0; that of mice and fingers is taken as it is. */
  constructor(
    readonly gesture: ToolGesture,
    pen: Pen,
    private readonly isPen: boolean,
    private readonly knowledge: PenKnowledge,
  ) {
    this.last = pen;
    this.take(pen);
  }

  move(pen: Pen): void {
    this.take(pen);
  }

  /** It ends at `pen`, or where it was last (the pointer was taken away, or went up unseen). */
  up(pen: Pen = this.last): void {
    if (this.held.length) this.release(NO_PRESSURE);
    this.gesture.up({ ...pen, pressure: this.last.pressure });
  }

  cancel(): void {
    this.held = [];
    if (this.begun) this.gesture.cancel();
  }

  private take(pen: Pen): void {
    const { knowledge } = this;
    if (!this.isPen) return this.pass(pen);
    if (pen.pressure > 0) {
      knowledge.pressed = true;
      if (this.held.length) this.release(0);
      return this.pass(pen);
    }
    if (knowledge.pressed !== null) return this.pass(knowledge.pressed ? pen : { ...pen, pressure: NO_PRESSURE });
    this.held.push(pen);
    if (this.held.length < UNPRESSED_SAMPLES) return;
    knowledge.pressed = false;
    this.release(NO_PRESSURE);
  }

  private release(pressure: number): void {
    const held = this.held;
    this.held = [];
    for (const pen of held) this.pass({ ...pen, pressure });
  }

  private pass(pen: Pen): void {
    this.last = pen;
    if (this.begun) return this.gesture.move(pen);
    this.begun = true;
    this.gesture.down(pen);
  }
}
