import * as THREE from "three";
import { describe, expect, it } from "vitest";

import {
  cross,
  dolly,
  dot,
  frame,
  fromCamera,
  lookAt,
  orbit,
  pan,
  project,
  reshaped,
  rewindowed,
  sameViewpoint,
  sub,
  target,
  toCamera,
  viewSize,
  zoomLens,
  type Pose,
  type Vec3,
} from "../src/view/camera";
import { setThreeCamera } from "../src/view/three-camera";

const UP: Vec3 = [0, -1, 0]; // files have y down
const pose = lookAt([2, -1, -3], [0.1, 0.2, 0.3], UP, 40);
const near = (a: readonly number[], b: readonly number[], digits = 9) =>
  a.forEach((v, k) => expect(v).toBeCloseTo(b[k], digits));
const rigid = (p: Pose) => {
  near([dot(p.right, p.down), dot(p.right, p.forward), dot(p.down, p.forward)], [0, 0, 0]);
  near(cross(p.right, p.down), p.forward);
};

describe("cameras", () => {
  it("puts the target in the middle of the picture, up being up", () => {
    const camera = toCamera(pose, 640, 480, [0, 0, 0]);
    near(project(camera, [0.1, 0.2, 0.3]), [320, 240, pose.distance]);
    expect(project(camera, [0.1, 0.1, 0.3])[1]).toBeLessThan(240); // y down: smaller y is higher
  });

  it("knows the same viewpoint at another size and on another ground", () => {
    const camera = toCamera(pose, 640, 480, [0, 0, 0]);
    expect(sameViewpoint(camera, toCamera(pose, 1280, 960, [1, 1, 1]))).toBe(true);
    expect(sameViewpoint(camera, toCamera(pose, 640, 400, [0, 0, 0]))).toBe(false);
    expect(sameViewpoint(camera, toCamera(zoomLens(pose, 41), 640, 480, [0, 0, 0]))).toBe(false);
    expect(sameViewpoint(camera, toCamera(orbit(pose, 0.01, 0, UP), 640, 480, [0, 0, 0]))).toBe(false);
  });

  it("sees the field of view from border to border", () => {
    const camera = toCamera(pose, 640, 480, [0, 0, 0]);
    expect((2 * Math.atan(240 / camera.fy) * 180) / Math.PI).toBeCloseTo(40, 9);
    expect(camera.fx).toBe(camera.fy);
  });

  it("becomes a pose and a camera again", () => {
    const camera = toCamera(pose, 640, 480, [0, 0, 0]);
    const back = fromCamera(camera, [0.1, 0.2, 0.3]);
    near(back.eye, pose.eye);
    near(target(back), target(pose));
    near(toCamera(back, 640, 480, [0, 0, 0]).world_to_camera.flat(), camera.world_to_camera.flat());
  });
});

describe("orbit", () => {
  it("keeps distance and target, and stays rigid", () => {
    let turned = pose;
    for (let k = 0; k < 400; k++) turned = orbit(turned, 0.07, 0.05 * Math.sin(k), UP);
    rigid(turned);
    near(target(turned), target(pose));
    expect(turned.distance).toBe(pose.distance);
  });

  it("turns without tilting the horizon and stops short of the poles", () => {
    const turned = orbit(pose, 0.4, 9, UP);
    expect(Math.abs(dot(turned.right, UP))).toBeLessThan(1e-9);
    expect(-dot(turned.forward, UP)).toBeLessThan(1);
    expect(Math.asin(-dot(turned.forward, UP))).toBeCloseTo((89.5 * Math.PI) / 180, 6);
  });

  it("is undone by the opposite turn", () => {
    near(orbit(orbit(pose, 0.3, 0, UP), -0.3, 0, UP).eye, pose.eye);
    near(orbit(orbit(pose, 0, 0.2, UP), 0, -0.2, UP).eye, pose.eye);
  });

  it("slides the target with the hand", () => {
    const moved = pan(pose, 30, -20, 480);
    const [x, y] = project(toCamera(moved, 640, 480, [0, 0, 0]), target(pose));
    near([x, y], [350, 220]);
  });

  it("comes nearer down to a limit and keeps the target's size when the lens changes", () => {
    expect(dolly(pose, 1e-9, 0.5).distance).toBe(0.5);
    const tele = zoomLens(pose, 15);
    const size = (p: Pose) => toCamera(p, 640, 480, [0, 0, 0]).fy / p.distance;
    expect(size(tele)).toBeCloseTo(size(pose), 9);
  });

  it("frames a sphere in the narrower direction", () => {
    for (const [width, height] of [
      [640, 480],
      [300, 600],
    ]) {
      const framed = frame(pose, [1, 2, 3], 0.7, width / height);
      const camera = toCamera(framed, width, height, [0, 0, 0]);
      const reach = (camera.fx * 0.7) / Math.sqrt(framed.distance ** 2 - 0.49); // of the sphere's outline
      expect(reach).toBeLessThan(Math.min(width, height) / 2);
      expect(reach).toBeGreaterThan(Math.min(width, height) * 0.45);
    }
  });
});

describe("three-camera", () => {
  it("draws points where the camera says, off-centre and with fx != fy", () => {
    const view = { ...toCamera(pose, 640, 480, [0, 0, 0]), fx: 500, fy: 540, cx: 300.5, cy: 250.25 };
    const lens = new THREE.PerspectiveCamera();
    setThreeCamera(lens, view, 0.01, 100);
    for (const point of [
      [0, 0, 0],
      [0.5, -0.4, 0.2],
      [-0.7, 0.3, 0.9],
    ] as Vec3[]) {
      const clip = new THREE.Vector3(...point)
        .applyMatrix4(lens.matrixWorldInverse)
        .applyMatrix4(lens.projectionMatrix);
      const [x, y] = project(view, point);
      near([((clip.x + 1) / 2) * 640, ((1 - clip.y) / 2) * 480], [x, y], 6);
    }
    near(sub(lens.getWorldPosition(new THREE.Vector3()).toArray() as Vec3, pose.eye), [0, 0, 0], 9);
  });
});

describe("the window", () => {
  it("keeps in sight what was, upright and back", () => {
    const aspects = [1.6, 0.6, 2, 0.4, 1.6];
    let now = pose;
    // the target is as large as the shorter side shows it
    const seen = (p: Pose, aspect: number) => {
      const camera = toCamera(p, 1000 * aspect, 1000, [0, 0, 0]);
      return camera.fy / p.distance / Math.min(camera.width, camera.height);
    };
    const first = seen(now, aspects[0]);
    for (let k = 1; k < aspects.length; k++) {
      now = reshaped(now, aspects[k - 1], aspects[k]);
      expect(seen(now, aspects[k])).toBeCloseTo(first, 9);
      near(target(now), target(pose));
    }
    near(now.eye, pose.eye);
  });

  it("carries pixels to where the same is seen in another one", () => {
    const [from, to] = [toCamera(pose, 640, 480, [0, 0, 0]), toCamera(pose, 800, 430, [0, 0, 0])];
    const point: Vec3 = [0.4, 0.1, 0.2];
    const [x, y] = project(from, point);
    const carried = rewindowed(from, to)!;
    near(carried.at(x, y), project(to, point).slice(0, 2));
    expect(carried.scale).toBeCloseTo(430 / 480, 9);
    expect(rewindowed(from, toCamera(dolly(pose, 0.9, 0), 800, 430, [0, 0, 0]))).toBe(null);
  });

  it("has the device's pixels, as many as the server draws", () => {
    expect(viewSize(900, 520, 1, 4e6)).toEqual({ width: 900, height: 520, density: 1 });
    expect(viewSize(900.4, 520, 2, 4e6)).toEqual({ width: 1801, height: 1040, density: 2 });
    const large = viewSize(1500, 900, 2, 4e6);
    expect(large.width * large.height).toBeLessThanOrEqual(4e6);
    expect(large.width * large.height).toBeGreaterThan(3.99e6);
    expect(large.width / large.height).toBeCloseTo(1500 / 900, 2);
    expect(large.density).toBeCloseTo(Math.sqrt(4e6 / (1500 * 900)), 9);
    expect(viewSize(0, 0, 1, 4e6)).toEqual({ width: 16, height: 16, density: 1 });
  });
});
