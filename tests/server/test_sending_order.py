"""What a client is sent while others change the asset and its connection is slow: the order of Gaussians, states and
previews. The connection is a scripted one, on which a message takes as long as something else needs to happen."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from splatbench.studio_client import Mirror, wire
from starlette.websockets import WebSocket, WebSocketDisconnect

from splatpainter.server import client, frames
from splatpainter.server.client import serve
from splatpainter.server.hub import Hub, parse
from splatpainter.server.page_state import PageState
from splatpainter.server.schema import schema_hash
from splatpainter.server.studio import Studio
from splatpainter.server.work_queue import Ticket
from splatpainter.session.project import database
from splatpainter.session.project.project_file import Project
from tests.support.studio_scenes import dab, live, make_studio, view

SQUARE = {"x": 36, "y": 36, "width": 24, "height": 24, "rgba": dab(24, (20, 20, 230, 255))}
SECONDS = 60.0
"""Until something that must happen is taken as not happening."""
Work = Callable[[], Awaitable[Any]]


class ScriptedSocket:
    """A connection and the page at its end. `meanwhile` is done while the next Gaussians are on their way."""

    def __init__(self) -> None:
        self.mirror, self.received = Mirror(), list[dict[str, Any] | frames.SplatFrame]()
        self.meanwhile: Work | None = None
        self._commands: asyncio.Queue[str | None] = asyncio.Queue()
        self._number = 0

    async def accept(self) -> None:
        """As the server does first."""

    async def receive_text(self) -> str:
        text = await self._commands.get()
        if text is None:
            raise WebSocketDisconnect
        return text

    async def send_text(self, data: str) -> None:
        self.received.append(json.loads(data))

    async def send_bytes(self, data: bytes) -> None:
        self.mirror.take(data)
        self.received.append(frames.unpack(data))
        work, self.meanwhile = self.meanwhile, None
        if work is not None:
            await work()

    def send(self, name: str, **fields: Any) -> int:
        """Send a command without waiting; returns its number."""
        self._number += 1
        self._commands.put_nowait(json.dumps({"id": self._number, "do": name, **fields}))
        return self._number

    async def answer(self, number: int) -> dict[str, Any]:
        def answers() -> list[dict[str, Any]]:
            return [one for one in self.received if isinstance(one, dict) and one.get("re") == number and "ok" in one]

        await until(lambda: bool(answers()))
        assert answers()[0]["ok"], answers()[0]
        return answers()[0]

    async def do(self, name: str, **fields: Any) -> dict[str, Any]:
        """Send a command; returns its answer."""
        return await self.answer(self.send(name, **fields))

    def states(self) -> list[dict[str, Any]]:
        """Those that came, the greeting's first."""
        return [one["state"] for one in self.received if isinstance(one, dict) and "state" in one]

    def close(self) -> None:
        self._commands.put_nowait(None)


class OtherWindow:
    """Commands of another page, which are done when they return."""

    def __init__(self, hub: Hub) -> None:
        self.hub, self.page = hub, PageState("")

    async def do(self, name: str, **fields: Any) -> Any:
        _, command = parse({"id": 1, "do": name, **fields})
        return await self.hub.execute(command, self.page, Ticket(), None)


async def until(ready: Callable[[], bool]) -> None:
    end = time.monotonic() + SECONDS
    while not ready():
        assert time.monotonic() < end
        await asyncio.sleep(0.002)


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    made = make_studio(tmp_path)
    yield made
    made.close()


def converse(studio: Studio, talk: Callable[[ScriptedSocket, Hub], Awaitable[None]]) -> ScriptedSocket:
    """What a page that has been greeted, says what `talk` says and hangs up was sent."""

    async def run() -> ScriptedSocket:
        hub, socket = Hub(studio), ScriptedSocket()
        served = asyncio.create_task(serve(hub, cast(WebSocket, socket)))
        try:
            await socket.do("hello", schema_hash=schema_hash())
            await talk(socket, hub)
        finally:
            socket.close()
            await served
            hub.queue.close()
        return socket

    return asyncio.run(run())


def test_no_state_comes_before_the_gaussians_that_it_speaks_of(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the asset changes again while the Gaussians of a change are on their way. Without progress messages:
    one that falls between a commit and its state would take the Gaussians along, and only the last state be sent."""
    monkeypatch.setattr(client, "throttled_progress", lambda *words: lambda share, stage: None)

    async def talk(socket: ScriptedSocket, hub: Hub) -> None:
        other = OtherWindow(hub)
        socket.meanwhile = lambda: other.do("look.commit", look={"saturation": 0.5})
        await socket.do("look.commit", look={"exposure": -0.5})
        await until(lambda: socket.states()[-1]["version"] == 3)

    socket = converse(studio, talk)
    assert [state["version"] for state in socket.states()] == [1, 2, 3]
    assert socket.mirror.agrees(studio.session.splats) and studio.session.version == 3
    version = -1
    for message in socket.received:
        if isinstance(message, frames.SplatFrame):
            version = message.version_to
        elif "state" in message:
            assert message["state"]["version"] <= version


def test_the_greeting_is_of_the_gaussians_before_it(studio: Studio) -> None:
    async def talk(socket: ScriptedSocket, hub: Hub) -> None:
        await OtherWindow(hub).do("look.commit", look={"saturation": 0.5})
        second, other = ScriptedSocket(), OtherWindow(hub)
        served = asyncio.create_task(serve(hub, cast(WebSocket, second)))
        second.meanwhile = lambda: other.do("look.commit", look={"exposure": -0.5})
        greeting = await second.do("hello", schema_hash=schema_hash())
        first = second.received[0]
        assert isinstance(first, frames.SplatFrame) and greeting["state"]["version"] == first.version_to == 2
        await until(lambda: second.states()[-1]["version"] == 3)
        assert second.mirror.agrees(studio.session.splats) and second.states()[-1]["clients"] == 2
        second.close()
        await served

    converse(studio, talk)


def test_a_cancelled_strokes_preview_is_not_sent_any_more(studio: Studio) -> None:
    """A dab and the cancel of its stroke are done while something else is on its way to the page."""

    async def talk(socket: ScriptedSocket, hub: Hub) -> None:
        stroke = (await socket.do("paint.begin", camera=wire(view())))["stroke"]
        (client,) = hub.clients
        numbers: list[int] = []

        async def dab_and_cancel() -> None:
            numbers.append(socket.send("paint.dab", stroke=stroke, **SQUARE))
            numbers.append(socket.send("paint.cancel", stroke=stroke))
            await until(lambda: client.page.clear_preview)

        socket.meanwhile = dab_and_cancel
        await OtherWindow(hub).do("look.commit", look={"saturation": 0.5})
        await until(lambda: len(numbers) == 2)
        assert (await socket.answer(numbers[0]))["gaussians"] > 0
        await socket.answer(numbers[1])
        await socket.do("paint.begin", camera=wire(view()))  # whatever was waiting has been sent

    socket = converse(studio, talk)
    assert socket.mirror.previews == 0 and socket.mirror.agrees(studio.session.splats)


def test_a_preview_that_a_writer_overtakes_leaves_no_colors_of_the_one_before(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A preview takes the place of another one on the same Gaussians, and is out of date before it can be sent."""

    async def talk(socket: ScriptedSocket, hub: Hub) -> None:
        await socket.do("look.preview", look={"saturation": -1})
        assert socket.mirror.previews == 1
        frames_of, other = hub.frames, OtherWindow(hub)

        async def frames_after_a_stroke(since: int | None, stale_ids: np.ndarray, shapes: bool) -> Any:
            monkeypatch.undo()
            stroke = (await other.do("paint.begin", camera=wire(view()))).stroke
            await other.do("paint.dab", stroke=stroke, **SQUARE)
            await other.do("paint.end", stroke=stroke)
            return await frames_of(since, stale_ids, shapes)

        monkeypatch.setattr(hub, "frames", frames_after_a_stroke)
        await socket.do("look.preview", look={"saturation": -0.5})
        await until(lambda: socket.states()[-1]["version"] == 2)
        await socket.do("paint.begin", camera=wire(view()))  # whatever was waiting has been sent

    socket = converse(studio, talk)
    assert socket.mirror.agrees(studio.session.splats) and studio.session.version == 2


def test_an_answer_does_not_wait_until_the_log_is_folded_and_the_next_command_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio, answered, order = make_studio(tmp_path), threading.Event(), list[str]()
    settled, commit = Project._settled, Project.commit

    def noted(project: Project) -> Project:
        order.append("folds" if answered.wait(SECONDS) else "nobody was answered")
        return settled(project)

    def noted_commit(project: Project, *values: Any) -> set[str]:
        order.append("commits")
        return commit(project, *values)

    with live(studio) as served, served.greeted() as browser:
        monkeypatch.setattr(Project, "_settled", noted)
        monkeypatch.setattr(Project, "commit", noted_commit)
        browser.do("layer.new", name="first")
        assert database.has_log(studio.session.path or tmp_path), "on the disk, and not folded"
        answered.set()
        browser.do("layer.new", name="second")
        assert order[:3] == ["commits", "folds", "commits"]


@pytest.mark.parametrize("ids", [[], [0], [2, 3, 9], [0, 1, 2, 3, 4]])
@pytest.mark.parametrize("excluded", [[], [0], [2, 3, 9], [3, 12]])
def test_gaussians_that_are_previewed_anew_are_not_put_back(ids: list[int], excluded: list[int]) -> None:
    first, second = np.array(ids, np.int64), np.array(excluded, np.int64)
    left = client._without(first, second)
    assert left.dtype == np.int64 and left.tolist() == [k for k in ids if k not in excluded]
