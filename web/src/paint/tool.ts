/** What a tool is to the stage. */

/** The pen on the view. */
export interface Pen {
  /** Pixels of the view; the first pixel's centre is 0.5. */
  x: number;
  y: number;
  /** 0..1; 1 for a mouse. */
  pressure: number;
  shift: boolean;
  alt: boolean;
}

export interface ToolHandler {
  down(pen: Pen): void;
  move(pen: Pen): void;
  up(pen: Pen): void;
  /** Escape, or the view moved: take back what was begun. */
  cancel(): void;
}
