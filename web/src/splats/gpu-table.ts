/** The asset's Gaussians on the graphics card: a SplatMesh over texels that are rewritten in place as deltas arrive. */

import { ExtSplats, SplatMesh, utils } from "@sparkjsdev/spark";
import * as THREE from "three";

import type { Frame } from "../net/frames";
import { fromHalf } from "./half";
import { hitDistance } from "./ray";
import { allocate, encodeGaussian, type Texels } from "./texels";

const WIDTH_BITS = 11;
/** Texture rows hold 2048 splats, layers 2048 x 2048. */
const LAYER = 1 << 22;

/** Gaussians that are looked at to know how deep the asset reaches. */
const MAX_SAMPLES = 20000;

type Upload = { texture: THREE.Texture; data: Uint32Array };

/** A table of one SH degree. Make another one for an asset of another degree or one that outgrows `capacity`. */
export class SplatTable {
  readonly capacity: number;
  readonly mesh: SplatMesh;
  count = 0;
  private readonly texels: Texels;
  private readonly splats: ExtSplats;

  /** For the Gaussians of a snapshot and a quarter more; it is empty until they are written. */
  constructor(
    private readonly renderer: THREE.WebGLRenderer,
    { gaussians }: Frame,
  ) {
    this.capacity = utils.getTextureSize(Math.ceil(Math.max(gaussians.count, 1) * 1.25) + 4096).maxSplats;
    this.texels = allocate(this.capacity, gaussians.coefficients);
    this.splats = new ExtSplats({
      extArrays: [this.texels.geometry, this.texels.appearance],
      numSplats: gaussians.count,
      extra: this.extra(),
    });
    this.mesh = new SplatMesh({ extSplats: this.splats });
  }

  /** Whether `delta` fits into this table. */
  fits(delta: Frame): boolean {
    return delta.total <= this.capacity;
  }

  /** Encode Gaussians `from` to `to` of a snapshot or delta; they are shown by `finish`. */
  write({ indices, gaussians }: Frame, from: number, to: number): void {
    for (let k = from; k < to; k++) encodeGaussian(this.texels, indices ? indices[k] : k, gaussians, k);
  }

  /** Show what was written; Gaussians beyond `total` (taken back by an undo) are no longer drawn. Draw a frame afterwards. */
  finish({ indices, gaussians, total }: Frame): void {
    let [first, last] = [0, gaussians.count - 1];
    if (indices) {
      [first, last] = [Infinity, -1];
      for (const i of indices) {
        if (i < first) first = i;
        if (i > last) last = i;
      }
    }
    this.count = total;
    this.splats.numSplats = total;
    if (last >= 0)
      this.upload(first, last, gaussians.packedColors && !gaussians.shape ? this.uploads().slice(1) : this.uploads());
  }

  /** Distance to the surface along a ray (unit direction), null where there is none. */
  hit(origin: readonly number[], direction: readonly number[]): number | null {
    return hitDistance(this.texels, this.count, origin, direction);
  }

  /** See Viewer.depthBelow. */
  depthBelow(center: readonly number[], up: readonly number[]): number | null {
    const { geometry } = this.texels;
    const position = new Float32Array(geometry.buffer, geometry.byteOffset, geometry.length);
    const stride = Math.max(1, Math.floor(this.count / MAX_SAMPLES)) * 4;
    const depths: number[] = [];
    for (let k = 0; k < this.count * 4; k += stride) {
      if (fromHalf(geometry[k + 3] & 0xffff) < 0.1) continue;
      depths.push([0, 1, 2].reduce((sum, axis) => sum + (center[axis] - position[k + axis]) * up[axis], 0));
    }
    depths.sort((a, b) => a - b);
    return depths.length ? depths[Math.floor(0.99 * (depths.length - 1))] : null;
  }

  dispose(): void {
    this.mesh.removeFromParent();
    this.mesh.dispose();
    this.splats.dispose();
  }

  private extra(): Record<string, Uint32Array> {
    const names = ["sh1", "sh2", "sh3a", "sh3b"];
    return Object.fromEntries(this.texels.sh.map((array, k) => [names[k], array]));
  }

  /** Every texture with the array behind it, positions and opacities first. SH textures exist after the first frame; before that all of the array is uploaded. */
  private uploads(): Upload[] {
    const { textures, extra } = this.splats;
    const uploads: Upload[] = [
      { texture: textures[0], data: this.texels.geometry },
      { texture: textures[1], data: this.texels.appearance },
    ];
    ["sh1Texture", "sh2Texture", "sh3TextureA", "sh3TextureB"].forEach((name, k) => {
      const holder = extra[name] as { value: THREE.Texture } | undefined;
      if (holder && k < this.texels.sh.length) uploads.push({ texture: holder.value, data: this.texels.sh[k] });
    });
    return uploads;
  }

  private upload(first: number, last: number, uploads: Upload[]): void {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const y = first >> WIDTH_BITS;
    const height = (last >> WIDTH_BITS) - y + 1;
    for (const { texture, data } of uploads) {
      const handle = (this.renderer.properties.get(texture) as { __webglTexture?: WebGLTexture }).__webglTexture;
      if (!handle || last >= LAYER) {
        texture.needsUpdate = true; // not on the card yet, or several layers: all of the texture
        continue;
      }
      const { state } = this.renderer;
      state.activeTexture(gl.TEXTURE0);
      state.bindTexture(gl.TEXTURE_2D_ARRAY, handle);
      gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
      gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
      gl.texSubImage3D(
        gl.TEXTURE_2D_ARRAY,
        0,
        0,
        y,
        0,
        1 << WIDTH_BITS,
        height,
        1,
        gl.RGBA_INTEGER,
        gl.UNSIGNED_INT,
        data,
        y << (WIDTH_BITS + 2),
      );
      state.unbindTexture();
    }
  }
}
