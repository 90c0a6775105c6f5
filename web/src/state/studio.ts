/** The one studio of this page: the link to the server, the viewer, and what runs between them. */

import { effect } from "@preact/signals";

import { MAX_VIEW_PIXELS, WRITING, type AssetInfo, type Event, type State, type StateEvent } from "../messages";
import { CommandError, Link, type Fields, type Name, type Result } from "../net/connection";
import { between, fromCamera, reshaped, sameView, toCamera, viewSize, type Pose, type Vec3 } from "../view/camera";
import { Viewer } from "../view/viewer";
import { applyBatch, learnBatch } from "./batch";
import { watchGraphics } from "./graphics";
import { axisName } from "./up-axis";
import { noteStorage } from "./storage";
import { noteSuccessor, waitingElsewhere } from "./waiting";
import {
  camera,
  density,
  drawn,
  jobs,
  opening,
  pose,
  pythonLog,
  refusal,
  rgb,
  saving,
  selectedLayer,
  silent,
  state,
  status,
  stopped,
  swapped,
  toast,
  view,
  working,
} from "./store";

/** Set by `start`, before the interface is mounted. */
export let viewer: Viewer;
export let link: Link;
/** A picture was saved into the watched folder. */
export const watched: { onPicture: (blob: string, name: string) => void } = { onPicture: () => {} };

const JOB_DELAY_MS = 400;

export function start(canvas: HTMLCanvasElement): void {
  viewer = new Viewer(canvas);
  viewer.onProgress = (progress) => (drawn.value = { ...progress, version: link?.received ?? -1 });
  watchGraphics(canvas);
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  link = new Link(`${scheme}://${location.host}/ws`, {
    status: (next, reason) => {
      status.value = next;
      stopped.value = reason;
    },
    greeted: (greeting) => {
      adopt(greeting.state);
      learnBatch(() => link.do("batch.status", {})).catch(report);
    },
    event,
    answered: ({ python }) => {
      if (python) pythonLog.value = [...pythonLog.value, python].slice(-500);
    },
    frame: (frame) => viewer.apply(frame),
    silent: (is) => (silent.value = is),
  });
  effect(() => {
    const now = camera.value;
    if (now) viewer.setCamera(now);
  });
  effect(() => {
    viewer.grid.visible = view.value.grid;
    const asset = state.peek()?.asset;
    if (view.value.grid && asset) {
      const [center, up] = [asset.center as Vec3, asset.up as Vec3];
      viewer.grid.setGround(center, asset.radius, up, viewer.depthBelow(center, up) ?? undefined);
    }
    viewer.invalidate();
  });
  effect(() => {
    // whoever opened the other project: what waits must be asked about
    const project = waitingElsewhere.value;
    if (project !== null && swapped.value === null) swapped.value = leftProjects.get(project) ?? null;
  });
  link.connect();
}

/**
 * Run a command, showing progress when it takes a while and a toast when it fails. Returns null if it failed.
 * `label`: what the progress bar says; "" for quick things that need none.
 */
export async function run<N extends Name>(name: N, fields: Fields<N>, label = ""): Promise<Result<N> | null> {
  try {
    return await track(name, fields, label);
  } catch (error) {
    report(error, label);
    return null;
  }
}

/** Run a command, showing progress when it takes a while. Rejects with a CommandError. */
export async function track<N extends Name>(name: N, fields: Fields<N>, label: string): Promise<Result<N>> {
  const running = link.do(name, fields, (progress, stage) => {
    jobs.value = jobs.value.map((job) => (job.id === running.id ? { ...job, progress, stage } : job));
  });
  const job = { id: running.id, label, progress: 0, stage: "", cancel: () => running.cancel() };
  const timer = label ? setTimeout(() => (jobs.value = [...jobs.value, job]), JOB_DELAY_MS) : undefined;
  const counted = OPENING.includes(name) ? opening : WRITING.has(name) ? saving : working;
  const counts = label !== "" || counted === opening;
  if (counts) counted.value++;
  try {
    const answer = await running;
    if (label) refusal.value = null;
    return answer;
  } finally {
    if (counts) counted.value--;
    clearTimeout(timer);
    jobs.value = jobs.value.filter((other) => other.id !== running.id);
  }
}

/** Show what went wrong, and leave it in the status line. A cancelled command is no error. */
export function report(error: unknown, what = ""): void {
  if (error instanceof CommandError) {
    if (error.kind === "cancelled") return;
    if (error.kind === "storage") return noteStorage(error.message, error.hint); // a card, which stays
    toast(error.kind === "fault" ? "error" : "warning", error.message, error.hint);
    refusal.value = { what, message: error.message, hint: error.hint };
  } else {
    toast("error", error instanceof Error ? error.message : String(error));
    console.error(error);
  }
}

const GLIDE_MS = 260;
let gliding = 0;

/** Go to a pose smoothly, or at once for those who want no motion. */
export function glide(to: Pose): void {
  const from = pose.value;
  cancelAnimationFrame(gliding);
  if (!from || matchMedia("(prefers-reduced-motion: reduce)").matches) return go(to);
  const start = performance.now();
  const frame = (now: number) => {
    const t = Math.max(0, Math.min(1, (now - start) / GLIDE_MS));
    go(t === 1 ? to : between(from, to, t * t * (3 - 2 * t)));
    if (t < 1) gliding = requestAnimationFrame(frame);
  };
  gliding = requestAnimationFrame(frame);
}

/** Go to a pose; the exact camera follows from the window's size. */
export function go(next: Pose): void {
  cancelAnimationFrame(gliding);
  pose.value = next;
  const size = canvasSize();
  shape = size.width / size.height;
  density.value = size.density;
  const now = toCamera(next, size.width, size.height, rgb(view.value.background));
  if (!camera.value || !sameView(camera.value, now)) camera.value = now;
}

/** Width / height of the view that is shown. */
let shape = 1;

/** The window's size or background changed: what was in sight stays in sight. */
export function refresh(): void {
  if (!pose.value) return;
  const { width, height } = canvasSize();
  go(reshaped(pose.value, shape, width / height));
}

/** The first view of an asset, in this window. */
export function homePose({ home, center }: AssetInfo): Pose {
  const { width, height } = canvasSize();
  return reshaped(fromCamera(home, center as Vec3), home.width / home.height, width / height);
}

function canvasSize(): ReturnType<typeof viewSize> {
  const { clientWidth, clientHeight } = viewer.renderer.domElement.parentElement!;
  const factor = view.value.resolution * (window.devicePixelRatio || 1);
  return viewSize(clientWidth, clientHeight, factor, MAX_VIEW_PIXELS);
}

function event(message: Event): void {
  if (message.event === "state") applyState(message);
  else if (message.event === "batch") applyBatch(message);
  else if (message.event === "toast") toast(message.level, message.message, message.hint);
  else watched.onPicture(message.picture, message.name);
}

function applyState({ state: present, history, bookmarks }: StateEvent): void {
  const before = state.value!; // the greeting came first
  const { dropped = 0, kept = before.history.length, steps = [] } = history ?? {};
  adopt({
    ...present,
    history: [...before.history.slice(dropped, dropped + kept), ...steps],
    bookmarks: bookmarks ?? before.bookmarks,
  });
}

/** Commands of this page that open another project. */
const OPENING: readonly Name[] = ["asset.open", "project.open"];
/** When the layers were last changed: seconds since 1970. */
let changed = 0;
/** Projects that this page was in, as they were left, by their ids. */
const leftProjects = new Map<string, NonNullable<typeof swapped.value>>();

function adopt(next: State): void {
  const before = state.value;
  const another = before !== null && before.session !== next.session;
  if (another) noteSuccessor(before, next);
  if (!another && before && before.version !== next.version) changed = Date.now() / 1000;
  state.value = next; // what waits for this project goes on
  if (another) {
    const same = before.project.id !== "" && before.project.id === next.project.id;
    const { id, name, file } = before.project;
    const expected = opening.value > 0 || (swapped.value !== null && swapped.value.id === next.project.id);
    const nothingDone = before.history.length < 2;
    const left = { id, name: file ?? before.asset.name ?? name, file, layers: before.layers.length, changed };
    leftProjects.set(id, left);
    swapped.value = same || expected || nothingDone ? null : left;
  }
  const chosen = selectedLayer.value;
  if (chosen !== null && !next.layers.some((one) => one.id === chosen)) {
    // it was undone, deleted or merged: go on with what lies there now
    const at = before?.session === next.session ? before.layers.findIndex((one) => one.id === chosen) : Infinity;
    selectedLayer.value = next.layers[Math.min(at, next.layers.length - 1)]?.id ?? null;
  } else if (before?.session !== next.session) selectedLayer.value = next.layers.at(-1)?.id ?? null;
  const { asset } = next;
  if (before?.session === next.session) {
    if (axisName(before.asset.up) !== axisName(asset.up)) resetView(asset);
    return;
  }
  // the same asset again, as after a crash of the server: nobody moved, so the view stays
  const stays = before?.asset.sha256 === asset.sha256 && axisName(before.asset.up) === axisName(asset.up) && pose.value;
  link.enter(next.session);
  viewer.extent = asset.radius;
  viewer.setAntialiased(asset.antialiased);
  document.title = `${asset.name} – SplatPainter`;
  if (!stays) resetView(asset);
  for (const doubt of asset.doubts) toast("warning", `${asset.name}: ${doubt}`);
  if (!asset.frame_stated)
    toast(
      "info",
      `${asset.name} does not say which way is up: opened as ${asset.frame.split(",")[0]}.`,
      "Upside down? The arrows at the top turn it over; the project remembers it.",
    );
}

/** The grid under the asset and the eye before it, with its up direction up. */
function resetView(asset: AssetInfo): void {
  viewer.grid.setGround(asset.center as Vec3, asset.radius, asset.up as Vec3);
  go(homePose(asset));
}
