"""Writers that are killed: run as a program, prints one JSON line. Forks, so that a writer costs milliseconds.

Each round forks a writer that opens the project (the first one makes it), runs random commands, and after each one
tells its parent through a pipe what it has acknowledged: how many steps there are, where the cursor is, and the hash of
the shown rows. The parent kills it (SIGKILL) at a random moment, opens the project itself, and compares. "journal" as
the last argument: as on disks where maps cannot be shared.
"""

from __future__ import annotations

import gc
import json
import os
import random
import signal
import sys
import time
from pathlib import Path
from typing import Any

from splatpainter.session import Session
from splatpainter.session.project import database
from tests.support.session_scenes import RED, FlatPainter, asset, dab, flat, print_of


def write_forever(path: Path, pipe: int, seed: int) -> None:
    """The writer: it ends only by being killed."""
    rng = random.Random(seed)
    painter: Any = FlatPainter()
    session = Session.load(path, painter=painter, readonly=False) if path.exists() else flat(asset(8), path)
    while True:
        choice = rng.random()
        if choice < 0.5 or not session.layers:
            session.layers.add("paint", [dab(RED, rng.uniform(6, 26), rng.uniform(6, 26), 6)])
        elif choice < 0.75:
            session.layers.set(rng.choice(session.layers).id, opacity=rng.random())
        elif choice < 0.85:
            session.layers.delete(rng.choice(session.layers).id)
        else:
            session.undo()
        os.write(pipe, (json.dumps(position(session)) + "\n").encode())  # shorter than PIPE_BUF: whole or not at all


def killed_writer(path: Path, seed: int, lines: int, wait: float) -> list[dict[str, Any]]:
    """What a writer acknowledged until it was killed, `wait` seconds after its start or its `lines`-th word."""
    if sys.platform == "win32":
        raise RuntimeError("Windows cannot fork")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            write_forever(path, writing, seed)
        finally:
            os._exit(1)
    os.close(writing)
    data = b""
    while data.count(b"\n") < lines and (piece := os.read(reading, 65536)):
        data += piece
    time.sleep(wait)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while piece := os.read(reading, 65536):
        data += piece
    os.close(reading)
    if not os.WIFSIGNALED(status):
        raise RuntimeError(f"writer {seed} failed by itself")
    return [json.loads(line) for line in data.decode().splitlines()]


def main(folder: Path, rounds: int, seed: int) -> dict[str, Any]:
    """Counts over all rounds, and the first thing that went wrong."""
    with flat(asset(8)) as session:  # what is imported here need not be imported by each writer
        session.layers.add("paint", [dab(RED, radius=6)])
        session.layers.set(session.layers[0].id, opacity=0.5)
        session.layers.delete(session.layers[0].id)
        session.undo()
    gc.freeze()  # nor need its garbage collector walk through it, which copies every page of it
    rng = random.Random(seed)
    out: dict[str, Any] = {"kills": 0, "acknowledged": 0, "silent": 0, "ahead": 0, "unmade": 0, "wrong": None}

    def kill(path: Path, lines: int, longest: float) -> dict[str, Any] | None:
        """The last thing that a writer said."""
        report = killed_writer(path, seed + out["kills"], lines, rng.uniform(0, longest))
        out["kills"] += 1
        out["acknowledged"] += len(report)
        out["silent"] += not report
        return report[-1] if report else None

    for k in range(rounds // 5):  # while the project is made
        path = folder / f"new{k % 3}.splatproj"
        report = kill(path, 0, 0.05)
        if path.exists():
            judge(path, report, out)
            path.unlink()
        elif report is not None:
            out["wrong"] = out["wrong"] or {"told": report, "found": "no project"}
        else:
            out["unmade"] += 1
    path = folder / "killed.splatproj"
    flat(asset(8), path).close()
    last = judge(path, None, out)
    for _ in range(rounds - rounds // 5):
        last = judge(path, kill(path, rng.randrange(4), 0.015) or last, out)
    left = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith((".new", "new")))
    return {**out, "files": left, "problems": verified(path)}


def judge(path: Path, report: dict[str, Any] | None, out: dict[str, Any]) -> dict[str, Any]:
    """Open a project as a killed writer left it, compare it with what was acknowledged last, and say where it is."""
    painter: Any = FlatPainter()
    with Session.load(path, painter=painter, readonly=False) as session:
        now = position(session)
        if report is not None and now != report:
            # One more command may be on disk, of which nothing could be said any more: an undo, or a new step.
            out["ahead"] += 1
            if now["cursor"] > report["cursor"]:
                session.undo()
                right = print_of(session) == report["rows"] and session.history.cursor == report["cursor"]
                session.redo()
            else:
                session.redo()
                right = position(session) == report
                session.undo()
            if not right:
                out["wrong"] = out["wrong"] or {"told": report, "found": now}
        if painter.calls:  # results are as durable as layers
            out["wrong"] = out["wrong"] or {"painted again": len(painter.calls)}
        if len(session.history) > 6:
            session.history.jump(0)  # the next new step drops the rest: keep the rounds short
        return position(session)


def position(session: Session) -> dict[str, Any]:
    return {"steps": len(session.history), "cursor": session.history.cursor, "rows": print_of(session)}


def verified(path: Path) -> list[str]:
    """What is wrong with the file in the end, everything computed anew."""
    painter: Any = FlatPainter()
    with Session.load(path, painter=painter) as session:
        return session.verify(repaint=True)


if __name__ == "__main__":
    if sys.argv[4:] == ["journal"]:
        writable = database._writable
        database._writable = lambda path, shares_maps: writable(path, False)
    print(json.dumps(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
