/**
 * Strokes under way: one after the other is committed, but the next may be drawn meanwhile. Those whose project is away,
 * or for which the disk has no room, stay on the overlay and are committed later.
 */

import { effect } from "@preact/signals";

import type { LayerInfo } from "../messages";
import { CommandError, type Fields, type Link, type Name, type Result } from "../net/connection";
import { storageAnswered, storageProblem } from "../state/storage";
import {
  brush,
  camera,
  frozen,
  graphicsLost,
  limits,
  method,
  painting,
  pendingStrokes,
  readOnly,
  selectedLayer,
  spreading,
  state,
  status,
  swapped,
  toast,
} from "../state/store";
import { giveUpWaiting, isShown, noteLeft, projectIsBack, projectOf, waitsForAnswer } from "../state/waiting";
import { sameView, type CameraJson } from "../view/camera";
import type { Viewer } from "../view/viewer";
import { KeptStrokes, type KeptStroke } from "./kept-strokes";
import { limitsToSend } from "./limits";
import { selection, selectionSent } from "./selected";
import { emptyMask, type Mask } from "./raster";
import { Stroke, type StrokeTarget } from "./stroke";
import { chosenPaintLayer, FirstPaintLayer, LAYER_OF_STROKES } from "./stroke-target";
import { mirrorOfStroke } from "./symmetry";
import type { ViewPixels } from "./view-pixels";

/** What strokes need of the editor. */
export interface StrokeHost {
  viewer: Viewer;
  link: Link;
  pixels: ViewPixels;
  track: <N extends Name>(name: N, fields: Fields<N>, label: string) => Promise<Result<N>>;
  report: (error: unknown, what?: string) => void;
}

export interface StrokeChoice {
  opacity?: number;
  /** What it becomes; by default it goes into the chosen paint layer. */
  target?: StrokeTarget;
  /** Its colours are those of their place: on the other side of a symmetric asset they would be wrong. */
  oneSided?: boolean;
  /** Its paint goes on over the material that it lies on where that is switched on; it is a layer of its own then. */
  spreads?: boolean;
}

export class StrokeQueue {
  /** Lies over the view; strokes are seen on it until their Gaussians are on the screen. */
  readonly overlayCanvas = document.createElement("canvas");
  private readonly overlay = this.overlayCanvas.getContext("2d", { willReadFrequently: true })!;
  private readonly active = new Set<Stroke>();
  private readonly firstLayer = new FirstPaintLayer();
  /** The commit that runs last; strokes wait for it before they read the view. */
  private lastCommit: Promise<void> = Promise.resolve();
  /** Strokes whose pen is up, with the names of their records where they are kept over a reload. */
  private readonly drawn = new Map<Stroke, { record: string; time: number; kept: boolean }>();

  constructor(
    private readonly host: StrokeHost,
    private readonly shelf = new KeptStrokes(),
  ) {
    effect(() => {
      if (isAway()) for (const stroke of this.drawn.keys()) void this.keep(stroke);
    });
  }

  /** Begin a stroke on the present view; null (with a toast) when nothing can be painted. */
  begin(kind: "paint" | "clone" | "erase" | "mask", name: string, choice: StrokeChoice = {}): Stroke | null {
    const { opacity = brush.value.opacity, target: given, spreads, oneSided } = choice;
    const { link, track } = this.host;
    const target = spreads && !given && spreading.value.on ? { spread: spreading.value.threshold } : given;
    const now = camera.value;
    if (!now || this.host.viewer.count === 0) return null;
    const chosen = chosenPaintLayer();
    const [refused, hint] = whyNot(target ? null : chosen) ?? [];
    if (refused) {
      toast("warning", refused, hint);
      return null;
    }
    const single = target !== undefined;
    const layerName = target?.spread === undefined ? name : LAYER_OF_STROKES; // of a layer of its own
    const home = state.value!.project.id;
    const first = this.firstLayer.target((free) => this.unused(free));
    this.fitOverlay(now);
    const stroke = new Stroke({
      link,
      camera: now,
      overlay: this.overlay,
      base: this.asSeen(),
      after: Promise.all([this.lastCommit, selectionSent()]).then(() => {}),
      onScreen: () => camera.value !== null && sameView(camera.value, now),
      kind,
      layer: kind === "erase" && !single ? (chosen?.id ?? null) : null,
      name: single && !target.replaces && !target.layer ? this.unused(layerName) : name,
      project: home,
      isHome: () => status.value !== "open" || isShown(home),
      newestStep,
      target: single ? () => target : first.ask,
      commit: async (fields) => {
        await this.noteCommitting(stroke);
        const { layer: id, into_new, replaces } = fields;
        const goal = id ?? replaces;
        const there = state.value?.layers.find((one) => one.id === goal)?.name ?? into_new;
        if (goal) painting.value = [...painting.value, goal];
        try {
          const { layer } = await track("paint.end", fields, there ? `${name} in ${there}` : fields.name!);
          if (into_new) first.note(layer.id);
          return layer;
        } finally {
          if (goal) painting.value = painting.value.filter((_, k) => k !== painting.value.indexOf(goal));
        }
      },
      method: method.value,
      limits: limitsToSend(limits.value),
      opacity,
      mirror: target?.placed || oneSided ? null : mirrorOfStroke(kind),
      selection: selection.value,
    });
    frozen.value++;
    stroke.ready.catch(() => {}).finally(() => frozen.value--);
    this.active.add(stroke);
    pendingStrokes.value = this.active.size;
    return stroke;
  }

  /** Pen up: commit and show what it did. The overlay stays until the new Gaussians are on the screen. */
  end(stroke: Stroke, finish: (stroke: Stroke) => void = () => {}): Promise<void> {
    const before = this.lastCommit;
    const finished = stroke.ready.then(() => {
      if (stroke.withdrawn) return;
      finish(stroke);
      if (!this.drawn.has(stroke)) this.drawn.set(stroke, { record: randomName(), time: Date.now(), kept: false });
      if (isAway()) void this.keep(stroke);
    });
    finished.catch(() => {}); // said below
    this.lastCommit = (async () => {
      await before;
      try {
        await finished;
        const layer = await this.committed(stroke);
        if (layer) selectedLayer.value = layer.id;
        await this.host.viewer.settle();
      } catch (error) {
        if (graphicsLost.value) await never(); // nothing can be drawn: the page that is loaded next goes on with it
        if (!stroke.withdrawn) {
          this.host.report(error, stroke.name);
          await stroke.cancel();
        }
      } finally {
        this.forget(stroke);
        this.warmUp();
      }
    })();
    return this.lastCommit;
  }

  async cancel(stroke: Stroke): Promise<void> {
    const sent = stroke.cancel();
    this.forget(stroke);
    await sent;
  }

  /** Resolves when every stroke that was drawn is a layer, or is given up. */
  get committedAll(): Promise<void> {
    return this.lastCommit;
  }

  /** Take back the newest stroke that is not being saved yet; false: there is none. */
  takeBackNewest(): boolean {
    const newest = [...this.active].filter((one) => one.committing === null && !one.withdrawn).at(-1);
    if (newest) void this.cancel(newest);
    return newest !== undefined;
  }

  /** Stay in the project that is shown: what waits for another one goes. */
  giveUp(): void {
    const count = this.active.size;
    giveUpWaiting();
    swapped.value = null;
    if (count > 0) toast("info", count === 1 ? "One stroke was given up." : `${count} strokes were given up.`);
  }

  /** Whether a reload of the page would lose nothing of what is drawn. */
  get allKept(): boolean {
    return [...this.active].every((stroke) => this.drawn.get(stroke)?.kept);
  }

  /** Paint what was kept by pages that are gone, into the projects that it belongs to. Once a project is shown. */
  async restore(): Promise<void> {
    await this.shelf.takeOver((strokes) => {
      const made = new Map<string, string>();
      for (const one of strokes) this.replay(one, made);
    });
  }

  /** Another camera: what lies on the old view goes, and comes back with it. */
  viewMoved(): void {
    if (camera.value) this.fitOverlay(camera.value);
    this.repaint();
  }

  /** Read the view before a stroke needs it. */
  warmUp(): void {
    if (this.active.size === 0) this.host.pixels.warmUp();
  }

  /** The stroke's layer; null where there is nothing of it. Where its project is away it waits for it. */
  private async committed(stroke: Stroke): Promise<LayerInfo | null> {
    for (;;) {
      if (stroke.withdrawn) return null;
      try {
        return await stroke.end();
      } catch (error) {
        const { project, committing } = stroke;
        if (error instanceof CommandError && error.kind === "storage" && !stroke.withdrawn) {
          stroke.committing = null; // nothing of it was saved
          this.host.report(error, stroke.name);
          void this.keep(stroke);
          if (!(await storageAnswered())) {
            await stroke.cancel();
            return null;
          }
          stroke.again();
          continue;
        }
        const away = error instanceof CommandError && (error.kind === "lost" || error.kind === "project");
        if (stroke.withdrawn || !(away || state.value?.project.id !== project)) throw error;
        void this.keep(stroke);
        if (!(await projectIsBack(project))) {
          await stroke.cancel();
          return null;
        }
        if (committing !== null && wasCommitted(stroke.name, committing)) return null;
        stroke.again();
      }
    }
  }

  /** Keep a stroke over a reload. */
  private async keep(stroke: Stroke): Promise<void> {
    const drawn = this.drawn.get(stroke);
    const project = projectOf(stroke.project);
    if (!drawn || drawn.kept || !project || stroke.withdrawn || stroke.extent.width === 0) return;
    drawn.kept = true; // asked for; it counts once the browser has it
    const { record: id, time } = drawn;
    drawn.kept = await this.shelf.keep({ id, drawn: time, project, ...stroke.record() });
    if (drawn.kept && !this.drawn.has(stroke)) await this.shelf.drop(id); // it was saved meanwhile
  }

  /** Its commit is sent now: a page that is loaded again looks for it in the history before it paints the stroke again. */
  private async noteCommitting(stroke: Stroke): Promise<void> {
    const drawn = this.drawn.get(stroke);
    if (!drawn?.kept) return;
    drawn.kept = false;
    await this.keep(stroke);
  }

  /** `made`: names of new paint layers of the strokes before it -> the layers. */
  private replay(one: KeptStroke, made: Map<string, string>): void {
    const { camera: view, kind, layer, name, project, rect, rgba, method, limits, mirror } = one;
    if (state.value && state.value.project.id !== project.id) noteLeft(project, state.value);
    const into = one.target.into_new ?? null;
    const stroke: Stroke = new Stroke({
      ...{ link: this.host.link, camera: view, overlay: this.overlay, kind, layer, name, method, limits, mirror },
      base: Promise.resolve(null),
      after: Promise.all([this.lastCommit]).then(() => {}),
      onScreen: () => camera.value !== null && sameView(camera.value, view),
      project: project.id,
      isHome: () => isShown(project.id),
      newestStep,
      target: () => {
        const there = into === null ? undefined : made.get(into);
        return there && state.value?.layers.some((other) => other.id === there) ? { layer: there } : one.target;
      },
      commit: async (fields) => {
        await this.noteCommitting(stroke);
        const answer = await this.host.track("paint.end", fields, fields.name!);
        if (fields.into_new) made.set(fields.into_new, answer.layer.id);
        return answer.layer;
      },
      opacity: 1,
      selection: null,
    });
    stroke.committing = one.committing;
    stroke.mask.data.set(coverOf(one).data);
    stroke.setSource((x, y, out) => {
      const at = ((y - rect.y) * rect.width + x - rect.x) * 4;
      [out[0], out[1], out[2]] = [rgba[at], rgba[at + 1], rgba[at + 2]];
    });
    stroke.touch(rect);
    this.active.add(stroke);
    pendingStrokes.value = this.active.size;
    this.commitKept(stroke, one);
  }

  private commitKept(stroke: Stroke, { id, drawn, name, committing, project }: KeptStroke): void {
    const saved = committing !== null && isShown(project.id) && wasCommitted(name, committing);
    if (saved) void stroke.cancel();
    void this.end(stroke);
    this.drawn.set(stroke, { record: id, time: drawn, kept: true });
  }

  /** The view with the strokes that lie over it. */
  private async asSeen(): Promise<ImageData> {
    const { width, height } = this.overlayCanvas;
    const painted = this.overlay.getImageData(0, 0, width, height).data;
    const pixels = await this.host.pixels.now();
    if (this.active.size < 2) return pixels;
    const data = new Uint8ClampedArray(pixels.data);
    for (let at = 0; at < data.length; at += 4) {
      const alpha = painted[at + 3] / 255;
      if (alpha > 0) for (let c = 0; c < 3; c++) data[at + c] = painted[at + c] * alpha + data[at + c] * (1 - alpha);
    }
    return new ImageData(data, pixels.width, pixels.height);
  }

  /** A name that no layer and no stroke under way has: conflicts and the history speak of layers by name. */
  private unused(name: string): string {
    const taken = new Set([...(state.value?.layers ?? []), ...this.active].map((one) => one.name));
    for (let k = 1; ; k++) {
      const next = k === 1 ? name : `${name} ${k}`;
      if (!taken.has(next)) return next;
    }
  }

  private fitOverlay({ width, height }: CameraJson): void {
    const { overlayCanvas } = this;
    if (overlayCanvas.width !== width) overlayCanvas.width = width;
    if (overlayCanvas.height !== height) overlayCanvas.height = height;
  }

  private repaint(): void {
    this.overlay.clearRect(0, 0, this.overlayCanvas.width, this.overlayCanvas.height);
    for (const stroke of this.active) stroke.paint(); // each on its own view only
  }

  private forget(stroke: Stroke): void {
    this.active.delete(stroke);
    const drawn = this.drawn.get(stroke);
    this.drawn.delete(stroke);
    if (drawn?.kept) void this.shelf.drop(drawn.record);
    stroke.erase();
    pendingStrokes.value = this.active.size;
    this.repaint();
  }
}

/** Whether what is drawn has to wait: for the connection, an answer of the user, room on the disk; or the page goes. */
const isAway = (): boolean =>
  status.value !== "open" || swapped.value !== null || storageProblem.value !== null || graphicsLost.value !== null;

/** Coverage of a stroke that was kept: its alpha. */
function coverOf({ camera: view, rect, rgba }: KeptStroke): Mask {
  const mask = emptyMask(view.width, view.height);
  for (let y = 0; y < rect.height; y++)
    for (let x = 0; x < rect.width; x++)
      mask.data[(rect.y + y) * mask.width + rect.x + x] = rgba[(y * rect.width + x) * 4 + 3] / 255;
  return mask;
}

/** Why nothing can be painted, and what to do; null: it can. `into`: the layer that the stroke would go into, if any. */
function whyNot(into: LayerInfo | null): [string, string] | null {
  const [asked, answer] = waitsForAnswer("Painting") ?? [];
  if (asked) return [asked, answer!];
  if (readOnly.value)
    return [
      "This project is open elsewhere and is read-only here.",
      "Close it there, or save a copy under another name.",
    ];
  if (into && (!into.visible || into.opacity === 0))
    return [`${into.name} is hidden.`, "Show it, or choose another layer to paint into."];
  return null;
}

const never = (): Promise<never> => new Promise(() => {});

const randomName = (): string => Math.random().toString(36).slice(2) + Date.now().toString(36);

/** Number of the step in effect. */
const newestStep = (): number => state.value?.history[state.value.cursor]?.id ?? 0;

/** Whether a step of that name came after `newest` and is in effect: the stroke was saved, only its answer is lost. */
function wasCommitted(name: string, newest: number): boolean {
  const { history, cursor } = state.value!;
  return history.slice(0, cursor + 1).some((step) => step.id > newest && step.label.includes(name));
}
