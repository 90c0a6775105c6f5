/** Where the view goes: at once, smoothly, home, and along with the window's size. */

import { effect, untracked } from "@preact/signals";

import { MAX_VIEW_PIXELS, type AssetInfo } from "../messages";
import { camera, density, frozen, pose, rgb, view } from "../state/store";
import { between, fromCamera, reshaped, sameView, toCamera, viewSize, type Pose, type Vec3 } from "../view/camera";

const GLIDE_MS = 260;
/** The animation that is under way, and the shape (width / height) of the view that is shown. */
const shown = { gliding: 0, shape: 1 };

/** Go to a pose smoothly, or at once for those who want no motion. */
export function glide(to: Pose): void {
  const from = pose.value;
  cancelAnimationFrame(shown.gliding);
  if (!from || matchMedia("(prefers-reduced-motion: reduce)").matches) return go(to);
  const start = performance.now();
  const frame = (now: number) => {
    const t = Math.max(0, Math.min(1, (now - start) / GLIDE_MS));
    go(t === 1 ? to : between(from, to, t * t * (3 - 2 * t)));
    if (t < 1) shown.gliding = requestAnimationFrame(frame);
  };
  shown.gliding = requestAnimationFrame(frame);
}

/** Go to a pose; the exact camera follows from the window's size. */
export function go(next: Pose): void {
  cancelAnimationFrame(shown.gliding);
  pose.value = next;
  const { width, height } = canvasSize();
  shown.shape = width / height;
  show();
}

/** The camera of the pose. Not before a stroke has read the view: it would get the pixels of another one. */
function show(): void {
  if (!pose.value || frozen.value > 0) return;
  const { width, height, density: perPixel } = canvasSize();
  density.value = perPixel;
  const now = toCamera(pose.value, width, height, rgb(view.value.background));
  if (!camera.value || !sameView(camera.value, now)) camera.value = now;
}

effect(() => {
  if (frozen.value === 0) untracked(show);
});

/** The window's size or background changed: what was in sight stays in sight. */
export function refresh(): void {
  if (!pose.value) return;
  const { width, height } = canvasSize();
  go(reshaped(pose.value, shown.shape, width / height));
}

/** The first view of an asset, in this window. */
export function homePose({ home, center }: AssetInfo): Pose {
  const { width, height } = canvasSize();
  return reshaped(fromCamera(home, center as Vec3), home.width / home.height, width / height);
}

/** Size of the view in pixels, and its pixels per pixel of the page. */
function canvasSize(): ReturnType<typeof viewSize> {
  const { clientWidth, clientHeight } = document.getElementById("stage")!;
  const factor = view.value.resolution * (window.devicePixelRatio || 1);
  return viewSize(clientWidth, clientHeight, factor, MAX_VIEW_PIXELS);
}
