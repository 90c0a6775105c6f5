/** The ground grid: lines at the asset's foot, which the asset is then drawn over. */

import * as THREE from "three";

import type { Vec3 } from "./camera";

export class Grid {
  visible = false;
  private readonly scene = new THREE.Scene();
  private lines: THREE.GridHelper | null = null;

  /** Around `center`, `below` it against `up`. */
  setGround(center: Vec3, radius: number, up: Vec3, below = 0.8 * radius): void {
    this.lines?.removeFromParent();
    this.lines?.dispose();
    const lines = new THREE.GridHelper(radius * 4, 20, 0x8a8a8a, 0x6a6a6a);
    const axis = new THREE.Vector3(...up).normalize();
    lines.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), axis);
    lines.position.set(...center).addScaledVector(axis, -below);
    const material = lines.material as THREE.LineBasicMaterial;
    material.transparent = true;
    material.opacity = 0.35;
    material.depthTest = material.depthWrite = false;
    this.scene.add(lines);
    this.lines = lines;
  }

  /** Returns whether anything was drawn. */
  draw(renderer: THREE.WebGLRenderer, camera: THREE.Camera): boolean {
    if (!this.visible || !this.lines) return false;
    const auto = renderer.autoClear;
    renderer.autoClear = false;
    renderer.render(this.scene, camera);
    renderer.autoClear = auto;
    return true;
  }
}
