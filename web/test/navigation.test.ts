import { describe, expect, it, vi } from "vitest";

import { allocate, encodeGaussian } from "../src/splats/texels";
import { hitDistance } from "../src/splats/ray";
import {
  add,
  between,
  cross,
  dot,
  focusOn,
  look,
  lookAlong,
  lookAt,
  orbitAbout,
  project,
  rayOf,
  scale,
  sub,
  target,
  toCamera,
  zoomTo,
  type Pose,
  type Vec3,
} from "../src/view/camera";
import { Gestures } from "../src/view/gestures";
import { axesOf } from "../src/view/sides";

const UP: Vec3 = [0, -1, 0];
const pose = lookAt([2, -1, -3], [0.1, 0.2, 0.3], UP, 40);
const [W, H] = [640, 480];
const pixel = (p: Pose, point: Vec3) => project(toCamera(p, W, H, [0, 0, 0]), point);
const near = (a: readonly number[], b: readonly number[], digits = 6) =>
  a.forEach((v, k) => expect(v).toBeCloseTo(b[k], digits));
const rigid = (p: Pose) => {
  near([dot(p.right, p.down), dot(p.right, p.forward), dot(p.down, p.forward)], [0, 0, 0]);
  near(cross(p.right, p.down), p.forward);
};

describe("moving the camera", () => {
  it("orbits about any point, which stays at its pixel and its distance", () => {
    const pivot: Vec3 = [0.6, -0.1, 0.2];
    const before = pixel(pose, pivot);
    const next = orbitAbout(pose, pivot, 0.7, 0.3, UP);
    rigid(next);
    near(pixel(next, pivot), before);
    expect(Math.abs(dot(next.right, UP))).toBeLessThan(1e-9); // upright
    near(next.eye, add(pivot, sub(next.eye, pivot)));
    expect(Math.hypot(...sub(next.eye, pose.eye))).toBeGreaterThan(0.5);
  });

  it("zooms to a point, which stays at its pixel, and stops before it", () => {
    const point: Vec3 = [0.5, -0.3, 0.1];
    const before = pixel(pose, point);
    const next = zoomTo(pose, point, 0.4, 0.01);
    near(pixel(next, point).slice(0, 2), before.slice(0, 2));
    expect(pixel(next, point)[2]).toBeCloseTo(0.4 * before[2]);
    expect(Math.hypot(...sub(zoomTo(pose, point, 1e-6, 0.25).eye, point))).toBeCloseTo(0.25);
  });

  it("looks around without moving, and along every axis", () => {
    const next = look(pose, -0.2, 0.1, UP);
    near(next.eye, pose.eye);
    rigid(next);
    expect(dot(next.forward, pose.right)).toBeGreaterThan(0.1); // to the right
    expect(dot(next.forward, UP)).toBeLessThan(dot(pose.forward, UP)); // downwards
    const home = toCamera(lookAt([0, -0.5, -3], [0, 0, 0], UP, 40), W, H, [0, 0, 0]);
    const asset = { up: UP, home };
    for (const [side, eye] of [
      ["front", [0, 0, -1]],
      ["back", [0, 0, 1]],
      ["right", [1, 0, 0]],
      ["left", [-1, 0, 0]],
      ["top", [0, -1, 0]],
      ["bottom", [0, 1, 0]],
    ] as const) {
      const { forward, up, ahead } = axesOf(asset, side);
      const view = lookAlong(pose, forward, up, ahead);
      rigid(view);
      near(view.forward, scale(eye as unknown as Vec3, -1));
      near(target(view), target(pose));
      if (side === "top") near(view.down, [0, 0, -1]); // the front is below on the screen
      if (side === "bottom") near(view.down, [0, 0, 1]);
    }
  });

  it("glides from pose to pose, over half a turn too", () => {
    const { forward, up, ahead } = axesOf({ up: UP, home: toCamera(pose, W, H, [0, 0, 0]) }, "back");
    for (const to of [focusOn(pose, [0.4, 0, 0], 1), lookAlong(pose, scale(pose.forward, -1), UP, ahead)]) {
      for (const t of [0, 0.25, 0.5, 1]) rigid(between(pose, to, t));
      near(between(pose, to, 0).eye, pose.eye);
      near(between(pose, to, 1).eye, to.eye);
      near(between(pose, to, 1).forward, to.forward);
    }
    expect(dot(forward, up)).toBeCloseTo(0);
  });
});

describe("what a ray meets", () => {
  const texels = allocate(2048, 1);
  const write = (at: number, mean: number[], scales: number[], opacity: number, quat = [1, 0, 0, 0]) =>
    encodeGaussian(
      texels,
      at,
      {
        count: 1,
        shape: { means: Float32Array.from(mean), scales: Float32Array.from(scales), quats: Float32Array.from(quat) },
        opacities: Float32Array.from([opacity]),
        sh: new Float32Array(3),
        coefficients: 1,
      },
      0,
    );

  it("is where half of the light is gone", () => {
    write(0, [0, 0, 5], [0.5, 0.5, 0.01], 0.95);
    write(1, [0, 0, 3], [0.5, 0.5, 0.01], 0.2); // a veil
    expect(hitDistance(texels, 2, [0, 0, 0], [0, 0, 1])).toBeCloseTo(5, 2);
    write(2, [0, 0, 4], [0.5, 0.5, 0.01], 0.5); // both veils together are enough
    expect(hitDistance(texels, 3, [0, 0, 0], [0, 0, 1])).toBeCloseTo(4, 2);
    expect(hitDistance(texels, 3, [9, 0, 0], [0, 0, 1])).toBeNull();
    expect(hitDistance(texels, 3, [0, 0, 0], [0, 0, -1])).toBeNull();
    write(3, [0, 0, 2], [0.5, 0.5, 0.01], 0); // hidden
    expect(hitDistance(texels, 4, [0, 0, 0], [0, 0, 1])).toBeCloseTo(4, 2);
  });

  it("knows how a Gaussian is turned", () => {
    const quarter = [Math.SQRT1_2, 0, 0, Math.SQRT1_2]; // about z: long in y
    write(0, [0, 0, 5], [1, 0.01, 0.01], 0.95, quarter);
    expect(hitDistance(texels, 1, [0, 0.9, 0], [0, 0, 1])).toBeCloseTo(5, 1);
    expect(hitDistance(texels, 1, [0.9, 0, 0], [0, 0, 1])).toBeNull();
  });
});

describe("gestures", () => {
  vi.stubGlobal("requestAnimationFrame", () => 1);
  vi.stubGlobal("cancelAnimationFrame", () => {});

  function hands(surface: Vec3 | null) {
    let now = pose;
    const gestures = new Gestures({
      pose: () => now,
      go: (next) => (now = next),
      glide: (next) => (now = next),
      up: () => UP,
      nearest: () => 0.02,
      extent: () => 1,
      frame: () => ({ left: 0, top: 0, width: W, height: H }),
      hit: () => surface,
    });
    let time = 1000;
    const event = (x: number, y: number, more: object = {}) =>
      ({ pointerId: 1, clientX: x, clientY: y, button: 0, deltaMode: 0, timeStamp: (time += 1000), ...more }) as never;
    return { gestures, event, pose: () => now };
  }

  it("turns about the point under the pointer", () => {
    const surface = add(pose.eye, scale(rayOf(pose, 0.3, -0.2, W / H), 2.5));
    const { gestures, event, pose: now } = hands(surface);
    const before = pixel(pose, surface);
    gestures.down(event(416, 192), "orbit");
    gestures.move(event(480, 230));
    gestures.up(event(480, 230));
    near(pixel(now(), surface), before, 4);
    expect(dot(now().forward, pose.forward)).toBeLessThan(0.95);
  });

  it("slides with the surface under the hand and zooms to the cursor", () => {
    const surface = add(pose.eye, scale(rayOf(pose, 0.3, -0.2, W / H), 2.5));
    const { gestures, event, pose: now } = hands(surface);
    gestures.down(event(416, 192), "pan");
    gestures.move(event(446, 172));
    gestures.up(event(446, 172));
    near(pixel(now(), surface).slice(0, 2), [446, 172], 4);
    const at = pixel(now(), surface);
    gestures.wheel(event(446, 172, { deltaY: -300 }));
    near(pixel(now(), surface).slice(0, 2), at.slice(0, 2), 4);
    expect(pixel(now(), surface)[2]).toBeLessThan(0.8 * at[2]);
  });

  it("focuses on a double click, and on empty space does nothing", () => {
    const surface = add(pose.eye, scale(rayOf(pose, 0.3, -0.2, W / H), 2.5));
    for (const there of [surface, null]) {
      const { gestures, event, pose: now } = hands(there);
      for (const timeStamp of [5000, 5150]) {
        gestures.down(event(416, 192, { timeStamp }), "orbit");
        gestures.up(event(416, 192, { timeStamp }));
      }
      if (there) near(pixel(now(), surface).slice(0, 2), [W / 2, H / 2]);
      else near(now().eye, pose.eye);
    }
  });

  it("pinches about the point between the fingers", () => {
    const { gestures, event, pose: now } = hands(null);
    const point = add(
      pose.eye,
      scale(rayOf(pose, 0.25, 0, W / H), pose.distance / dot(rayOf(pose, 0.25, 0, W / H), pose.forward)),
    );
    near(pixel(pose, point).slice(0, 2), [400, 240], 4);
    gestures.down(event(360, 240, { pointerId: 1 }), "orbit");
    gestures.down(event(440, 240, { pointerId: 2 }), "orbit");
    for (let k = 1; k <= 40; k++) {
      gestures.move(event(360 - k, 240, { pointerId: 1 }));
      gestures.move(event(440 + k, 240, { pointerId: 2 }));
    }
    near(pixel(now(), point).slice(0, 2), [400, 240], -0.5);
    expect(pixel(now(), point)[2]).toBeCloseTo(pose.distance / 2, 1);
  });

  it("flies only while the right button is held", () => {
    const { gestures, event } = hands(null);
    expect(gestures.fly("KeyW", true)).toBe(false);
    gestures.down(event(10, 10, { button: 0 }), "orbit");
    expect(gestures.fly("KeyW", true)).toBe(false);
    gestures.up(event(10, 10));
    gestures.down(event(300, 10, { button: 2 }), "orbit");
    expect(gestures.fly("KeyW", true)).toBe(true);
    expect(gestures.fly("KeyB", true)).toBe(false);
    gestures.up(event(300, 10, { button: 2 }));
    expect(gestures.fly("KeyW", true)).toBe(false);
  });
});
