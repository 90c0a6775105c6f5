/** The editor of this page: it owns the view, the link to the server, and the strokes under way. */

import { effect } from "@preact/signals";

import { WRITING, type Event } from "../messages";
import { CommandError, Link, type Fields, type Name, type Result } from "../net/connection";
import { StrokeQueue } from "../paint/stroke-queue";
import { ViewPixels } from "../paint/view-pixels";
import { applyBatch, learnBatch } from "../state/batch";
import { watchGraphics } from "../state/graphics";
import { noteStorage } from "../state/storage";
import {
  camera,
  drawn,
  jobs,
  opening,
  pythonLog,
  refusal,
  saving,
  silent,
  state,
  status,
  stopped,
  toast,
  view,
  working,
  type Job,
} from "../state/store";
import type { Vec3 } from "../view/camera";
import { Viewer } from "../view/viewer";
import { adoptState, askAboutWaiting, withHistory } from "./project-state";

/** A command that takes longer than this is shown with its progress. */
const JOB_DELAY_MS = 400;
/** Commands of this page that open another project. */
const OPENING: readonly Name[] = ["asset.open", "project.open"];

interface Parts {
  viewer: Viewer;
  link: Link;
  pixels: ViewPixels;
  strokes: StrokeQueue;
}

export class Editor {
  private parts: Partial<Parts> = {};
  /** A picture was saved into the folder that the studio watches. */
  onPicture: (blob: string, name: string) => void = () => {};

  /** Draws the asset. */
  get viewer(): Viewer {
    return this.part("viewer");
  }

  /** The socket to the server. */
  get link(): Link {
    return this.part("link");
  }

  /** What the view shows, as pixels. */
  get pixels(): ViewPixels {
    return this.part("pixels");
  }

  /** Strokes from pen-down until their Gaussians are on the screen. */
  get strokes(): StrokeQueue {
    return this.part("strokes");
  }

  private part<Key extends keyof Parts>(key: Key): Parts[Key] {
    const part = this.parts[key];
    if (!part) throw new Error(`the editor was not started: it has no ${key} yet`);
    return part;
  }

  /** Draw on this canvas, and connect. Before the interface is mounted. */
  start(canvas: HTMLCanvasElement): void {
    const viewer = (this.parts.viewer = new Viewer(canvas));
    viewer.onProgress = (progress) => (drawn.value = { ...progress, version: this.parts.link?.received ?? -1 });
    watchGraphics(canvas);
    const link = (this.parts.link = this.makeLink(viewer));
    this.parts.pixels = new ViewPixels(viewer, run);
    this.parts.strokes = new StrokeQueue({ viewer, link, pixels: this.parts.pixels, track, report });
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
    effect(askAboutWaiting); // whoever opened the other project
    link.connect();
  }

  private makeLink(viewer: Viewer): Link {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    return new Link(`${scheme}://${location.host}/ws`, {
      status: (next, reason) => {
        status.value = next;
        stopped.value = reason;
      },
      greeted: (greeting) => {
        const first = state.value === null;
        adoptState(this, greeting.state);
        if (first) void this.strokes.restore();
        learnBatch(() => this.link.do("batch.status", {})).catch(report);
      },
      event: (message) => this.event(message),
      answered: ({ python }) => {
        if (python) pythonLog.value = [...pythonLog.value, python].slice(-500);
      },
      frame: (frame) => viewer.apply(frame),
      silent: (is) => (silent.value = is),
    });
  }

  private event(message: Event): void {
    if (message.event === "state") adoptState(this, withHistory(message));
    else if (message.event === "batch") applyBatch(message);
    else if (message.event === "toast") toast(message.level, message.message, message.hint);
    else this.onPicture(message.picture, message.name);
  }
}

export const editor = new Editor();

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
  let job: Job = { id: 0, label, progress: 0, stage: "", cancel: () => running.cancel() };
  const running = editor.link.do(name, fields, (progress, stage) => {
    job = { ...job, progress, stage }; // what is said before it is shown counts as well
    jobs.value = jobs.value.map((other) => (other.id === job.id ? job : other));
  });
  job.id = running.id;
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
