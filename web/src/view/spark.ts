/**
 * Spark set up so that it draws classic 3D Gaussian Splatting as the server does: depth sort, 3.33 sigma, +0.3 px
 * dilation, cut at 1/255, display colours as they are. Its defaults are 34 dB away from that, this is above 55.
 */

import { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";

const BATCH = 128;
/** Quads per instance: one quad per instance, as Spark draws, leaves most of a GPU's lanes idle. */

export interface SparkOptions {
  renderer: THREE.WebGLRenderer;
  /** Trained with Mip-Splatting's filter: the blur is compensated in opacity. */
  antialiased: boolean;
  /** Called when the next picture would be another one: an order is sorted, new colours are evaluated. */
  onDirty: () => void;
}

export function makeSpark({ renderer, antialiased, onDirty }: SparkOptions): SparkRenderer {
  const spark = new SparkRenderer({
    renderer,
    onDirty,
    autoUpdate: false, // by itself it updates after each picture, which draws each change again, and sorts for turns of 2.6 degrees
    sortRadial: false,
    maxStdDev: 3.33,
    preBlurAmount: antialiased ? 0 : 0.3,
    blurAmount: antialiased ? 0.3 : 0,
    minAlpha: 1 / 255,
    maxPixelRadius: 4096,
    accumExtSplats: true,
    enableLod: false,
  });
  batchQuads(spark);
  const before = spark.onBeforeRender;
  spark.onBeforeRender = function (...args: Parameters<typeof before>) {
    before.apply(spark, args);
    spark.uniforms.encodeLinear.value = false; // colours blend as display values; a render target would get pow 2.2
  };
  return spark;
}

/** Draw BATCH splats per instance. Identical pictures; 2.5 times as fast where it was measured. */
function batchQuads(spark: SparkRenderer): void {
  const corners = [-1, -1, 1, -1, 1, 1, -1, 1];
  const position = new Float32Array(BATCH * 4 * 3);
  const index = new Uint16Array(BATCH * 6);
  for (let q = 0; q < BATCH; q++) {
    for (let c = 0; c < 4; c++) position.set([corners[c * 2], corners[c * 2 + 1], q], (q * 4 + c) * 3);
    index.set(
      [0, 1, 2, 0, 2, 3].map((k) => q * 4 + k),
      q * 6,
    );
  }
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
  const active = { value: 0 };
  (spark.uniforms as unknown as Record<string, unknown>).activeSplats = active;
  let instances = 0;
  Object.defineProperty(geometry, "instanceCount", {
    get: () => instances,
    set: (count: number) => {
      active.value = Number.isFinite(count) ? count : 0;
      instances = Math.ceil(active.value / BATCH);
    },
  });
  spark.geometry = geometry;
  spark.material.vertexShader = patchShader(spark.material.vertexShader);
}

/** Replace the instance by instance * BATCH + quad. Throws when Spark's shader is not the one that this was written for. */
export function patchShader(shader: string): string {
  const [head, body] = shader.split("void main() {");
  if (!body || !body.includes("gl_InstanceID")) throw new Error("Spark's vertex shader has changed: pin its version");
  const slot = `
    int slot = gl_InstanceID * ${BATCH} + int(position.z);
    if (slot >= activeSplats) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }`;
  return `${head}uniform int activeSplats;\nvoid main() {${slot}${body.replaceAll("gl_InstanceID", "slot")}`;
}
