/**
 * What a tool is. Each has one file in this folder, which holds all of it: its keys, its icon, its settings, and what the
 * pen does in its hand. `index.ts` lists them; nothing else names one.
 */

import { signal } from "@preact/signals";
import type { JSX } from "preact";

import type { Tab } from "../state/store";
import type { IconName } from "../ui/icons";

export type Tool =
  "orbit" | "brush" | "erase" | "fill" | "line" | "text" | "stamp" | "clone" | "heal" | "pick" | "select";

/** The tool in hand. */
export const tool = signal<Tool>("brush");

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

/** What the pen does, from where it comes down until it goes up. What it has begun is kept inside. */
export interface ToolGesture {
  down(pen: Pen): void;
  move(pen: Pen): void;
  up(pen: Pen): void;
  /** Escape, or the view moved: take back what was begun. */
  cancel(): void;
  /** What becomes of it where the view changes meanwhile: it ends there, and what was drawn stays; it goes on, for nothing
   * of it is in pixels of the view; default: it is taken back. */
  inAnotherView?: "ends" | "goes on";
}

/** A way to take the tool up, with its keys. */
export interface ToolCommand {
  /** As shortcuts are stored: never changes. */
  id: `tool.${string}`;
  label: string;
  keys: readonly string[];
  /** What of the tool it chooses besides. */
  before?: () => void;
}

/**
 * What is drawn at the pen: the outline of a brush (and of its mirror image), a disc of the brush's size, a cross, nothing;
 * "hand": the pen moves the view.
 */
export type ToolCursor = "hand" | "ring" | "disc" | "cross" | "none";

export interface ToolSpec {
  name: Tool;
  icon: IconName;
  /** At least one; the first is what the toolbar's button is called where there is no `label`. */
  commands: readonly ToolCommand[];
  label?: string;
  cursor: () => ToolCursor;
  /** Its settings, in the bar under the header. */
  Settings: () => JSX.Element | null;
  /** null: it leaves the pen to the view. */
  gesture: ToolGesture | null;
  /** A click with Alt, in place of taking the colour there. */
  altClick?: (pen: Pen) => void;
  /** Alt means something to the gesture itself. */
  takesAlt?: boolean;
  /** It paints nothing: allowed in a project that can only be looked at; the digits set the chosen layer's opacity. */
  onlyLooks?: boolean;
  /** The limits of what one view may paint hold for it. */
  limited?: boolean;
  /** It copies from a place of the view, which is marked. */
  copies?: boolean;
  /** Whether it needs to know the surface of the view. Read inside of an effect. */
  needsSurface?: () => boolean;
  /** It places pictures that are dropped or pasted. */
  takesPictures?: boolean;
  /** It can paint the mask of a layer. */
  paintsMasks?: boolean;
  /** The panel that is opened when it is taken up. */
  tab?: Tab;
}

export const nothing = (): void => {};
