/**
 * One stroke from pen-down to the committed layer: coverage, overlay, preview on the server, commit.
 * The view is frozen meanwhile. Patches are sent one at a time; what is drawn while one is on its way goes with the next.
 */

import type { LayerInfo, PaintEnd, PaintLimits, Symmetry } from "../messages";
import type { Method } from "../state/store";
import { CommandError, type Link } from "../net/connection";
import type { CameraJson } from "../view/camera";
import type { Pixels } from "./flood";
import { base64, compose, over, type Grain, type Source } from "./patch";
import { clip, emptyMask, NOTHING, union, type Mask, type Rect } from "./raster";

export interface StrokeOptions {
  link: Link;
  camera: CameraJson;
  /** 2D context of the overlay, of the view's size. */
  overlay: CanvasRenderingContext2D;
  /** The view before the stroke, as seen; null: it is not needed, as of strokes that were kept. */
  base: Promise<Pixels | null>;
  /** The commit of the stroke before: the server keeps one stroke at a time. */
  after: Promise<void>;
  /** Whether the view is still on the screen. */
  onScreen: () => boolean;
  kind: "paint" | "clone" | "erase" | "mask";
  /** Of an eraser: the layer whose paint it takes away; null: back to the original. */
  layer: string | null;
  name: string;
  /** Id of the project that it is drawn in. */
  project: string;
  /** Whether that project is the one that the server has open, as far as is known. */
  isHome: () => boolean;
  /** Number of the newest step of that project's history that the page knows of. */
  newestStep: () => number;
  /** Where it goes, asked when the strokes before it are committed. */
  target: () => StrokeTarget;
  /** Send the commit; `committing` is set. */
  commit: (fields: PaintEnd) => Promise<LayerInfo>;
  method: Method;
  limits: PaintLimits;
  opacity: number;
  /** Where it is mirrored; null: nowhere. */
  mirror: Symmetry | null;
  /** As far as it is shown; the server keeps to it. */
  selection: Mask | null;
}

/** The layer that a stroke becomes, or becomes a part of. */
export type StrokeTarget = Pick<PaintEnd, "layer" | "into_new" | "replaces" | "placed" | "gesture" | "spread">;

export class Stroke {
  readonly mask: Mask;
  /** The frozen view; null until it was read. */
  base: Pixels | null = null;
  /** Resolves when `base` is there. */
  readonly ready: Promise<void>;
  readonly name: string;
  /** Id of the project that it belongs to, and no other. */
  readonly project: string;
  /** Step of the history that was the newest when its commit was sent; null: it was not sent. */
  committing: number | null = null;
  /** It was taken back: nothing more is sent. */
  withdrawn = false;
  private id: Promise<string>;
  /** Whether it is drawn once more on another server, which knows neither the stroke nor what was selected. */
  private replayed = false;
  private dirty: Rect = NOTHING;
  private touched: Rect = NOTHING;
  /** Changed and not on the overlay yet: a pen gives more points than the screen has frames. */
  private fresh: Rect = NOTHING;
  private frame = 0;
  private pumping: Promise<void> | null = null;
  private source: Source = () => {};
  private grain: Grain | null = null;
  private done = false;
  private failure: unknown = null;

  constructor(private readonly options: StrokeOptions) {
    const { camera } = options;
    this.name = options.name;
    this.project = options.project;
    this.mask = emptyMask(camera.width, camera.height);
    this.ready = options.base.then((pixels) => {
      this.base = pixels; // read before the first preview changes the view
      this.paint();
    });
    this.id = Promise.all([this.ready, options.after]).then(() => this.begin());
    this.id.catch(() => {});
  }

  private async begin(): Promise<string> {
    const { camera, kind, layer, link, mirror, isHome } = this.options;
    if (!isHome()) throw new CommandError("lost", "Another project is open.");
    return (await link.do("paint.begin", { camera, kind, layer, mirror })).stroke;
  }

  /** Begin anew on the server, with all that was drawn: what it knew of the stroke is lost. */
  again(): void {
    this.replayed = true;
    this.failure = null;
    this.done = false;
    this.committing = null;
    this.dirty = this.touched;
    this.id = this.begin();
    this.id.catch(() => {});
  }

  /** What of it can be kept: its pixels, and what it becomes. */
  record() {
    const { camera, kind, layer, name, method, limits, mirror, selection, target } = this.options;
    const rgba = this.patch(this.touched, selection);
    const { touched: rect, committing } = this;
    return { camera, kind, layer, name, method, limits, mirror, target: target(), committing, rect, rgba };
  }

  /** Rectangle of everything painted. */
  get extent(): Rect {
    return this.touched;
  }

  setSource(source: Source): void {
    this.source = source;
  }

  /** A texture of the paint; null: none. */
  setGrain(grain: Grain | null): void {
    this.grain = grain;
  }

  /** The mask (or the source's colours) changed there: show it and preview it. */
  touch(rect: Rect): void {
    const inside = clip(rect, this.mask);
    if (inside.width === 0) return;
    this.touched = union(this.touched, inside);
    this.dirty = union(this.dirty, inside);
    this.fresh = union(this.fresh, inside);
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.paint(this.fresh);
      this.fresh = NOTHING;
    });
    this.pumping ??= this.pump();
  }

  /** Start over with an empty mask (a line whose end moves). */
  reset(): void {
    const before = this.touched;
    this.mask.data.fill(0);
    this.touched = NOTHING;
    this.touch(before);
  }

  /** Pen up: commit. Resolves when the layer is there; null when nothing was painted. Rejects with a CommandError. */
  async end(): Promise<LayerInfo | null> {
    const stroke = await this.id;
    if (this.touched.width === 0) {
      await this.discard(stroke);
      return null;
    }
    while (this.dirty.width || this.pumping !== null) await (this.pumping ??= this.pump());
    this.done = true;
    if (this.failure) throw this.failure;
    if (this.withdrawn) return null;
    const { name, method, limits, target, commit, newestStep } = this.options;
    this.committing = newestStep();
    return commit({ stroke, name, method, limits, ...target() });
  }

  async cancel(): Promise<void> {
    this.done = this.withdrawn = true;
    this.dirty = NOTHING;
    this.erase();
    await this.id.then((stroke) => this.discard(stroke)).catch(() => {});
  }

  /** Take the stroke off the overlay; it does not come back by itself. */
  erase(): void {
    cancelAnimationFrame(this.frame);
    if (!this.options.onScreen()) return;
    const { x, y, width, height } = this.touched;
    this.options.overlay.clearRect(x, y, width, height);
  }

  /** Put it (back) on the overlay. */
  paint(rect: Rect = this.touched): void {
    if (rect.width === 0 || !this.options.onScreen()) return;
    const patch = this.patch(rect, this.options.selection);
    const seen = this.base ? over(rect, patch, this.base) : patch;
    this.options.overlay.putImageData(new ImageData(seen, rect.width, rect.height), rect.x, rect.y);
  }

  private patch(rect: Rect, selection: Mask | null): Uint8ClampedArray<ArrayBuffer> {
    return compose(rect, this.mask, selection, this.options.opacity, this.source, this.grain);
  }

  /** Send what is dirty until nothing is. Never rejects: `end` throws what went wrong. */
  private async pump(): Promise<void> {
    try {
      const stroke = await this.id;
      while (this.dirty.width && !this.done) {
        const rect = this.dirty;
        this.dirty = NOTHING;
        const selection = this.replayed ? this.options.selection : null; // else the server keeps to it, from all sides
        await this.options.link.do("paint.dab", { stroke, ...rect, rgba: base64(this.patch(rect, selection)) });
      }
    } catch (error) {
      this.failure ??= error;
      this.dirty = NOTHING;
    } finally {
      this.pumping = null;
    }
  }

  private async discard(stroke: string): Promise<void> {
    await this.options.link.do("paint.cancel", { stroke }).catch((error: unknown) => {
      if (!(error instanceof CommandError)) throw error;
    });
  }
}
