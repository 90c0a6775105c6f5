"""What is drawn while the server is away: it stays on the screen and goes into its own project, or nowhere."""

from __future__ import annotations

import contextlib
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.session import Session
from tests.support import studio_scenes
from tests.support.studio_pages import Page, window
from tests.support.studio_process import Server, served_page
from tests.support.systems import posix_only

OVERLAY = """() => {
  const canvas = document.querySelector("canvas.overlay");
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let painted = 0;
  for (let k = 3; k < data.length; k += 4) painted += data[k] > 0;
  return painted;
}"""
"""Pixels of the strokes that lie over the view."""


@pytest.fixture
def killed(browser: Any, tmp_path: Path) -> Iterator[tuple[Server, Page]]:
    """A page with one stroke, whose server is killed and started again."""
    with served_page(browser, tmp_path) as (server, page):
        page.tab.keyboard.press("b")
        page.drag((0.42, 0.45), (0.5, 0.45))
        page.wait("a layer", lambda: page.names() == ["Paint"])
        page.settled()
        yield server, page


def kill(server: Server, page: Page) -> None:
    server.end(crash=True)
    page.wait("that it is gone", lambda: "lost" in page.tab.locator(".connection").inner_text())


def strokes(page: Page) -> list[int | None]:
    return [layer["strokes"] for layer in page.state()["layers"]]


@posix_only
@pytest.mark.slow
def test_strokes_drawn_after_the_server_died_go_into_their_project(killed: tuple[Server, Page]) -> None:
    server, page = killed
    tab, project = page.tab, page.state()["project"]["id"]
    kill(server, page)
    page.drag((0.42, 0.55), (0.5, 0.55))
    page.drag((0.42, 0.65), (0.5, 0.65))
    page.pointer("down", 9, "pen", 0.55, 0.4)
    page.pointer("move", 9, "pen", 0.56, 0.5)
    server.start()
    question = tab.get_by_role("alert").filter(has_text="The studio was started again")
    question.wait_for()
    page.pointer("move", 9, "pen", 0.56, 0.6)
    page.pointer("up", 9, "pen", 0.56, 0.6, 0.0)
    assert page.state()["project"]["id"] != project and page.names() == []
    page.wait("three strokes in the question", lambda: "3 strokes drawn since" in question.inner_text())
    words = question.inner_text()
    assert re.search(r"You were in ball.ply \(1 layer, last change \d\d:\d\d", words), words
    assert page.ask("document.activeElement.textContent").startswith("Continue (1 layer, "), "it has the focus"
    seen = page.ask(OVERLAY)
    assert seen > 100, "they are still to be seen"
    page.tab.set_viewport_size({"width": 900, "height": 600})
    page.wait("another view", lambda: page.ask(OVERLAY) == 0)
    page.tab.set_viewport_size({"width": 900, "height": 520})
    page.wait("them again, on their view", lambda: page.ask(OVERLAY) > 0.98 * seen)
    page.drag((0.3, 0.3), (0.35, 0.3))
    page.wait("a word on why not", lambda: "Painting waits" in tab.locator(".toasts").inner_text())
    assert page.names() == [], "nothing lands in the new project"
    tab.keyboard.press("Escape")
    question.get_by_role("button", name="Continue").click()
    page.wait("their project", lambda: page.state()["project"]["id"] == project)
    page.wait("all four strokes", lambda: strokes(page) == [4])
    page.settled()
    assert page.ask(OVERLAY) == 0 and question.count() == 0
    labels = [step["label"] for step in page.state()["history"]]
    assert labels[1:] == ["Brush in Paint"] * 4, labels
    page.tab.keyboard.press("Control+z")
    page.wait("the last one taken back", lambda: strokes(page) == [3])


def reload(server: Server, page: Page) -> None:
    """Load the page again, without a question whether to leave it."""
    dialogs: list[str] = []
    page.tab.on("dialog", lambda dialog: (dialogs.append(dialog.type), dialog.accept()))
    page.tab.goto(server.url)
    page.wait("the page", lambda: page.ask("!!window.studio?.state.value"))
    assert dialogs == [], "what is drawn outlives the reload"


@posix_only
@pytest.mark.slow
def test_strokes_that_wait_survive_a_reload_of_the_page(killed: tuple[Server, Page]) -> None:
    """They are kept by the browser, named by the question, and go into their own project, in their order."""
    server, page = killed
    project = page.state()["project"]["id"]
    kill(server, page)
    page.drag((0.42, 0.55), (0.5, 0.55))
    page.drag((0.42, 0.65), (0.5, 0.65))
    page.wait("them in the browser", lambda: page.ask(STORED_STROKES) == [["Brush", "Paint"], ["Brush", "Paint"]])
    server.start()
    reload(server, page)
    question = page.tab.get_by_role("alert").filter(has_text="The studio was started again")
    question.wait_for()
    words = question.inner_text()
    assert "You were in ball.ply (1 layer" in words and "2 strokes drawn since wait to go into it" in words, words
    assert page.state()["project"]["id"] != project and page.names() == []
    question.get_by_role("button", name="Continue").click()
    page.wait("both strokes", lambda: page.state()["project"]["id"] == project and strokes(page) == [3])
    page.settled()
    page.wait("nothing kept any more", lambda: page.ask(STORED_STROKES) == [])
    reload(server, page)
    page.settled()
    assert strokes(page) == [3] and page.tab.get_by_role("alert").count() == 0


STORED_STROKES = """async () => {
  const opened = indexedDB.open("splatpainter", 1);
  const store = () => opened.result.transaction("strokes").objectStore("strokes").getAll();
  const waited = (request) => new Promise((resolve) => (request.onsuccess = () => resolve(request.result)));
  await waited(opened);
  const strokes = await waited(store());
  const layer = (id) => window.studio.state.value.layers.find((one) => one.id === id)?.name;
  return strokes.map(({ name, target }) => [name, target.into_new ?? layer(target.layer)]);
}"""
"""Names of the strokes that the browser keeps, each with that of its layer."""


@posix_only
@pytest.mark.slow
@pytest.mark.parametrize("reloaded", [False, True])
def test_a_stroke_whose_answer_was_lost_is_painted_once(killed: tuple[Server, Page], reloaded: bool) -> None:
    """The commit reached the disk, the answer did not reach the page."""
    server, page = killed
    page.ask("""() => {
      const socket = window.studio.link.socket;
      const hear = socket.onmessage;
      socket.onmessage = (message) => { if (!window.deaf) hear(message); };
      const send = socket.send.bind(socket);
      socket.send = (text) => { window.deaf ||= text.includes('"paint.end"'); send(text); };
    }""")
    page.drag((0.42, 0.55), (0.5, 0.55))
    page.wait("its commit", lambda: page.ask("window.deaf === true"))
    projects = server.projects

    def saved() -> bool:
        import sqlite3

        (file,) = projects.glob("ball_*.splatproj")
        with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
            return database.execute("SELECT count(*) FROM steps").fetchone()[0] == 3

    page.wait("it in the file", saved)
    kill(server, page)
    if reloaded:
        page.wait("it in the browser", lambda: page.ask(STORED_STROKES) == [["Brush", "Paint"]])
    server.start()
    if reloaded:
        reload(server, page)
    page.tab.get_by_role("button", name="Continue").click()
    page.wait("its project", lambda: page.names() == ["Paint"])
    page.settled()
    assert strokes(page) == [2]


@posix_only
@pytest.mark.slow
def test_what_waits_can_be_given_up_and_taken_back(killed: tuple[Server, Page]) -> None:
    server, page = killed
    tab = page.tab
    kill(server, page)
    page.drag((0.42, 0.55), (0.5, 0.55))
    page.drag((0.42, 0.65), (0.5, 0.65))
    before = page.ask(OVERLAY)
    tab.keyboard.press("Control+z")
    page.wait("one of them taken back", lambda: 0 < page.ask(OVERLAY) < before)
    server.start()
    stay = tab.get_by_role("button", name="Stay here without the 1 stroke")
    stay.click()
    page.settled()
    assert page.names() == [] and page.ask(OVERLAY) == 0
    page.drag((0.42, 0.45), (0.5, 0.45))
    page.wait("a stroke of the new project", lambda: strokes(page) == [1])
    page.settled()


@posix_only
@pytest.mark.slow
def test_a_server_that_says_nothing_for_long_is_noticed(killed: tuple[Server, Page]) -> None:
    server, page = killed
    page.ask("window.studio.limits.silentMs = 400")
    server.send(signal.Signals["SIGSTOP"])
    try:
        page.drag((0.42, 0.55), (0.5, 0.55))
        note = page.tab.get_by_text("No answer for 20 seconds")
        note.wait_for()
        assert page.ask(OVERLAY) > 0
    finally:
        server.send(signal.Signals["SIGCONT"])
    page.wait("its stroke", lambda: strokes(page) == [2])
    page.settled()
    assert note.count() == 0 and np.isfinite(page.pixels()).all()


@posix_only
@pytest.mark.slow
def test_another_project_of_the_same_name_gets_no_strokes(browser: Any, tmp_path: Path) -> None:
    """The name of its file was all that a project was known by: the strokes went into the other one."""
    for name, seed in (("a", 0), ("b", 1)):
        (tmp_path / name).mkdir()
        with Session(studio_scenes.ball(300, seed), tmp_path / name / "vase.splatproj") as session:
            session.layers.new("Paint")
    server, other = (Server(tmp_path / name / "vase.splatproj", tmp_path) for name in "ab")
    other.port, other.url = server.port, server.url
    other._command[-1] = str(server.port)
    try:
        server.start()
        with window(browser, server.url, still=True) as page:
            page.tab.keyboard.press("b")
            page.drag((0.45, 0.4), (0.55, 0.4))
            page.wait("a stroke", lambda: strokes(page) == [1])
            page.settled()
            kill(server, page)
            page.drag((0.45, 0.5), (0.55, 0.5))
            other.start()
            question = page.tab.locator(".swapped")
            page.wait("a question", lambda: question.count() and "1 stroke drawn since waits" in question.inner_text())
            assert strokes(page) == [0] and len(page.state()["history"]) == 2
            other.end(crash=True)
            page.wait("that it is gone", lambda: "lost" in page.tab.locator(".connection").inner_text())
            server.start()
            page.wait("both strokes", lambda: strokes(page) == [2])
            page.settled()
            page.problems = [one for one in page.problems if "WebSocket" not in one and "ERR_" not in one]
    finally:
        for one in (server, other):
            one.end(crash=True)
