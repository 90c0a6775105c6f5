import { afterAll, beforeEach, describe, expect, it, vi } from "vitest";

import { FRAME_PREVIEW, FRAME_SNAPSHOT, SCHEMA_HASH } from "../src/messages";
import { Link, type Handlers } from "../src/net/connection";
import type { Frame } from "../src/net/frames";
import { makeFrame } from "./make_frame";

/** The browser's end of a connection, played by the test. */
class FakeSocket {
  static all: FakeSocket[] = [];
  readyState = 0;
  sent: Record<string, unknown>[] = [];
  onopen = () => {};
  onmessage = (_: { data: string | ArrayBuffer }) => {};
  onclose = (_: { code: number; reason: string }) => {};
  constructor() {
    FakeSocket.all.push(this);
  }
  send(text: string) {
    this.sent.push(JSON.parse(text));
  }
  close() {
    this.drop(1000);
  }
  accept() {
    this.readyState = 1;
    this.onopen();
  }
  say(message: object) {
    this.onmessage({ data: JSON.stringify(message) });
  }
  frame(flags: number, from: number, to: number) {
    this.onmessage({ data: makeFrame(flags, from, to, 4, flags & FRAME_SNAPSHOT ? [0, 1, 2, 3] : [1], 1) });
  }
  greet(session = "s", returning = true) {
    this.say({ re: this.sent[0].id, ok: true, python: "", returning, state: { session } });
  }
  drop(code = 1006, reason = "") {
    this.readyState = 3;
    this.onclose({ code, reason });
  }
}

let shown: Frame[];
let fits: boolean;
let statuses: string[];
let handlers: Handlers;
const last = () => FakeSocket.all.at(-1)!;
const asked = () => last().sent.map((message) => message.do);

afterAll(() => {
  vi.useRealTimers();
});

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal("WebSocket", { OPEN: 1 });
  FakeSocket.all = [];
  shown = [];
  statuses = [];
  fits = true;
  handlers = {
    status: (status) => void statuses.push(status),
    greeted: () => {},
    event: () => {},
    answered: () => {},
    frame: (frame) => (fits || frame.snapshot ? (shown.push(frame), true) : false),
  };
});

function connected(): Link {
  const link = new Link("ws://x/ws", handlers, () => new FakeSocket() as unknown as WebSocket);
  link.connect();
  last().accept();
  last().frame(FRAME_SNAPSHOT, 0, 7);
  last().greet();
  return link;
}

describe("link", () => {
  it("greets with the schema's hash and gives answers to who asked", async () => {
    const link = connected();
    expect(last().sent[0]).toMatchObject({ do: "hello", schema_hash: SCHEMA_HASH, session: null, since: null });
    const steps: number[] = [];
    const first = link.do("undo", {}, (progress) => steps.push(progress));
    const second = link.do("redo", {});
    last().say({ re: first.id, progress: 0.5, stage: "x" });
    last().say({ re: second.id, ok: false, error: { kind: "input", message: "nothing to redo", hint: "paint" } });
    last().say({ re: first.id, ok: true, version: 8, python: "" });
    await expect(first).resolves.toMatchObject({ version: 8 });
    await expect(second).rejects.toMatchObject({ kind: "input", message: "nothing to redo", hint: "paint" });
    expect(steps).toEqual([0.5]);
  });

  it("applies deltas that follow and asks again at a gap", () => {
    connected();
    last().frame(0, 7, 8);
    expect(shown.map((frame) => frame.to)).toEqual([7, 8]);
    last().frame(0, 9, 10);
    expect(shown.length).toBe(2);
    expect(last().sent.at(-1)).toMatchObject({ do: "sync", since: 8 });
    last().frame(0, 10, 11); // still waiting: not asked twice
    expect(asked().filter((name) => name === "sync").length).toBe(1);
    last().frame(0, 8, 11);
    expect(shown.at(-1)!.to).toBe(11);
  });

  it("shows previews whatever the version, and hears a delta only once", () => {
    connected();
    last().frame(FRAME_PREVIEW, 3, 3);
    last().frame(0, 7, 8);
    last().frame(0, 7, 8);
    expect(shown.map((frame) => [frame.preview, frame.to])).toEqual([
      [false, 7],
      [true, 3],
      [false, 8],
    ]);
    expect(asked()).toEqual(["hello"]);
  });

  it("asks for a snapshot when the table is full", () => {
    connected();
    fits = false;
    last().frame(0, 7, 8);
    expect(last().sent.at(-1)).toMatchObject({ do: "sync", since: null });
  });

  it("comes back with what it has, after longer and longer waits", () => {
    connected();
    for (const wait of [250, 500, 1000]) {
      last().drop();
      expect(statuses.at(-1)).toBe("lost");
      vi.advanceTimersByTime(wait - 1);
      expect(statuses.at(-1)).toBe("lost");
      vi.advanceTimersByTime(1);
      expect(statuses.at(-1)).toBe("connecting");
    }
    last().accept();
    expect(last().sent[0]).toMatchObject({ do: "hello", session: "s", since: 7 });
    last().frame(0, 7, 9);
    last().greet();
    expect(statuses.at(-1)).toBe("open");
    expect(shown.at(-1)!.to).toBe(9);
  });

  it("sends what was not answered again, under its number and before what waited", async () => {
    const link = connected();
    const page = last().sent[0].page;
    expect(page).toMatch(/^[0-9a-f]{32}$/);
    const done = link.do("receipt", {});
    last().say({ re: done.id, ok: true, python: "" });
    const under = link.do("undo", {});
    last().drop();
    const waiting = link.do("redo", {});
    vi.advanceTimersByTime(250);
    last().accept();
    expect(asked()).toEqual(["hello"]);
    last().greet();
    expect(asked()).toEqual(["hello", "undo", "redo"]);
    expect(
      last()
        .sent.map((message) => message.id)
        .slice(1),
    ).toEqual([under.id, waiting.id]);
    expect(last().sent[0].page).toBe(page);
    last().say({ re: under.id, ok: true, python: "" });
    last().say({ re: waiting.id, ok: true, python: "" });
    await expect(under).resolves.toBeTruthy();
    await expect(waiting).resolves.toBeTruthy();
    last().drop();
    vi.advanceTimersByTime(250);
    last().accept();
    last().greet();
    expect(asked()).toEqual(["hello"]);
  });

  it("gives up what was under way where the server was started anew, and sends what waited", async () => {
    const link = connected();
    const under = link.do("undo", {});
    last().drop();
    const waiting = link.do("redo", {});
    vi.advanceTimersByTime(250);
    last().accept();
    last().greet("s", false);
    await expect(under).rejects.toMatchObject({ kind: "lost" });
    expect(asked()).toEqual(["hello", "redo"]);
    last().say({ re: waiting.id, ok: true, python: "" });
    await expect(waiting).resolves.toBeTruthy();
  });

  it("sends nothing that was meant for another project", async () => {
    const link = connected();
    last().drop();
    const waiting = link.do("redo", {});
    vi.advanceTimersByTime(250);
    last().accept();
    last().greet("t", false);
    await expect(waiting).rejects.toMatchObject({ kind: "lost" });
    expect(asked()).toEqual(["hello"]);
  });

  it("forgets its Gaussians when another asset is opened", () => {
    const link = connected();
    link.enter("s");
    expect(asked()).toEqual(["hello"]);
    link.enter("t");
    expect(last().sent.at(-1)).toMatchObject({ do: "sync", since: null });
  });

  it("does not ask for those of another asset that have come already", () => {
    const link = connected();
    last().frame(FRAME_SNAPSHOT, 0, 3);
    link.enter("t");
    expect(asked()).toEqual(["hello"]);
    link.enter("u");
    expect(asked()).toEqual(["hello", "sync"]);
  });

  it("says when nothing was heard for 20 seconds while an answer is due, and when something is again", async () => {
    const said: boolean[] = [];
    handlers.silent = (is) => void said.push(is);
    const link = connected();
    vi.advanceTimersByTime(60_000); // nothing is due
    const done = link.do("undo", {}, () => {});
    vi.advanceTimersByTime(19_000);
    last().say({ re: done.id, progress: 0.5, stage: "x" });
    vi.advanceTimersByTime(19_999);
    expect(said).toEqual([]);
    vi.advanceTimersByTime(1);
    expect(said).toEqual([true]);
    last().say({ re: done.id, ok: true, version: 7, python: "" });
    await done;
    expect(said).toEqual([true, false]);
    vi.advanceTimersByTime(60_000);
    link.do("redo", {}).catch(() => {});
    last().drop(); // that is said otherwise
    vi.advanceTimersByTime(60_000);
    expect(said).toEqual([true, false]);
  });

  it("stops when the server is of another version or refuses it", () => {
    const link = new Link("ws://x/ws", handlers, () => new FakeSocket() as unknown as WebSocket);
    link.connect();
    last().accept();
    last().say({ re: last().sent[0].id, ok: false, error: { kind: "schema", message: "old page", hint: "reload" } });
    return Promise.resolve().then(async () => {
      await vi.advanceTimersByTimeAsync(60_000);
      expect(statuses.at(-1)).toBe("stopped");
      expect(FakeSocket.all.length).toBe(1);
    });
  });
});
