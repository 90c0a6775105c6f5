"""Tiny assets, studios and clients for the tests of the studio."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from splatbench import studio_client
from splatbench.studio_client import Mirror, encoded, wire
from websockets.sync.client import connect

from splatpainter.cameras import Camera, look_at
from splatpainter.server.launch import listen, make_server
from splatpainter.server.security import Access
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.server.uploads.storage import UploadLimits
from splatpainter.session import Session
from splatpainter.splats import Splats


def ball(count: int = 600, seed: int = 0) -> Splats:
    """A ball of radius 1 of overlapping Gaussians in random colours, SH degree 1."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    quats = rng.normal(size=(count, 4))
    sh = rng.uniform(-0.5, 0.5, (count, 4, 3)) * np.array([1, 0.1, 0.1, 0.1])[:, None]
    scales = np.full((count, 3), 1.8 / np.sqrt(count))
    means, quats, scales, sh = (array.astype(np.float32) for array in (points, quats, scales, sh))
    return Splats(means, quats, scales, np.full(count, 0.95, np.float32), sh)


def view(size: int = 96, angle: float = 0.0) -> Camera:
    """A view of the ball from `angle` degrees around it."""
    turn = np.radians(angle)
    return look_at(
        (3.2 * np.sin(turn), 0.3, -3.2 * np.cos(turn)), (0, 0, 0), (0, -1, 0), width=size, height=size, fov=45
    )


def make_studio(
    folder: Path, splats: Splats | None = None, *, shared: Path | None = None, limits: UploadLimits | None = None
) -> Studio:
    """A studio whose projects lie in `folder`; shared: the folder that clients may name files of."""
    options = StudioOptions(shared, folder / "projects", limits or UploadLimits())
    session = Session(ball() if splats is None else splats, folder / "own.splatproj")
    return Studio(session, "ball", options)


def fill_disk(session: Session) -> None:
    """From now on SQLite finds no room for more in the session's project file."""
    connection = session._core.project._db
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages}").fetchall()


@dataclass
class Live:
    """A studio that is being served."""

    studio: Studio
    url: str
    http: httpx.Client

    def post(self, name: str, /, **fields: Any) -> dict[str, Any]:
        """The answer of a command over HTTP, which must work."""
        answer = self.http.post(f"/api/do/{name}", json=fields)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def send(self, data: bytes, name: str = "picture.png") -> str:
        """The name under which uploaded bytes are known."""
        return self.http.post(f"/api/blobs?name={name}", content=data).json()["blob"]

    @contextlib.contextmanager
    def browser(self, mirror: Mirror | None = None) -> Iterator[Browser]:
        """A new connection, not greeted yet."""
        with connect(self.url.replace("http://", "ws://") + "/ws", max_size=None, compression=None) as socket:
            yield Browser(socket, mirror)

    @contextlib.contextmanager
    def greeted(self, mirror: Mirror | None = None) -> Iterator[Browser]:
        """A connection that said hello."""
        with self.browser(mirror) as browser:
            browser.hello()
            yield browser


@contextlib.contextmanager
def live(studio: Studio, access: Access | None = None) -> Iterator[Live]:
    """Serve a studio on a port of its own by the real server; it is closed afterwards."""
    bound = listen("127.0.0.1", 0)
    server = make_server(studio, access or Access())
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
    thread.start()
    url = f"http://127.0.0.1:{bound.getsockname()[1]}"
    try:
        with httpx.Client(base_url=url, timeout=60, verify=False) as client:
            yield Live(studio, url, client)
    finally:
        server.should_exit = True
        thread.join()


@contextlib.contextmanager
def live_with_folder(folder: Path) -> Iterator[Live]:
    """A served studio whose clients may name files of `folder`/shared."""
    (folder / "shared").mkdir()
    with live(make_studio(folder, shared=folder / "shared")) as served:
        yield served


def dab(size: int, color: tuple[int, int, int, int]) -> str:
    """A square of one colour, as `paint.dab` wants it."""
    pixels = np.zeros((size, size, 4), np.uint8)
    pixels[:] = color
    return encoded(pixels)


class Browser(studio_client.Browser):
    """A client that can paint a square."""

    def stroke(self, camera: Camera, corner: tuple[int, int], size: int, color: tuple[int, int, int, int], **how: Any):
        """Paint a square and commit it; returns the answer."""
        started = self.do("paint.begin", camera=wire(camera), kind=how.pop("kind", "paint"))
        rectangle = {"x": corner[0], "y": corner[1], "width": size, "height": size}
        self.do("paint.dab", stroke=started["stroke"], rgba=dab(size, color), **rectangle)
        return self.do("paint.end", stroke=started["stroke"], **how)
