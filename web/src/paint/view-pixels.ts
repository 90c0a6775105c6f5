/** The view's pixels: as it is seen now, and as the server renders what lies below the paint. */

import { blobUrl, pixelsOf } from "../net/blobs";
import type { Fields, Name, Result } from "../net/connection";
import { camera } from "../state/store";
import type { CameraJson } from "../view/camera";
import type { Viewer } from "../view/viewer";
import type { Pixels } from "./flood";

type Run = <N extends Name>(name: N, fields: Fields<N>) => Promise<Result<N> | null>;

export class ViewPixels {
  private latest: { camera: CameraJson; revision: number; pixels: Promise<ImageData> } | null = null;
  private latestOriginal: { camera: CameraJson; below: string | null; pixels: Promise<Pixels> } | null = null;

  constructor(
    private readonly viewer: Viewer,
    private readonly run: Run,
  ) {}

  /** As it is seen, 8 bit. Read anew only when something changed. */
  now(): Promise<ImageData> {
    const now = camera.value!;
    const { viewer, latest } = this;
    if (latest && latest.camera === now && latest.revision === viewer.revision) return latest.pixels;
    const next = { camera: now, revision: viewer.revision, pixels: viewer.read() };
    this.latest = next;
    next.pixels.catch(() => (this.latest = null));
    return next.pixels;
  }

  /** The original asset, or what is below a layer, rendered by the server. */
  original(below: string | null = null): Promise<Pixels> {
    const now = camera.value!;
    const { latestOriginal } = this;
    if (below === null && latestOriginal?.camera === now && latestOriginal.below === null) return latestOriginal.pixels;
    const pixels = this.run("view.render", { camera: now, which: "original", below }).then((answer) => {
      if (!answer) throw new Error("the original could not be rendered");
      return pixelsOf(blobUrl(answer.picture), now.width, now.height);
    });
    this.latestOriginal = { camera: now, below, pixels };
    pixels.catch(() => (this.latestOriginal = null));
    return pixels;
  }

  /** Read the view before a stroke needs it. */
  warmUp(): void {
    if (camera.value && this.viewer.count > 0) void this.now().catch(() => {});
  }
}
