"""The studio's server as a process of its own, and a client of it as a browser page is one: a socket, a mirror of
the Gaussians put together from frames alone, and pictures over HTTP. For the studio's bench and its tests."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect

from splatbench.process import server
from splatpainter.cameras import Camera
from splatpainter.server import frames
from splatpainter.server.client import protocol_hash
from splatpainter.splats import Splats
from splatpainter.system.user_folders import PROJECTS_VARIABLE

ANSWER_PATIENCE_SECONDS = 120
GEOMETRY = ("means", "scales", "quats")
COLUMNS = (*GEOMETRY, "opacities", "sh")


def wire(camera: Camera) -> dict[str, Any]:
    """A camera as clients send it."""
    return camera.record()


def encoded(rgba: np.ndarray) -> str:
    """[H, W, 4] uint8 as `paint.dab` wants it."""
    return base64.b64encode(rgba.tobytes()).decode()


@dataclass
class Mirror:
    """What a browser holds: Gaussians put together from frames alone."""

    session: str = ""
    version: int = -1
    total: int = 0
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    previews: int = 0
    """Frames of previews so far."""

    def take(self, data: bytes) -> None:
        """Apply a frame. Raises RuntimeError where versions have a gap."""
        frame = frames.unpack(data)
        values = {name: getattr(frame.splats, name) for name in COLUMNS}
        if frame.flags & frames.SNAPSHOT:
            self.columns = {name: value.copy() for name, value in values.items()}
        elif frame.version_from != self.version:
            raise RuntimeError(f"studio: gap in versions: has {self.version}, got some from {frame.version_from} on")
        else:
            if frame.flags & frames.PACKED:
                values = {"sh": values["sh"]}
            for name, value in values.items():
                if frame.flags & frames.COLORS_ONLY and name in GEOMETRY:
                    continue
                old = self.columns[name][: frame.total]
                if len(old) < frame.total:
                    more = np.zeros((frame.total - len(old), *old.shape[1:]), np.float32)
                    old = np.concatenate([old, more])
                if name == "sh":
                    old[frame.gaussian_ids, : value.shape[1]] = value  # of a preview maybe the first coefficient alone
                else:
                    old[frame.gaussian_ids] = value
                self.columns[name] = old
        self.previews += bool(frame.flags & frames.PREVIEW)
        self.version, self.total = frame.version_to, frame.total

    def agrees(self, splats: Splats) -> bool:
        """Whether every Gaussian is what the session shows, bit for bit (rotations: up to their length)."""
        unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
        same = [np.array_equal(self.columns[k], getattr(splats, k)) for k in COLUMNS if k != "quats"]
        return self.total == len(splats) and all(same) and np.allclose(self.columns["quats"], unit, atol=1e-6)


class Browser:
    """A client over a socket, one command at a time."""

    def __init__(self, socket: ClientConnection, mirror: Mirror | None = None) -> None:
        self.socket, self.mirror = socket, mirror or Mirror()
        self.number, self.events = 0, []
        self.state: dict[str, Any] = {}
        """What the studio said of itself last, as GET /api/state says it."""
        self.order: list[str] = []
        """What came since the last `ask`: "frame", "event", "progress" or "answer"."""
        self.received = 0
        """Bytes of the frames since the last `ask`."""

    def send(self, name: str, /, **fields: Any) -> int:
        """Send a command without waiting; returns its id."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "do": name, **fields}))
        return self.number

    def receive(self) -> dict[str, Any] | None:
        """One message: None for a frame, which the mirror takes."""
        message = self.socket.recv(timeout=ANSWER_PATIENCE_SECONDS)
        if isinstance(message, bytes):
            self.mirror.take(message)
            self.order.append("frame")
            self.received += len(message)
            return None
        data = json.loads(message)
        if data.get("event") == "state":
            self.state = after(self.state, data)
        elif "event" in data:
            self.events = [*self.events[-99:], data]
        self.order.append("event" if "event" in data else "progress" if "progress" in data else "answer")
        return data

    def answer(self, number: int) -> dict[str, Any]:
        """Read until the answer of a command; the Gaussians that it is about come before it."""
        while True:
            data = self.receive()
            if data is not None and data.get("re") == number and "progress" not in data:
                return data

    def ask(self, name: str, /, **fields: Any) -> dict[str, Any]:
        """Send a command and return its answer, good or bad."""
        self.order.clear()
        self.received = 0
        return self.answer(self.send(name, **fields))

    def do(self, name: str, /, **fields: Any) -> dict[str, Any]:
        """Send a command that must work. Raises RuntimeError where it does not."""
        data = self.ask(name, **fields)
        if not data["ok"]:
            raise RuntimeError(f"studio: {name}: {data['error']['message']}")
        return data

    def hello(self, page: str | None = None) -> dict[str, Any]:
        """Greet as a page does, going on where the mirror stopped. page: the name that it had before."""
        since = None if self.mirror.version < 0 else self.mirror.version
        fields = {"schema_hash": protocol_hash(), "session": self.mirror.session or None, "since": since, "page": page}
        data = self.do("hello", **fields)
        self.state = data["state"]
        self.mirror.session = self.state["session"]
        return data


def after(state: dict[str, Any], event: dict[str, Any]) -> dict[str, Any]:
    """The state after a state event."""
    history, bookmarks = state["history"], state["bookmarks"]
    if (change := event["history"]) is not None:
        start = change["dropped"]
        history = history[start : start + change["kept"]] + change["steps"]
    return {
        **event["state"],
        "history": history,
        "bookmarks": bookmarks if event["bookmarks"] is None else event["bookmarks"],
    }


@contextlib.contextmanager
def browsing(url: str, mirror: Mirror | None = None) -> Iterator[Browser]:
    """A new connection to a studio at "http://...", not greeted yet."""
    address = url.rstrip("/").replace("http://", "ws://") + "/ws"
    with connect(address, max_size=None, compression=None) as socket:
        yield Browser(socket, mirror)


@dataclass
class Server:
    """A studio in a process of its own."""

    url: str
    process: subprocess.Popen
    started: float
    """time.perf_counter() of the process's start."""

    def get(self, path: str) -> bytes:
        """Body of GET url + path, by no proxy."""
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(self.url + path, timeout=ANSWER_PATIENCE_SECONDS) as response:
            return response.read()

    def memory(self) -> tuple[float, float]:
        """(resident now, largest so far), MiB; NaN where the system does not tell."""
        sizes = {}
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/{self.process.pid}/status").read_text(encoding="utf-8").splitlines():
                name, _, value = line.partition(":")
                if name in ("VmRSS", "VmHWM"):
                    sizes[name] = int(value.split()[0]) / 1024
        return sizes.get("VmRSS", math.nan), sizes.get("VmHWM", math.nan)


@contextlib.contextmanager
def serving(asset: Path | None, folder: Path, variables: Mapping[str, str] | None = None) -> Iterator[Server]:
    """`splatpainter studio ASSET --no-browser` on a free port, its projects in `folder`; interrupted in the end.
    asset None: the demo. variables: of the environment, besides the present ones. Raises RuntimeError where it does
    not start."""
    command = [sys.executable, "-m", "splatpainter", "studio", *([] if asset is None else [str(asset)])]
    command += ["--no-browser", "--port", "0"]
    environment = {PROJECTS_VARIABLE: str(folder / "projects"), **(variables or {})}
    start = time.perf_counter()
    with contextlib.ExitStack() as stack:
        try:
            process, address = stack.enter_context(server(command, r"http://\S+/", environment))
        except RuntimeError as error:
            raise RuntimeError(f"bench: the studio did not start: {error}") from None
        yield Server(address.group(), process, start)
