"""Clients over the socket are sent what the session shows: in order, all of them, also after a break."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from fastapi import WebSocket
from splatbench import studio_client
from splatbench.studio_client import Browser, after

from splatpainter.cameras import Camera
from splatpainter.io import write
from splatpainter.kernels import spare_copies
from splatpainter.server import page_state
from splatpainter.server.client import BACKPRESSURE_MESSAGES, MAX_QUEUED_COMMANDS, Client
from splatpainter.server.commands.context import HANDLERS, CommandContext, Handler
from splatpainter.server.commands.files import ReceiptShow
from splatpainter.server.commands.layers import ConflictsList, Redo
from splatpainter.server.hub import Hub
from splatpainter.server.protocol import Answer
from splatpainter.server.strokes.stroke import Stroke
from splatpainter.session.commands.session_layers import SessionLayers
from splatpainter.session.commands.session_surface import SessionSurface
from splatpainter.session.project import project_file
from splatpainter.splats import ATTRIBUTES, rows_sha256
from splatpainter.surface.estimate import Surface
from tests.support.studio_scenes import Live, Mirror, ball, dab, live, make_studio, view, wire

RED, BLUE = (230, 20, 20, 255), (20, 20, 230, 255)


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live(make_studio(tmp_path)) as served:
        yield served


def test_a_stroke_is_previewed_committed_and_undone_bit_for_bit(studio: Live) -> None:
    session = studio.studio.session
    before = rows_sha256(session.splats)
    with studio.greeted() as browser:
        assert browser.mirror.agrees(session.splats)
        started = browser.do("paint.begin", camera=wire(view()))
        box = {"x": 36, "y": 36, "width": 24, "height": 24}
        seen = browser.do("paint.dab", stroke=started["stroke"], rgba=dab(24, RED), **box)
        assert seen["gaussians"] > 0 and browser.order == ["frame", "answer"] and browser.mirror.previews == 1
        assert rows_sha256(session.splats) == before and not browser.mirror.agrees(session.splats)
        made = browser.do("paint.end", stroke=started["stroke"], name="red square")
        assert browser.order[-1] == "answer" and browser.order.count("frame") >= 1
        assert made["version"] == session.version == browser.mirror.version == 2
        line = "session.layers.add('paint', [sp.Edit(picture, camera, mask)], name='red square'"
        assert made["python"].startswith(line)
        assert made["layer"]["gaussians_edited"] > 0 and browser.mirror.agrees(session.splats)
        score = made["layer"]["views"][0]
        assert score["psnr_after"] > score["psnr_before"] + 5
        browser.do("undo")
        assert browser.mirror.agrees(session.splats) and rows_sha256(session.splats) == before
        browser.do("redo")
        assert browser.mirror.agrees(session.splats) and len(session.splats) == browser.mirror.total


def test_a_cancelled_stroke_leaves_no_trace_on_the_screen(studio: Live) -> None:
    with studio.greeted() as browser:
        started = browser.do("paint.begin", camera=wire(view()))
        rectangle = {"x": 30, "y": 30, "width": 20, "height": 20}
        for color in (RED, BLUE):
            browser.do("paint.dab", stroke=started["stroke"], rgba=dab(20, color), **rectangle)
        assert not browser.mirror.agrees(studio.studio.session.splats)
        browser.do("paint.cancel", stroke=started["stroke"])
        assert browser.mirror.agrees(studio.studio.session.splats)
        assert "stroke: no longer available" in browser.ask("paint.end", stroke=started["stroke"])["error"]["message"]


def test_another_opacity_is_seen_before_it_is_exact(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    sent, unpatched_set, send_bytes = threading.Event(), SessionLayers.set, WebSocket.send_bytes

    def after_the_preview(self: SessionLayers, *args: Any, **values: Any) -> Any:
        assert sent.wait(60)
        return unpatched_set(self, *args, **values)

    async def noted(self: WebSocket, data: bytes) -> None:
        await send_bytes(self, data)
        sent.set()

    with studio.greeted() as browser:
        made = browser.stroke(view(), (30, 30), 20, RED)
        before = browser.mirror.previews
        monkeypatch.setattr(WebSocket, "send_bytes", noted)
        monkeypatch.setattr(SessionLayers, "set", after_the_preview)
        browser.do("layer.set", layer=made["layer"]["id"], opacity=0.5)
        assert browser.order.count("frame") > 1 and browser.mirror.previews > before
        assert browser.mirror.agrees(studio.studio.session.splats)
        before = browser.mirror.previews
        browser.do("layer.set", layer=made["layer"]["id"], opacity=0.25)
        assert browser.order.count("frame") == 1 and browser.mirror.previews == before
        assert browser.mirror.agrees(studio.studio.session.splats)
        browser.stroke(view(), (40, 30), 20, RED)
        before = browser.mirror.previews
        browser.do("layer.set", layer=made["layer"]["id"], visible=False)  # what lies above is painted anew
        assert browser.order.count("frame") > 1 and browser.mirror.previews > before
        assert browser.mirror.agrees(studio.studio.session.splats)


def test_a_preview_ends_with_the_command_that_failed(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    with studio.greeted() as browser:
        made = browser.stroke(view(), (30, 30), 20, RED)
        before = browser.mirror.previews

        def fail(*_: Any, **__: Any) -> None:
            raise ValueError("layer: refused")

        monkeypatch.setattr(SessionLayers, "set", fail)
        assert not browser.ask("layer.set", layer=made["layer"]["id"], opacity=0.5)["ok"]
        browser.do("receipt")  # an answer comes after all Gaussians
        assert browser.mirror.previews == before + 2  # the preview, and the true colours
        assert browser.mirror.agrees(studio.studio.session.splats)


@pytest.mark.parametrize("fails", [False, True])
def test_a_layer_below_is_hidden_and_shown_with_all_its_gaussians(
    studio: Live, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previews move Gaussians and add some; whatever comes then, the page shows what the session has."""
    sent, unpatched_set, send_bytes = threading.Event(), SessionLayers.set, WebSocket.send_bytes

    def after_the_preview(self: SessionLayers, *args: Any, **values: Any) -> Any:
        assert sent.wait(60)
        if fails:
            raise ValueError("layer: refused")
        return unpatched_set(self, *args, **values)

    async def noted(self: WebSocket, data: bytes) -> None:
        await send_bytes(self, data)
        sent.set()

    with studio.greeted() as browser:
        lower = browser.stroke(view(), (30, 30), 20, RED)["layer"]["id"]
        browser.do("layer.new", name="above")
        browser.stroke(view(), (44, 30), 8, RED)
        session = studio.studio.session
        visible, count = len(session.splats), len(session.original)
        monkeypatch.setattr(WebSocket, "send_bytes", noted)
        for is_visible in (False, True):
            session.layers.set(lower, visible=not is_visible)
            browser.do("receipt")
            assert browser.mirror.agrees(session.splats)
            sent.clear()
            before = browser.mirror.previews
            with monkeypatch.context() as patch:
                patch.setattr(SessionLayers, "set", after_the_preview)
                assert browser.ask("layer.set", layer=lower, visible=is_visible)["ok"] is not fails
            browser.do("receipt")
            assert browser.mirror.previews > before and browser.mirror.agrees(session.splats)
            assert (len(session.splats) < visible) is (is_visible is fails) and visible > count


def test_two_windows_see_the_same(studio: Live) -> None:
    with studio.greeted() as one, studio.greeted() as two:
        made = one.stroke(view(), (30, 30), 20, RED)
        two.do("layer.set", layer=made["layer"]["id"], opacity=0.5)
        one.do("look.commit", look={"exposure": 0.5}, name="brighter")
        for browser in (one, two):
            browser.do("receipt")  # an answer comes after all Gaussians
            assert browser.mirror.agrees(studio.studio.session.splats)
            state = browser.state
            assert [layer["name"] for layer in state["layers"]] == ["Stroke", "brighter"]
            assert state["layers"][0]["opacity"] == 0.5 and state["clients"] == 2
            assert state["version"] == studio.studio.session.version == browser.mirror.version


def test_of_the_long_lists_only_what_is_new_is_told(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(project_file, "MAX_STEPS", 6)  # so that old steps go

    def state_of(browser: Browser) -> dict[str, Any]:
        browser.do("receipt")
        state = studio.http.get("/api/state").json()
        assert browser.state == state
        return state

    with studio.greeted() as one, studio.greeted() as two:
        marks = [one.do("bookmark.add", name=f"{k}", camera=wire(view(48)))["bookmark"] for k in range(3)]
        assert [mark["name"] for mark in state_of(two)["bookmarks"]] == ["0", "1", "2"]
        for k in range(8):
            one.do("look.commit", look={"exposure": 0.1 * (k + 1)}, name=f"look {k}")
            assert state_of(two)["history"][-1]["label"] == f"add look {k}"
        assert len(state_of(two)["history"]) == 7  # the start of the history and six steps to undo
        two.do("undo")
        two.do("undo")
        state_of(one)
        two.do("look.commit", look={"exposure": 0.3}, name="another")  # in place of what was undone
        assert [step["label"] for step in state_of(one)["history"][-2:]] == ["add look 5", "add another"]
        one.do("bookmark.delete", bookmark=marks[1]["id"])
        assert [mark["name"] for mark in state_of(two)["bookmarks"]] == ["0", "2"]
        news: list[dict[str, Any]] = []
        monkeypatch.setattr(studio_client, "after", lambda state, event: news.append(event) or after(state, event))
        one.do("layer.set", layer=one.state["layers"][0]["id"], opacity=0.5)
        two.do("receipt")
    assert [len(event["history"]["steps"]) for event in news if event["history"]] == [1, 1]
    assert all(event["bookmarks"] is None for event in news)


def test_after_a_break_only_what_is_missing_comes(studio: Live) -> None:
    mirror = Mirror()
    with studio.greeted(mirror) as browser:
        browser.stroke(view(), (30, 30), 16, RED)
    with studio.greeted() as other:
        other.stroke(view(96, 120), (40, 40), 16, BLUE)
    version = mirror.version
    with studio.browser(mirror) as back:
        back.hello()
        assert back.order == ["frame", "answer"] and mirror.version == version + 1
        assert mirror.agrees(studio.studio.session.splats)
        mirror.version, mirror.columns = -1, {}
        back.do("sync", since=None)
        assert back.order == ["frame", "answer"] and mirror.agrees(studio.studio.session.splats)


def test_what_a_client_asked_for_before_it_went_is_done(studio: Live) -> None:
    with studio.greeted() as browser:
        started = browser.do("paint.begin", camera=wire(view()))["stroke"]
        browser.send("paint.dab", stroke=started, x=30, y=30, width=20, height=20, rgba=dab(20, RED))
        browser.send("paint.end", stroke=started)
    deadline = time.monotonic() + 20
    while not studio.studio.session.layers and time.monotonic() < deadline:
        time.sleep(0.02)
    assert [layer.name for layer in studio.studio.session.layers] == ["Stroke"]


@pytest.fixture
def page() -> str:
    return "0123456789abcdef" * 2


def again(browser: Any, number: int, name: str, /, **fields: Any) -> dict[str, Any]:
    """The answer of a command under a given number."""
    browser.number = number - 1
    return browser.ask(name, **fields)


def test_a_command_that_is_sent_again_after_a_break_is_done_once(studio: Live, page: str) -> None:
    session, mirror = studio.studio.session, Mirror()
    fields = {"look": {"exposure": 0.5}, "name": "brighter"}
    with studio.browser(mirror) as browser:
        assert not browser.hello(page)["returning"]
        browser.number = 10
        made = browser.do("look.commit", **fields)
        refused = browser.ask("layer.delete", layer="99")
    with studio.browser(mirror) as back:
        assert back.hello(page)["returning"]
        assert again(back, made["re"], "look.commit", **fields) == made
        assert again(back, refused["re"], "layer.delete", layer="99") == refused
        assert len(session.layers) == 1 and len(session.history) == 2
        back.do("look.commit", **fields)  # a number of its own: another layer
        assert len(session.layers) == 2 and mirror.agrees(session.splats)
    with studio.browser() as other:
        assert not other.hello("f" * 32)["returning"]
        again(other, made["re"], "undo")  # another page's numbers are its own
        assert len(session.layers) == 1
    with studio.browser() as nameless:
        assert not nameless.hello()["returning"]
        assert "page" in nameless.ask("hello", schema_hash="", page="../../etc")["error"]["message"]


def test_a_command_that_is_still_in_work_is_waited_for(
    studio: Live, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    release, begun, count = threading.Event(), threading.Event(), []

    def slow(context: CommandContext, request: Any) -> Answer:
        count.append(1)
        begun.set()
        while not release.wait(0.02):
            context.ticket.report(0.5, "working")
        return Answer(python="slow()")

    monkeypatch.setitem(HANDLERS, Redo, Handler(slow, writes=True, background=False))
    with studio.browser() as browser:
        browser.hello(page)
        browser.number = 20
        numbers = [browser.send("redo"), browser.send("look.commit", look={"exposure": 1})]
        assert begun.wait(20)
    with studio.browser() as back:  # while the first works, and the second waits
        back.hello(page)
        back.number = 20
        assert [back.send("redo"), back.send("look.commit", look={"exposure": 1})] == numbers
        while "progress" not in back.order:
            back.receive()
        release.set()
        assert back.answer(numbers[0])["python"] == "slow()"
        assert back.answer(numbers[1])["ok"]
        assert len(count) == 1 and len(studio.studio.session.layers) == 1
    with studio.browser() as back:
        release.clear()
        back.hello(page)
        back.number = 30
        number = back.send("redo")
        while "progress" not in back.order:
            back.receive()
    with studio.browser() as back:
        back.hello(page)
        back.number = 40
        assert back.do("cancel", of=number)["ok"]  # of the connection before
        assert again(back, number, "redo")["error"]["kind"] == "cancelled" and len(count) == 2


def test_a_stroke_goes_on_after_a_break(studio: Live, page: str) -> None:
    mirror, session = Mirror(), studio.studio.session
    with studio.browser(mirror) as browser:
        browser.hello(page)
        stroke = browser.do("paint.begin", camera=wire(view()))["stroke"]
        browser.do("paint.dab", stroke=stroke, x=30, y=30, width=12, height=12, rgba=dab(12, RED))
        number = browser.number
    with studio.browser(mirror) as back:
        back.hello(page)
        back.number = number
        back.do("paint.dab", stroke=stroke, x=42, y=30, width=12, height=12, rgba=dab(12, RED))
        assert not mirror.agrees(session.splats)
        back.do("paint.cancel", stroke=stroke)
        assert mirror.agrees(session.splats)  # also what was previewed before the break


def test_pages_that_do_not_come_back_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_state, "RECONNECT_SECONDS", 0.05)
    monkeypatch.setattr(page_state, "MAX_ABSENT_PAGES", 3)

    async def run() -> None:
        pages, hub = page_state.PageStates(), cast(Hub, None)
        clients = [Client(hub, cast(Any, None)) for _ in range(6)]
        for k, client in enumerate(clients):
            assert not pages.attach(client, f"{k:032x}")
        pages.attach(Client(hub, cast(Any, None)), None)
        assert len(pages) == 6
        for client in clients[:5]:
            pages.detach(client)
        assert len(pages) == 4  # one is here, three are waited for
        back = Client(hub, cast(Any, None))
        assert pages.attach(back, f"{4:032x}") and back.page is clients[4].page
        pages.detach(clients[4])  # heard late: it is back already
        await asyncio.sleep(0.2)
        assert len(pages) == 2
        done = []

        async def work() -> Answer:
            done.append(1)
            return Answer()

        for number in range(page_state.MAX_OUTCOMES + 5):
            await back.page.once(number, work)
        await back.page.once(page_state.MAX_OUTCOMES, work)
        assert len(done) == page_state.MAX_OUTCOMES + 5 and len(back.page._outcomes) == page_state.MAX_OUTCOMES

    asyncio.run(run())


def test_the_first_message_is_hello_of_the_same_schema(studio: Live) -> None:
    with studio.browser() as browser:
        assert "hello" in browser.ask("undo")["error"]["message"]
        refused = browser.ask("hello", schema_hash="0" * 16)
        assert refused["error"]["kind"] == "schema" and refused["error"]["hint"] == "Reload the page."
        assert "hello" in browser.ask("undo")["error"]["message"] and browser.order == ["answer"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("no json", "expected JSON"),
        ("[" * 100_000, "expected JSON"),
        ('{"do": "undo"}', "expected {"),
        ('{"id": 7, "do": "delete everything"}', "unknown command"),
        ('{"id": 7, "do": "jump"}', "jump: cursor: Field required"),
        ('{"id": 7, "do": "jump", "cursor": -1}', "greater than or equal to 0"),
        ('{"id": 7, "do": "undo", "twice": true}', "twice: Extra inputs are not permitted"),
        ('{"id": 7, "do": "look.commit", "look": {"exposure": NaN}}', "finite number"),
        ('{"id": 7, "do": "jump", "cursor": 99}', "history: expected an index of 0 to 0"),
        ('{"id": 7, "do": "layer.delete", "layer": "9"}', "layer: expected one of none, got '9'"),
    ],
)
def test_wrong_messages_are_told_why(studio: Live, text: str, reason: str) -> None:
    with studio.greeted() as browser:
        browser.socket.send(text)
        while (data := browser.receive()) is None or "re" not in data or "progress" in data:
            pass
        error = data["error"]
        assert error["kind"] == "input" and reason in error["message"] + error["hint"]
        assert browser.do("undo")["ok"]  # and the connection goes on


def test_long_looks_do_not_hold_up_the_next_commands_and_can_be_cancelled(
    studio: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    def endless(context: CommandContext, request: Any) -> Answer:
        while True:
            context.ticket.report(0.25, "thinking")
            time.sleep(0.01)

    monkeypatch.setitem(HANDLERS, ReceiptShow, Handler(endless, writes=False, background=True))
    with studio.greeted() as browser:
        number = browser.send("receipt")
        while "progress" not in browser.order:
            browser.receive()
        browser.do("bookmark.add", name="front", camera=wire(view()))
        assert browser.do("cancel", of=number)["ok"]
        data = browser.answer(number)
        assert data["error"]["kind"] == "cancelled"


def test_answers_come_in_order_and_too_many_commands_are_refused(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    def slow(context: CommandContext, request: Any) -> Answer:
        release.wait(20)
        return Answer()

    monkeypatch.setitem(HANDLERS, ConflictsList, Handler(slow, writes=False, background=False))
    with studio.greeted() as browser:
        numbers = [browser.send("conflicts"), *(browser.send("undo") for _ in range(MAX_QUEUED_COMMANDS + 20))]
        refused = [browser.answer(number) for number in numbers[-15:]]  # while the first is still in work
        assert {data["error"]["kind"] for data in refused} == {"busy"}
        release.set()
        done = []
        while len(done) < MAX_QUEUED_COMMANDS:
            data = browser.receive()
            if data is not None and data.get("ok"):
                done.append(data["re"])
        assert done == numbers[: len(done)]


def test_others_are_served_while_the_writer_works(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    def slow(context: CommandContext, request: Any) -> Answer:
        release.wait(20)
        return Answer()

    monkeypatch.setitem(HANDLERS, Redo, Handler(slow, writes=True, background=False))
    with studio.greeted() as busy, studio.greeted() as other:
        number = busy.send("redo")
        other.do("pick", camera=wire(view()), x=48.0, y=48.0)
        other.do("paint.begin", camera=wire(view()))
        assert studio.http.get("/api/state").status_code == 200
        release.set()
        assert busy.answer(number)["ok"]


def test_a_fault_of_ours_is_an_answer_and_changes_nothing(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(context: CommandContext, request: Any) -> Answer:
        raise KeyError("oh")

    monkeypatch.setitem(HANDLERS, Redo, Handler(broken, writes=True, background=False))
    with studio.greeted() as browser:
        error = browser.ask("redo")["error"]
        assert error["kind"] == "fault" and "KeyError" in error["message"]
        browser.stroke(view(), (30, 30), 16, RED)
        assert browser.mirror.agrees(studio.studio.session.splats)


def test_another_asset_replaces_the_session_for_everybody(studio: Live, tmp_path: Path) -> None:
    write(tmp_path / "other.ply", ball(200, seed=3))
    with studio.greeted() as one, studio.greeted() as two:
        one.stroke(view(), (30, 30), 16, RED)
        old = studio.studio.session
        sent = studio.http.post("/api/blobs?name=other.ply", content=(tmp_path / "other.ply").read_bytes()).json()
        assert (sent["kind"], sent["gaussians"]) == ("asset", 200)
        one.do("asset.open", blob=sent["blob"])
        session = studio.studio.session
        assert session is not old and len(session.splats) == 200
        for browser in (one, two):
            browser.do("project.recent")
            assert browser.mirror.agrees(session.splats)
            assert browser.state["asset"]["name"] == "other.ply"
            assert browser.state["session"] == studio.studio.session_id
        toasts = [[e["message"] for e in browser.events if e["event"] == "toast"] for browser in (one, two)]
        assert toasts == [[], ["Another window opened other.ply."]]
        broken = studio.http.post("/api/blobs?name=bad.ply", content=b"ply\nformat ascii 1.0\nend_header\n").json()
        assert not one.ask("asset.open", blob=broken.get("blob", "0" * 64))["ok"]
        assert studio.studio.session is session


@pytest.mark.slow
def test_what_was_meant_for_another_project_changes_nothing(studio: Live) -> None:
    """Layers of both are called "1": what waited while the next asset was opened went there."""
    with studio.greeted() as browser:
        former = browser.state["session"]
        browser.do("layer.new", name="mine", session=former)
        browser.do("asset.open", demo=True, session=former)
        state = studio.http.get("/api/state").json()
        for name, fields in (
            ("paint.begin", {"camera": wire(view())}),
            ("layer.new", {"name": "theirs"}),
            ("asset.up", {"up": "+z"}),
            ("view.export", {"camera": wire(view()), "format": "png"}),
        ):
            error = browser.ask(name, session=former, **fields)["error"]
            assert error["kind"] == "project" and "Another project was opened" in error["message"], name
        assert studio.http.get("/api/state").json() == state
        browser.do("layer.new", name="theirs", session=state["session"])
        browser.do("layer.new", name="of a client that says nothing")


@pytest.mark.parametrize("count", [8, 3000])
def test_a_stroke_ends_with_the_asset_that_it_was_begun_on(studio: Live, tmp_path: Path, count: int) -> None:
    """Both sessions are at version 1: nothing but the session itself tells their Gaussians apart."""
    write(tmp_path / "other.ply", ball(count, seed=3))
    box = {"x": 36, "y": 36, "width": 24, "height": 24}
    with studio.greeted() as one, studio.greeted() as two:
        started = one.do("paint.begin", camera=wire(view()))
        one.do("paint.dab", stroke=started["stroke"], rgba=dab(24, RED), **box)
        two.do("asset.open", blob=studio.send((tmp_path / "other.ply").read_bytes(), "other.ply"))
        session = studio.studio.session
        assert session.version == 1 and len(session.splats) == count
        for do, fields in (("paint.dab", {"rgba": dab(24, RED), **box}), ("paint.end", {})):
            answer = one.ask(do, stroke=started["stroke"], **fields)
            assert not answer["ok"] and answer["error"]["kind"] == "input", answer
            assert (
                "stroke: no longer available" in answer["error"]["message"]
                and answer["error"]["hint"] == "begin a new one"
            )
        assert not session.layers
        again = one.do("paint.begin", camera=wire(view()))
        one.do("paint.dab", stroke=again["stroke"], rgba=dab(24, RED), **box)
        assert one.do("paint.end", stroke=again["stroke"])["version"] == 2


def test_the_surface_is_looked_at_while_a_stroke_is_drawn(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = threading.Event()

    def look(self: Stroke, surface: Surface) -> bool:
        looked.set()
        return False

    monkeypatch.setattr(Stroke, "look", look)
    with studio.greeted() as one:
        started = one.do("paint.begin", camera=wire(view()))
        # What is prepared at pen-down uses the same thread, and may still be at it.
        for _ in range(100):
            one.do("paint.dab", stroke=started["stroke"], rgba=dab(24, RED), x=36, y=36, width=24, height=24)
            if looked.wait(0.1):
                return
    raise AssertionError("nobody looked")


def test_a_stroke_writes_into_copies_that_were_made_while_it_was_drawn(
    studio: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a million Gaussians copying what a stroke leaves alone took a tenth of the wait for it."""
    monkeypatch.setattr(spare_copies, "SPARE_LIMITS", replace(spare_copies.SPARE_LIMITS, smallest_bytes=0, room=4))
    copied, addresses, copy_ahead = threading.Event(), [], Stroke.copy_ahead

    def noted(stroke: Stroke) -> None:
        copy_ahead(stroke)
        addresses.extend(address(copy._copies[0]) for copy in stroke._copies)
        copied.set()

    def address(array: np.ndarray) -> int:
        return array.__array_interface__["data"][0]

    monkeypatch.setattr(Stroke, "copy_ahead", noted)
    with studio.greeted() as one:
        started = one.do("paint.begin", camera=wire(view()))
        assert copied.wait(60)
        one.do("paint.dab", stroke=started["stroke"], rgba=dab(24, RED), x=36, y=36, width=24, height=24)
        one.do("paint.end", stroke=started["stroke"])
    splats = studio.studio.session.splats
    assert len(addresses) == len(ATTRIBUTES)
    assert [address(getattr(splats, name)) for name in ATTRIBUTES] == addresses


def test_a_closed_studio_leaves_no_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads that go on compiling exchange the process's warning filters while others rely on theirs."""
    begun, may_end = threading.Event(), threading.Event()

    def slow(self: SessionSurface, camera: Camera) -> None:
        begun.set()
        may_end.wait(60)

    monkeypatch.setattr(SessionSurface, "prepare", slow)
    made = make_studio(tmp_path)
    made.prepare_edit(view())
    made.prepare_edit(view())  # one is at it
    assert begun.wait(60)
    closing = threading.Thread(target=made.close)
    closing.start()
    names = [thread.name for thread in threading.enumerate()]
    assert names.count("studio-prepare") == 1 and closing.is_alive()
    may_end.set()
    closing.join(60)
    assert not closing.is_alive() and "studio-prepare" not in [thread.name for thread in threading.enumerate()]


def test_looks_are_previewed_on_every_gaussian_and_taken_back(studio: Live) -> None:
    session = studio.studio.session
    with studio.greeted() as browser:
        for exposure in (0.5, 1.0):
            assert browser.do("look.preview", look={"exposure": exposure})["gaussians"] == len(session.splats)
        assert not browser.mirror.agrees(session.splats)
        browser.do("look.preview", look={"exposure": 0.0})
        assert browser.mirror.agrees(session.splats)
        browser.do("look.preview", look={"saturation": -1})
        sh, previewed = browser.mirror.columns["sh"], browser.received
        browser.do("look.commit", look={"saturation": -1})
        assert browser.mirror.agrees(session.splats) and np.abs(sh - session.splats.sh).max() < 4e-3
        sent = browser.order.count("frame")  # a second one, of true colours, where the sender wakes before the answer
        assert 2.5 * previewed < browser.received < 61 * len(session.splats) * sent  # tints; colours alone as floats
        layer = session.layers[0]
        browser.do("layer.set", layer=layer.id, parameters={"saturation": -1, "strength": 0})
        assert browser.mirror.agrees(session.splats)
        assert rows_sha256(session.splats) == rows_sha256(session.original)
        assert (
            "unknown key 'glow'" in browser.ask("layer.set", layer=layer.id, parameters={"glow": 1})["error"]["message"]
        )


def test_a_light_is_dragged_on_the_screen_of_one_window_alone(studio: Live) -> None:
    session = studio.studio.session
    made = studio.post("layer.add", operation={"kind": "light", "hdri": "noon"})["layer"]["id"]
    lit, steps = session.splats, len(session.history)
    with studio.greeted() as browser, studio.greeted() as other:
        for rotate in (40, 80, 120):
            dragged = [{"layer": made, "parameters": {"rotate": rotate}}]
            answer = browser.do("layer.preview", layers=dragged)
            assert (answer["gaussians"], answer["possible"]) == (len(lit), True)
        sh = browser.mirror.columns["sh"].copy()
        assert not browser.mirror.agrees(lit) and other.mirror.agrees(lit)
        assert session.splats is lit and len(session.history) == steps
        # Nothing is shown of a lamp that reaches nothing; letting it go there is refused, and all is as it was.
        inside = {"point": ["0,0,0"]}
        assert browser.do("layer.preview", layers=[{"layer": made, "parameters": inside}])["possible"]
        assert (
            "expected exposure from"
            in (browser.ask("layer.set", layer=made, parameters={"exposure": 99})["error"]["message"])
        )
        assert browser.mirror.agrees(lit)
        browser.do("layer.preview", layers=[{"layer": made, "parameters": {"rotate": 120}}])
        browser.do("layer.set", layer=made, parameters={"rotate": 120})
        assert browser.mirror.agrees(session.splats) and not browser.mirror.agrees(lit)
        assert np.abs(sh[:, 0] - session.splats.sh[:, 0]).max() < 4e-3, "it was shown as it is now"
        assert len(session.history) == steps + 1
        # Let go where it was: no step, and the screen is right again.
        browser.do("layer.preview", layers=[{"layer": made, "parameters": {"rotate": 10}}])
        browser.do("layer.set", layer=made, parameters={"rotate": 120.0})
        assert browser.mirror.agrees(session.splats) and len(session.history) == steps + 1
        browser.do("layer.preview", layers=[{"layer": made, "opacity": 0.5}])
        browser.do("layer.preview")
        assert browser.mirror.agrees(session.splats)


def test_two_windows_change_one_light_at_once(studio: Live) -> None:
    layer = studio.post("layer.add", operation={"kind": "light", "hdri": "noon"})["layer"]["id"]
    session = studio.studio.session
    with studio.greeted() as one, studio.greeted() as other:
        one.do("layer.preview", layers=[{"layer": layer, "parameters": {"rotate": 50}}])
        other.do("layer.preview", layers=[{"layer": layer, "parameters": {"exposure": 1}}])
        other.do("layer.set", layer=layer, parameters={"exposure": 1}, gesture="other")
        one.do("layer.preview", layers=[{"layer": layer, "parameters": {"rotate": 90}}])
        one.do("layer.set", layer=layer, parameters={"rotate": 90}, gesture="one")
        # Each changed its own option; what the other did is there as well, and two steps undo.
        assert session.layers[0].operation.changes() == {"hdri": "noon", "rotate": 90, "exposure": 1}
        one.do("layer.preview")
        other.do("layer.preview")
        assert one.mirror.agrees(session.splats) and other.mirror.agrees(session.splats)
        assert len(session.history) == 4
        other.do("undo")
        assert session.layers[0].operation.changes() == {"hdri": "noon", "exposure": 1}


def test_whoever_does_not_read_gets_no_more_work_done(studio: Live) -> None:
    class Stuck:
        def __init__(self) -> None:
            self.go = asyncio.Event()

        async def send_text(self, data: str) -> None:
            await self.go.wait()

        async def send_bytes(self, data: bytes) -> None:
            await self.go.wait()

    async def run() -> None:
        socket = Stuck()
        client = Client(Hub(studio.studio), socket)
        sender = asyncio.create_task(client.send_all())
        for number in range(BACKPRESSURE_MESSAGES + 1):
            client.send(Answer(re=number))
            await asyncio.sleep(0)
        waiting = asyncio.create_task(client.backpressure())
        await asyncio.sleep(0.05)
        assert not waiting.done()
        socket.go.set()
        await asyncio.wait_for(waiting, 5)
        sender.cancel()

    asyncio.run(run())
