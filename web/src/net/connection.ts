/**
 * The connection to the server: commands with answers, progress and cancel; binary frames in order; coming back after
 * a loss. Knows no user interface. What was acknowledged is in the server's project file. A command without an answer
 * is sent again under its number after a loss, and the server does it once. Only where the server itself was started
 * anew, and so cannot know, such a command fails with kind "lost": the state that follows says whether it took effect.
 */

import {
  SCHEMA_HASH,
  type Answer,
  type Commands,
  type Event,
  type Failure,
  type Greeting,
  type Problem,
  type CommandProgress,
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
  /** What is sent again after a loss; null: it ends with this connection. */
  text: string | null;
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
  /** Returns false when the Gaussians must be sent again. */
  frame: (frame: Frame) => boolean;
  /** Commands were sent, and nothing has been heard for 20 seconds; or something has, again. */
  silent?: (is: boolean) => void;
}

export interface Running<A> extends Promise<A> {
  id: number;
  cancel: () => void;
}

const FIRST_WAIT_MS = 250;
const MAX_WAIT_MS = 8000;
/** So long without a word, while an answer is due, is said; tests do not wait for it. */
export const limits = { silentMs: 20_000 };

export class Link {
  private socket: WebSocket | null = null;
  /** By their numbers, which ascend: a Map keeps that order. */
  private pending = new Map<number, Pending>();
  /** Numbers of those that were sent, over this connection or one before. */
  private sent = new Set<number>();
  private readonly page = randomName();
  private nextId = 1;
  private wait = FIRST_WAIT_MS;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private session: string | null = null;
  private version: number | null = null;
  private syncing = false;
  private greeted = false;
  /** A snapshot has come since the greeting, or since the session was entered. */
  private renewed = false;
  private listening: ReturnType<typeof setTimeout> | undefined;
  private isSilent = false;

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
    const session = this.session ?? undefined; // that is on the screen: what it means is refused where another is open
    const text = JSON.stringify({ id, do: name, session, ...fields });
    const promise = new Promise<Answer>((resolve, reject) => {
      this.pending.set(id, { text, resolve, reject, onProgress });
    }) as Running<Result<N>>;
    this.transmit();
    promise.id = id;
    promise.cancel = () => void this.do("cancel", { of: id }).catch(() => {});
    return promise;
  }

  /** Another asset was opened (by whomever): all its Gaussians must come, unless they came just before the word of it. */
  enter(session: string): void {
    if (session === this.session) return;
    this.session = session;
    const came = this.renewed;
    this.renewed = false;
    if (came) return;
    this.version = null;
    this.sync();
  }

  /** The version of the asset whose Gaussians have come. */
  get received(): number | null {
    return this.version;
  }

  /** Drop the connection as a bad network would; it comes back by itself. For tests. */
  lose(): void {
    this.socket?.close();
  }

  private hello(socket: WebSocket): void {
    const id = this.nextId++;
    this.pending.set(id, {
      text: null,
      resolve: (answer) => {
        const greeting = answer as Greeting;
        this.wait = FIRST_WAIT_MS;
        this.greeted = true;
        this.renewed = false;
        const swapped = this.session !== null && this.session !== greeting.state.session;
        this.session = greeting.state.session;
        if (!greeting.returning) this.fail((number) => this.sent.has(number));
        if (swapped) this.fail((number) => !this.sent.has(number)); // they were meant for another project
        this.sent.clear();
        this.handlers.status("open", "");
        this.handlers.greeted(greeting);
        this.transmit();
      },
      reject: (error) => {
        if (error.kind !== "lost") this.stop(`${error.message} ${error.hint}`.trim());
      },
    });
    socket.send(
      JSON.stringify({
        id,
        do: "hello",
        schema_hash: SCHEMA_HASH,
        session: this.session,
        since: this.version,
        page: this.page,
      }),
    );
  }

  /** Send what has not been sent over this connection, if there is one. */
  private transmit(): void {
    if (!this.greeted || this.socket?.readyState !== WebSocket.OPEN) return;
    for (const [id, { text }] of this.pending) {
      if (text === null || this.sent.has(id)) continue;
      this.sent.add(id);
      this.socket.send(text);
      this.listening ??= setTimeout(() => this.setSilent(true), limits.silentMs);
    }
  }

  /** Something was heard, or nobody is there any more. */
  private heard(): void {
    clearTimeout(this.listening);
    this.listening = undefined;
    this.setSilent(false);
    if (this.sent.size > 0 && this.greeted) this.listening = setTimeout(() => this.setSilent(true), limits.silentMs);
  }

  private setSilent(is: boolean): void {
    if (is === this.isSilent) return;
    this.isSilent = is;
    this.handlers.silent?.(is);
  }

  /** Give up commands: whether they took effect is not known. */
  private fail(which: (number: number) => boolean): void {
    for (const [id, pending] of [...this.pending]) {
      if (!which(id)) continue;
      this.pending.delete(id);
      this.sent.delete(id);
      pending.reject(
        new CommandError(
          "lost",
          "The connection was lost before the answer came.",
          "Look at the layers: what is listed there was saved.",
        ),
      );
    }
  }

  private receive(data: string | ArrayBuffer): void {
    if (typeof data !== "string") {
      this.apply(parseFrame(data));
      return this.heard();
    }
    this.take(data);
    this.heard();
  }

  private take(data: string): void {
    const message = JSON.parse(data) as Answer | Failure | CommandProgress | Event;
    if ("event" in message) return this.handlers.event(message);
    const pending = this.pending.get(message.re);
    if (!pending) return;
    if ("progress" in message) return pending.onProgress?.(message.progress, message.stage);
    this.pending.delete(message.re);
    this.sent.delete(message.re);
    if (message.ok) {
      this.handlers.answered(message);
      pending.resolve(message);
    } else pending.reject(new CommandError(message.error.kind, message.error.message, message.error.hint));
  }

  private apply(frame: Frame): void {
    if (frame.preview) return void this.handlers.frame(frame);
    if (!frame.snapshot && frame.to === this.version) return; // received already, e.g. in answer to `sync`
    const fits = frame.snapshot || frame.from === this.version;
    if (fits && this.handlers.frame(frame)) {
      this.version = frame.to;
      this.syncing = false;
      this.renewed ||= frame.snapshot;
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
    this.heard();
    this.fail((id) => this.pending.get(id)!.text === null);
    if (code === 1008) return this.stop(reason || "The server refused this page.");
    this.handlers.status("lost", "");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.connect(), this.wait);
    this.wait = Math.min(this.wait * 2, MAX_WAIT_MS);
  }

  private stop(reason: string): void {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    clearTimeout(this.timer);
    this.handlers.status("stopped", reason);
    this.fail(() => true);
  }
}

/** 32 random hex digits. */
function randomName(): string {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
