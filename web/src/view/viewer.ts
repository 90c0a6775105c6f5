/** Draws the asset: a canvas, the table of splats, and a camera. Knows no server and no tools. Draws only when asked. */

import * as THREE from "three";

import type { Frame } from "../net/frames";
import { UploadQueue } from "../splats/upload-queue";
import { SplatTable } from "../splats/gpu-table";
import { Blit, toBytes } from "./blit";
import { add, scale, type CameraJson, type Vec3 } from "./camera";
import { Grid } from "./grid";
import { setThreeCamera } from "./three-camera";
import { makeSpark } from "./spark";

/** How far the picture is behind the Gaussians that have come. */
export interface Progress {
  /** Whether it does not show the newest ones. */
  behind: boolean;
  /** Gaussians on their way to the graphics card: those written, and all; 0 where none are. */
  written: number;
  total: number;
}

/** A picture that is not the final one is drawn again after so long, whether the screen asks for it or not. */
const CATCH_UP_MS = 300;

const sleep = (ms: number) => new Promise((resolve) => setTimeout(resolve, ms));

export class Viewer {
  readonly renderer: THREE.WebGLRenderer;
  readonly grid = new Grid();
  /** Size of the scene in world units, for near and far. */
  extent = 10;
  private readonly scene = new THREE.Scene();
  private readonly threeCamera = new THREE.PerspectiveCamera();
  private readonly blit = new Blit();
  private readonly spark;
  private table: SplatTable | null = null;
  /** Where the next Gaussians go: `table`, or the one that replaces it once it is written. */
  private newest: SplatTable | null = null;
  private readonly uploads = new UploadQueue<SplatTable>(
    (table) => this.written(table),
    undefined,
    undefined,
    () => this.report(),
  );
  private view: CameraJson | null = null;
  /** The animation frame that will draw; 0: none was asked for since the last picture. */
  private requested = 0;
  /** Whether colours and order are still those of another camera, or of other Gaussians. */
  private outdated = false;
  /** Counts changes of what is shown, the camera aside. */
  revision = 0;
  /** What the picture in the target shows, once it was drawn in its final order. */
  private still: { view: CameraJson; revision: number } | null = null;
  /** The revision that was drawn last in its final order, whatever the camera. */
  private shown = 0;
  private catchingUp: ReturnType<typeof setTimeout> | undefined;
  /** Told when the picture falls behind the newest Gaussians, or has caught up: see `Progress`. */
  onProgress: (progress: Progress) => void = () => {};

  constructor(canvas: HTMLCanvasElement, antialiased = false) {
    this.renderer = new THREE.WebGLRenderer({
      canvas,
      antialias: false,
      alpha: false,
      depth: false,
      powerPreference: "high-performance",
    });
    if (!this.renderer.extensions.has("EXT_color_buffer_float"))
      throw new Error("this browser cannot draw into float textures");
    this.renderer.setPixelRatio(1);
    this.spark = makeSpark({ renderer: this.renderer, antialiased, onDirty: () => this.invalidate() });
    this.scene.add(this.spark);
  }

  get count(): number {
    return this.table?.count ?? 0;
  }

  get camera(): CameraJson | null {
    return this.view;
  }

  /** The point of the surface that a ray from `eye` along a unit direction meets; null where there is none. */
  hit(eye: Vec3, direction: Vec3): Vec3 | null {
    const distance = this.table?.hit(eye, direction) ?? null;
    return distance === null ? null : add(eye, scale(direction, distance));
  }

  /** How far below `center` against `up` the asset reaches, all but one Gaussian in a hundred; null: there is none. */
  depthBelow(center: Vec3, up: Vec3): number | null {
    return this.table?.depthBelow(center, up) ?? null;
  }

  setAntialiased(antialiased: boolean): void {
    this.spark.preBlurAmount = antialiased ? 0 : 0.3;
    this.spark.blurAmount = antialiased ? 0.3 : 0;
    this.revision++;
    this.invalidate();
  }

  /**
   * Show a snapshot or apply a delta, after those before it; at once if it is small (see UploadQueue). Returns false when the
   * delta needs a snapshot instead (the table is full).
   */
  apply(frame: Frame): boolean {
    if (frame.snapshot) {
      for (const table of new Set(this.uploads.clear())) if (table !== this.table) table.dispose();
      this.newest = new SplatTable(this.renderer, frame);
    } else if (!this.newest?.fits(frame)) return false;
    this.uploads.add(this.newest, frame);
    this.report();
    return true;
  }

  private report(): void {
    const { written, total } = this.uploads.load;
    this.onProgress({ behind: total > 0 || this.shown !== this.revision, written, total });
  }

  private written(table: SplatTable): void {
    if (table !== this.table) {
      this.table?.dispose();
      this.table = table;
      this.scene.add(table.mesh);
      void table.mesh.initialized.then(() => this.changed());
    }
    this.revision++;
    this.changed();
  }

  setCamera(view: CameraJson): void {
    const { width, height } = view;
    const size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height) {
      this.renderer.setSize(width, height, false);
      this.blit.target.setSize(width, height);
    }
    this.view = view;
    const f = view.world_to_camera[2];
    const eyeDepth = Math.abs(f[3]);
    setThreeCamera(this.threeCamera, view, Math.max(1e-4 * this.extent, 1e-5), 4 * (eyeDepth + this.extent));
    this.changed();
  }

  /** Ask for a picture soon. */
  invalidate(): void {
    this.requested ||= requestAnimationFrame(() => this.draw());
  }

  private changed(): void {
    this.outdated = true;
    this.invalidate();
  }

  /** The view's colours as 8-bit RGBA, top row first, drawn with the order of exactly this camera. */
  async read(): Promise<ImageData> {
    await this.uploads.idle();
    if (!this.view || !this.table) throw new Error("nothing to read: there is no asset");
    while (!this.settled) {
      if (this.lost) throw new Error("the graphics card took the view away");
      await this.settle(); // the camera may move, and another table come, meanwhile
    }
    const { width, height, background } = this.view;
    const half = new Uint16Array(width * height * 4);
    this.renderer.readRenderTargetPixels(this.blit.target, 0, 0, width, height, half);
    return new ImageData(toBytes(half, width, height, background), width, height);
  }

  /**
   * Sort for the present camera and draw; without it the first picture after a jump has the old order, and the first
   * one after Gaussians were appended does not have them.
   */
  async settle(): Promise<void> {
    await this.uploads.idle();
    await this.table?.mesh.initialized;
    while (!this.lost && (this.outdated || this.sorting)) {
      await this.update();
      if (this.outdated || this.sorting) await sleep(1);
    }
    if (!this.settled) this.draw();
  }

  /** Whether the picture in the target is the one of the present camera and Gaussians, in its final order. */
  private get settled(): boolean {
    return this.still !== null && this.still.view === this.view && this.still.revision === this.revision;
  }

  /** The graphics card took the view away. */
  private get lost(): boolean {
    return this.renderer.getContext().isContextLost();
  }

  private get sorting(): boolean {
    return this.spark.sorting || this.spark.sortDirty;
  }

  /**
   * Evaluate colours for the present camera, at once, and sort. Another number of Gaussians has to wait for a sort that is
   * under way: then it stays outdated, and Spark asks for a picture when the sort is done.
   */
  private async update(): Promise<void> {
    if (!this.outdated) return;
    const { current } = this.spark;
    const sorted = this.spark.update({ scene: this.scene, camera: this.threeCamera });
    this.outdated = this.spark.current === current;
    await sorted.catch((error: unknown) => {
      if (!this.lost) throw error; // what Spark had begun ends with the view
    });
  }

  private draw(): void {
    if (this.lost) return;
    void this.update(); // and asks for a picture, which is this one
    cancelAnimationFrame(this.requested);
    this.requested = 0;
    const { view, renderer, revision } = this;
    if (!view) return;
    renderer.setRenderTarget(this.blit.target);
    renderer.setClearColor(0x000000, 0);
    renderer.clear();
    renderer.render(this.scene, this.threeCamera);
    this.blit.show(renderer, view.background);
    if (this.grid.draw(renderer, this.threeCamera)) this.blit.show(renderer, view.background, true); // behind the asset
    const final = !this.outdated && !this.sorting && this.table?.mesh.isInitialized;
    this.still = final ? { view, revision } : null;
    if (final) this.shown = revision;
    else
      this.catchingUp ??= setTimeout(() => {
        this.catchingUp = undefined;
        if (this.shown !== this.revision) void this.settle();
      }, CATCH_UP_MS);
    this.report();
  }
}
