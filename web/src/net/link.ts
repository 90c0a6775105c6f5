/**
 * The connection to the server: commands with answers, progress and cancel; binary frames in order; coming back after
 * a loss. Knows no user interface. What was acknowledged is in the server's project file, so nothing is repeated here:
 * a command whose answer was lost fails with kind "lost", and the state that follows says whether it took effect.
 */

import {
  SCHEMA_HASH,
  type Answer,
  type Commands,
  type Event,
  type Failure,
  type Greeting,
  type Problem,
  type Progress,
} from "../messages";
import { parseFrame, type Frame } from "./frames";

export type Status = "connecting" | "open" | "lost" | "stopped";
export type Name = keyof Commands;
export type Fields<N extends Name> = Commands[N][0];
export type Result<N extends Name> = Commands[N][1] & Answer;

export class CommandError extends Error {
  constructor(
    readonly kind: Problem["kind"] | "lost",
    message: string,
    readonly hint = "",
  ) {
    super(message);
  }
}

interface Pending {
  resolve: (answer: Answer) => void;
  reject: (error: CommandError) => void;
  onProgress?: (progress: number, stage: string) => void;
}

export interface Handlers {
  status: (status: Status, reason: string) => void;
  greeted: (greeting: Greeting) => void;
  event: (event: Event) => void;
  /** Every answer of a command that worked. */
  answered: (answer: Answer) => void;
  /** Returns false when the rows must be sent again. */
  frame: (frame: Frame) => boolean;
}

export interface Running<A> extends Promise<A> {
  id: number;
  cancel: () => void;
}

const FIRST_WAIT = 250;
const LONGEST_WAIT = 8000;

export class Link {
  private socket: WebSocket | null = null;
  private pending = new Map<number, Pending>();
  private queued: string[] = [];
  private nextId = 1;
  private wait = FIRST_WAIT;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private session: string | null = null;
  private version: number | null = null;
  private syncing = false;
  private greeted = false;

  constructor(
    private readonly url: string,
    private readonly handlers: Handlers,
    private readonly open: (url: string) => WebSocket = (address) => new WebSocket(address),
  ) {}

  connect(): void {
    this.handlers.status("connecting", "");
    const socket = this.open(this.url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.hello(socket);
    socket.onmessage = (message) => this.receive(message.data);
    socket.onclose = (event) => this.closed(socket, event.code, event.reason);
    this.socket = socket;
  }

  /** Send a command. While the connection is away it waits for the next one. Rejects with a CommandError. */
  do<N extends Name>(name: N, fields: Fields<N>, onProgress?: Pending["onProgress"]): Running<Result<N>> {
    const id = this.nextId++;
    const promise = new Promise<Answer>((resolve, reject) => {
      this.pending.set(id, { resolve, reject, onProgress });
    }) as Running<Result<N>>;
    const text = JSON.stringify({ id, do: name, ...fields });
    if (this.greeted && this.socket?.readyState === WebSocket.OPEN) this.socket.send(text);
    else this.queued.push(text);
    promise.id = id;
    promise.cancel = () => void this.do("cancel", { of: id }).catch(() => {});
    return promise;
  }

  /** Another asset was opened (by whomever): its rows must come whole. */
  enter(session: string): void {
    if (session === this.session) return;
    this.session = session;
    this.version = null;
    this.sync();
  }

  /** Drop the connection as a bad network would; it comes back by itself. For tests. */
  lose(): void {
    this.socket?.close();
  }

  private hello(socket: WebSocket): void {
    const id = this.nextId++;
    this.pending.set(id, {
      resolve: (answer) => {
        const greeting = answer as Greeting;
        this.wait = FIRST_WAIT;
        this.greeted = true;
        this.session = greeting.state.session;
        this.handlers.status("open", "");
        this.handlers.greeted(greeting);
        for (const text of this.queued.splice(0)) socket.send(text);
      },
      reject: (error) => {
        if (error.kind !== "lost") this.stop(`${error.message} ${error.hint}`.trim());
      },
    });
    socket.send(
      JSON.stringify({ id, do: "hello", schema_hash: SCHEMA_HASH, session: this.session, since: this.version }),
    );
  }

  private receive(data: string | ArrayBuffer): void {
    if (typeof data !== "string") return this.rows(parseFrame(data));
    const message = JSON.parse(data) as Answer | Failure | Progress | Event;
    if ("event" in message) return this.handlers.event(message);
    const pending = this.pending.get(message.re);
    if (!pending) return;
    if ("progress" in message) return pending.onProgress?.(message.progress, message.stage);
    this.pending.delete(message.re);
    if (message.ok) {
      this.handlers.answered(message);
      pending.resolve(message);
    } else pending.reject(new CommandError(message.error.kind, message.error.message, message.error.hint));
  }

  private rows(frame: Frame): void {
    if (frame.preview) return void this.handlers.frame(frame);
    if (!frame.snapshot && frame.to === this.version) return; // heard already, e.g. in answer to `sync`
    const fits = frame.snapshot || frame.from === this.version;
    if (fits && this.handlers.frame(frame)) {
      this.version = frame.to;
      this.syncing = false;
    } else {
      if (fits) this.version = null; // the table must be made anew: ask for everything
      this.sync();
    }
  }

  private sync(): void {
    if (this.syncing) return;
    this.syncing = true;
    this.do("sync", { since: this.version })
      .catch(() => {})
      .finally(() => (this.syncing = false));
  }

  private closed(socket: WebSocket, code: number, reason: string): void {
    if (socket !== this.socket) return;
    this.socket = null;
    this.greeted = this.syncing = false;
    const waiting = new Set(this.queued.map((text) => (JSON.parse(text) as { id: number }).id));
    for (const [id, pending] of this.pending) {
      if (waiting.has(id)) continue;
      this.pending.delete(id);
      pending.reject(
        new CommandError(
          "lost",
          "The connection was lost before the answer came.",
          "Look at the layers: what is listed there was kept.",
        ),
      );
    }
    if (code === 1008) return this.stop(reason || "The server refused this page.");
    this.handlers.status("lost", "");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.connect(), this.wait);
    this.wait = Math.min(this.wait * 2, LONGEST_WAIT);
  }

  private stop(reason: string): void {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    clearTimeout(this.timer);
    this.handlers.status("stopped", reason);
  }
}
