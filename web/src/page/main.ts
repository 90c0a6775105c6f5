/**
 * A page of its own that shows one asset: the studio's viewer and gestures, no editor, no server, no request. It is opened by
 * the boot script of splatpainter/server/html_viewer.py, which unpacks the Gaussians.
 */

import { between, fromCamera, orbit, toCamera, type Pose } from "../view/camera";
import { FLY_KEYS, Gestures } from "../view/gestures";
import { Viewer } from "../view/viewer";
import { readGaussians, type Scene } from "./scene";

const TURN_SECONDS = 24;
/** Of a whole turn. */
const GLIDE_MS = 260;
const STYLE = `
  html, body { height: 100%; margin: 0; overflow: hidden; font: 13px/1.4 system-ui, sans-serif; }
  main { position: absolute; inset: 0; touch-action: none; cursor: grab; outline: none; }
  main:active { cursor: grabbing; }
  main:focus-visible { box-shadow: inset 0 0 0 2px #e8a13a; }
  canvas { display: block; width: 100%; height: 100%; }
  nav { position: absolute; right: 12px; bottom: 12px; display: flex; gap: 6px; }
  nav button, h1 { font: inherit; color: #e6e7ea; background: #1e2024d9; border: 1px solid #4a4f58; border-radius: 6px; }
  nav button { padding: 6px 10px; cursor: pointer; }
  nav button[aria-pressed="true"] { background: #e8a13a; color: #1a1409; }
  nav button:focus-visible { outline: 2px solid #e8a13a; outline-offset: 2px; }
  h1 { position: absolute; left: 12px; bottom: 12px; margin: 0; padding: 6px 10px; font-weight: 600;
    max-width: 45vw; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
  .fault { position: absolute; inset: 0; display: grid; place-content: center; color: #e6e7ea; background: #141518; }`;

const quiet = matchMedia("(prefers-reduced-motion: reduce)");

/** Show `scene` with the Gaussians in `data`. Called by the boot script. */
export async function show(scene: Scene, data: Uint8Array): Promise<void> {
  const style = document.createElement("style");
  style.textContent = STYLE;
  document.head.append(style);
  const stage = document.createElement("main");
  stage.tabIndex = 0;
  stage.setAttribute("role", "application");
  stage.setAttribute("aria-label", `${scene.name}: drag or arrow keys turn it, wheel or plus and minus zoom`);
  const canvas = document.createElement("canvas");
  stage.append(canvas);
  const title = document.createElement("h1");
  title.textContent = scene.name;
  document.body.replaceChildren(stage, title);

  const viewer = new Viewer(canvas, scene.antialiased);
  viewer.extent = scene.radius;
  viewer.apply(readGaussians(data, scene));
  const home = fromCamera(scene.camera, scene.center);
  let pose: Pose = home;
  let resolution = Math.min(window.devicePixelRatio || 1, 2);
  const go = (next: Pose) => {
    pose = next;
    const size = [stage.clientWidth, stage.clientHeight].map((side) => Math.max(16, Math.round(side * resolution)));
    viewer.setCamera(toCamera(narrowed(pose, size[0] / size[1]), size[0], size[1], scene.camera.background));
  };
  let gliding = 0;
  const glide = (to: Pose) => {
    cancelAnimationFrame(gliding);
    if (quiet.matches) return go(to);
    const [from, start] = [pose, performance.now()];
    const frame = (now: number) => {
      const t = Math.max(0, Math.min(1, (now - start) / GLIDE_MS));
      go(t === 1 ? to : between(from, to, t * t * (3 - 2 * t)));
      if (t < 1) gliding = requestAnimationFrame(frame);
    };
    gliding = requestAnimationFrame(frame);
  };
  const gestures = new Gestures({
    pose: () => narrowed(pose, stage.clientWidth / Math.max(stage.clientHeight, 1)),
    go: (next) => go({ ...next, fov: pose.fov }),
    glide: (next) => glide({ ...next, fov: pose.fov }),
    up: () => scene.up,
    nearest: () => scene.radius * 0.02,
    extent: () => scene.radius,
    frame: () => canvas.getBoundingClientRect(),
    hit: (eye, direction) => viewer.hit(eye, direction),
  });

  let turning = 0;
  const turnButton = button("Turn", () => (turning ? stop() : start()));
  const start = () => {
    turnButton.setAttribute("aria-pressed", "true");
    let before = performance.now();
    const frame = (now: number) => {
      go(orbit(pose, (2 * Math.PI * Math.min(now - before, 100)) / 1000 / TURN_SECONDS, 0, scene.up));
      before = now;
      turning = requestAnimationFrame(frame);
    };
    turning = requestAnimationFrame(frame);
  };
  const stop = () => {
    cancelAnimationFrame(turning);
    cancelAnimationFrame(gliding);
    turning = 0;
    turnButton.setAttribute("aria-pressed", "false");
  };
  const bar = document.createElement("nav");
  bar.setAttribute("aria-label", "View");
  const reset = button("Reset", () => (stop(), glide(home)));
  const full = button("Full screen", () => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen();
  });
  bar.append(turnButton, reset, ...(document.fullscreenEnabled ? [full] : []));
  turnButton.setAttribute("aria-pressed", "false");
  document.body.append(bar);

  stage.addEventListener("pointerdown", (event) => {
    stop();
    stage.setPointerCapture(event.pointerId);
    gestures.down(event, event.button === 1 || event.shiftKey ? "pan" : "orbit");
  });
  stage.addEventListener("pointermove", (event) => gestures.move(event));
  for (const kind of ["pointerup", "pointercancel"] as const)
    stage.addEventListener(kind, (event) => gestures.up(event));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => (event.preventDefault(), stop(), gestures.wheel(event)), {
    passive: false,
  });
  stage.addEventListener("keydown", (event) => {
    const step = Math.PI / 36;
    const turns: Record<string, [number, number]> = {
      ArrowLeft: [-step, 0],
      ArrowRight: [step, 0],
      ArrowUp: [0, -step],
      ArrowDown: [0, step],
    };
    if (FLY_KEYS.includes(event.code) && gestures.fly(event.code, true)) return;
    if (event.key in turns) (stop(), gestures.turn(...turns[event.key]));
    else if (event.key === "+" || event.key === "=") (stop(), gestures.zoom(1 / 1.15));
    else if (event.key === "-") (stop(), gestures.zoom(1.15));
    else if (event.key === "Home") (stop(), glide(home));
    else return;
    event.preventDefault();
  });
  stage.addEventListener("keyup", (event) => gestures.fly(event.code, false));
  window.addEventListener("blur", () => gestures.stop());
  new ResizeObserver(() => {
    resolution = Math.min(window.devicePixelRatio || 1, 2);
    go(pose);
  }).observe(stage);
  go(home);
  await viewer.settle();
  if (scene.turning && !quiet.matches) start();
  Object.assign(window, { splat: { viewer, pose: () => pose, go } }); // for the console and for tests
}

/** A window that is higher than wide shows as much sideways as a square one: the lens is that of the shorter side. */
function narrowed(pose: Pose, aspect: number): Pose {
  if (aspect >= 1) return pose;
  const half = Math.atan(Math.tan((pose.fov * Math.PI) / 360) / aspect);
  return { ...pose, fov: (half * 360) / Math.PI };
}

function button(text: string, onClick: () => void): HTMLButtonElement {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", onClick);
  return made;
}

/** Say why nothing can be shown. */
export function fail(error: unknown): void {
  const box = document.createElement("p");
  box.className = "fault";
  box.setAttribute("role", "alert");
  box.textContent = `This asset cannot be shown: ${error instanceof Error ? error.message : String(error)}.`;
  document.body.replaceChildren(box);
}
