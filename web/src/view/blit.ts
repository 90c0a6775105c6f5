/** From the half-float picture to the screen: clamp, put over the background, no further transfer curve. */

import * as THREE from "three";

import { fromHalf } from "../splats/half";

const vertexShader = `void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }`;
const fragmentShader = `
  precision highp float;
  uniform sampler2D picture;
  uniform vec3 background;
  uniform bool over;
  out vec4 color;
  void main() {
    vec4 p = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
    float a = clamp(p.a, 0.0, 1.0);
    color = over ? vec4(clamp(p.rgb, 0.0, 1.0), a) : vec4(clamp(p.rgb + (1.0 - a) * background, 0.0, 1.0), 1.0);
  }`;

export class Blit {
  readonly target = new THREE.WebGLRenderTarget(1, 1, {
    type: THREE.HalfFloatType,
    format: THREE.RGBAFormat,
    depthBuffer: false,
    minFilter: THREE.NearestFilter,
    magFilter: THREE.NearestFilter,
    generateMipmaps: false,
  });
  private readonly material = new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader,
    fragmentShader,
    uniforms: {
      picture: { value: this.target.texture },
      background: { value: new THREE.Vector3() },
      over: { value: false },
    },
    blending: THREE.CustomBlending,
    blendSrc: THREE.OneFactor,
    blendDst: THREE.OneMinusSrcAlphaFactor,
    depthTest: false,
    depthWrite: false,
    toneMapped: false,
  });
  private readonly scene = new THREE.Scene();
  private readonly camera = new THREE.OrthographicCamera();

  constructor() {
    const quad = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), this.material);
    quad.frustumCulled = false;
    this.scene.add(quad);
  }

  /** Draw the target onto the canvas, on the background, or over what is drawn there already. */
  show(renderer: THREE.WebGLRenderer, background: number[], over = false): void {
    const auto = renderer.autoClear;
    renderer.autoClear = !over;
    this.material.uniforms.over.value = over;
    this.material.uniforms.background.value.fromArray(background);
    renderer.setRenderTarget(null);
    renderer.render(this.scene, this.camera);
    renderer.autoClear = auto;
  }
}

/** What each of the 65536 half floats stands for. */
const FLOATS = Float32Array.from({ length: 0x10000 }, (_, bits) => fromHalf(bits));

/** The target's half floats over `background` as 8-bit RGBA, rows top down. */
export function toBytes(
  half: Uint16Array,
  width: number,
  height: number,
  background: number[],
): Uint8ClampedArray<ArrayBuffer> {
  const out = new Uint8ClampedArray(width * height * 4);
  for (let y = 0; y < height; y++) {
    let from = (height - 1 - y) * width * 4; // OpenGL counts rows from the bottom
    let to = y * width * 4;
    for (let x = 0; x < width; x++, from += 4, to += 4) {
      const rest = 1 - Math.min(1, FLOATS[half[from + 3]]);
      for (let c = 0; c < 3; c++) out[to + c] = (FLOATS[half[from + c]] + rest * background[c]) * 255;
      out[to + 3] = 255;
    }
  }
  return out;
}
