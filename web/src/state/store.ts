/** Everything that the interface shows, as signals. What belongs to the asset comes from the server and only from there. */

import { computed, signal } from "@preact/signals";

import type { State } from "../messages";
import type { Status } from "../net/connection";
import type { CameraJson, Pose } from "../view/camera";

export type PaintMode = "normal" | "color" | "darken" | "lighten";
export type Tab = "brush" | "colors" | "adjust" | "light" | "select" | "history" | "views" | "pictures" | "receipt";
export type SelectKind = "rectangle" | "lasso" | "color" | "brush";

export const status = signal<Status>("connecting");
export const stopped = signal("");
export const state = signal<State | null>(null);

export const pose = signal<Pose | null>(null);
/** The exact camera that is shown: the pose in the window's size. */
export const camera = signal<CameraJson | null>(null);

export const brush = signal({ size: 40, hardness: 0.7, opacity: 1, flow: 1, pressureSize: true, pressureFlow: false });
export const color = signal("#c8442e");
/** The colour behind it: they change places. */
export const secondColor = signal("#ffffff");
/** Last colours used, newest first. */
export const recentColors = signal<string[]>([]);
const MAX_RECENT_COLORS = 24;
/** Paint with this colour from now on; it is one of the latest. */
export function setColor(next: string): void {
  color.value = next;
  recentColors.value = [next, ...recentColors.value.filter((one) => one !== next)].slice(0, MAX_RECENT_COLORS);
}
export const paintMode = signal<PaintMode>("normal");
export type Method = State["methods"][number];
export const method = signal<Method>("auto");
/** What one view may paint, and whether the view shows what it may not. */
export const limits = signal({ angle: 85, depthEdge: 0, show: false });
/** Whether strokes go on over the painted material, how sure it must be, and whether the view shows how sure it is. */
export const spreading = signal({ on: false, threshold: 0.5, show: false });
export const fill = signal({ tolerance: 0.12, contiguous: true });
export const text = signal({ text: "Text", font: "sans-serif", size: 64, bold: true, italic: false });
export const selecting = signal<{
  kind: SelectKind;
  combine: "replace" | "add" | "subtract" | "intersect";
  tolerance: number;
  feather: number;
  /** By colour: connected pixels of the view; else all over the asset. */
  contiguous: boolean;
  /** Not only the surface that is seen. */
  through: boolean;
}>({
  kind: "rectangle",
  combine: "replace",
  tolerance: 0.12,
  feather: 0,
  contiguous: false,
  through: false,
});

export const view = signal({
  background: "#1b1d21",
  grid: false,
  trueColor: false,
  /** Whose formula for alpha the true-colour pictures are drawn with. */
  profile: "inria" as "inria" | "playcanvas",
  compare: false,
  coverage: false,
  /** Pixels of the view per pixel of the device, in each direction. */
  resolution: 1,
});
/** Pixels of the view per pixel of the page (CSS), as it is drawn now. */
export const density = signal(1);
/** The view's camera moves: still pictures of the old one are out of date. */
export const moving = signal(false);
/** Where the before/after line is, 0..1 of the width. */
export const compareAt = signal(0.5);

export const tab = signal<Tab>("history");
export const selectedLayer = signal<string | null>(null);
/** The layer whose mask the brush paints; null: it paints layers. */
export const maskedLayer = signal<string | null>(null);
/** Whether the brush shows the layer there, or hides it. */
export const maskShows = signal(false);
export const help = signal(false);
/** Whether the panels are put away, so that the view has all the room. */
export const panelsFolded = signal(false);
/** What was done from this window, as Python lines. */
export const pythonLog = signal<string[]>([]);
export interface Toast {
  id: number;
  level: "info" | "warning" | "error";
  message: string;
  hint: string;
}
export const toasts = signal<Toast[]>([]);

export interface Job {
  id: number;
  label: string;
  progress: number;
  stage: string;
  cancel: () => void;
}
export const jobs = signal<Job[]>([]);
/** Layers that strokes are on their way to. */
export const painting = signal<readonly string[]>([]);
/** Above 0 while the camera must stay: a stroke still reads the view. */
export const frozen = signal(0);
/** Strokes that are not layers yet. */
export const pendingStrokes = signal(0);
/** Commands under way that change the project: nothing is "Saved" before they are answered. */
export const saving = signal(0);
/** Commands of this page under way that open another project. */
export const opening = signal(0);
/** Commands under way that take a while and change nothing: a turntable, an export, a picture. */
export const working = signal(0);
/** How far the picture is behind the Gaussians that have come, and how far these are behind the state. */
export const drawn = signal({ behind: false, written: 0, total: 0, version: -1 });
/** Nothing was heard of the server for long, while an answer is due. */
export const silent = signal(false);
/** The graphics card took the view away; `again`: soon after another time, so that the page does not reload by itself. */
export const graphicsLost = signal<{ again: boolean } | null>(null);
/** Why the latest command was refused; it stays until another one works or it is closed. */
export const refusal = signal<{ what: string; message: string; hint: string } | null>(null);

/** A project as this page left it. */
export interface LeftProject {
  id: string;
  name: string;
  file: string | null;
  layers: number;
  /** When something was last done in it, as far as this page knows; seconds since 1970. */
  changed: number;
  /** Of its history: one is the asset as it was opened. */
  steps: number;
  /** Of its asset. */
  sha256: string;
}
/** The project that this page was in when another one was opened without it asking: in another window, or while it had
 * no connection. */
export const swapped = signal<LeftProject | null>(null);

export const readOnly = computed(() => state.value?.project.read_only ?? false);
export const canUndo = computed(() => (state.value ? state.value.cursor + state.value.selection.undo > 0 : false));
export const canRedo = computed(() =>
  state.value ? state.value.cursor < state.value.history.length - 1 || state.value.selection.redo > 0 : false,
);

let nextToast = 1;

export function toast(level: Toast["level"], message: string, hint = ""): void {
  const id = nextToast++;
  toasts.value = [...toasts.value.filter((t) => t.message !== message).slice(-3), { id, level, message, hint }];
  setTimeout(() => dismiss(id), level === "error" ? 12000 : 5000);
}

export function dismiss(id: number): void {
  toasts.value = toasts.value.filter((t) => t.id !== id);
}

/** "#rrggbb" to [0..1] * 3. */
export function rgb(hex: string): [number, number, number] {
  const value = parseInt(hex.slice(1), 16);
  return [(value >> 16) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}

export function hex(values: ArrayLike<number>): string {
  return `#${[0, 1, 2]
    .map((k) =>
      Math.round(Math.max(0, Math.min(1, values[k])) * 255)
        .toString(16)
        .padStart(2, "0"),
    )
    .join("")}`;
}
