"""A window on a project that is open elsewhere learns that it was let go of, and goes on in it at a click."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from splatbench.studio_client import encoded, wire

from splatpainter.painter import Edit
from splatpainter.server import lock_watch
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.session import Session
from splatpainter.session.project.holder import note_of
from tests.support import studio_scenes
from tests.support.studio_pages import Page, window
from tests.support.studio_process import Server
from tests.support.systems import posix_only

STATE = "window.studio.state.value.project"


def painted(session: Session, shade: float) -> None:
    """One layer more, in the middle of the ball."""
    camera = studio_scenes.view()
    mask = np.zeros((96, 96), bool)
    mask[40:56, 40:56] = True
    picture = np.full((96, 96, 3), shade, np.float32)
    session.layers.add("paint", [Edit(picture, camera, mask)])


@pytest.fixture
def looked_at(browser: Any, tmp_path: Path) -> Iterator[tuple[Session, Page, Studio]]:
    """A project that is open in a session, and the page of a studio that may look at it."""
    path = tmp_path / "own.splatproj"
    holder = Session(studio_scenes.ball(), path)
    painted(holder, 0.9)
    try:
        studio = Studio(Session.load(path), "ball", StudioOptions(None, tmp_path / "projects"))
        with studio_scenes.live(studio) as live, window(browser, live.url, still=True) as page:
            yield holder, page, studio
    finally:
        holder.close()


def edit_here(page: Page) -> Any:
    return page.tab.get_by_role("button", name="Edit here")


def toasts(page: Page) -> str:
    return " ".join(page.tab.locator(".toasts").all_inner_texts())


@pytest.mark.slow
def test_a_project_with_a_note_of_another_computer_is_edited_once_its_user_says_so(
    browser: Any, tmp_path: Path
) -> None:
    path = tmp_path / "own.splatproj"
    Session(studio_scenes.ball(), path).close()
    note_of(path).write_text('{"name": "studio-2", "boot": "another"}')
    studio = Studio(Session.load(path), "ball", StudioOptions(None, tmp_path / "projects"))
    with studio_scenes.live(studio) as live, window(browser, live.url, still=True) as page:
        ask = page.tab.get_by_role("button", name="Edit here...")
        page.wait("that it is asked", ask.count)
        assert page.ask(STATE)["read_only"]
        for answer, stays in (("Cancel", True), ("It is not open there", False)):
            ask.click()
            assert "studio-2" in page.tab.locator("dialog").inner_text()
            page.tab.get_by_role("button", name=answer).click()
            page.wait(answer, lambda stays=stays: page.ask(STATE)["read_only"] == stays)
        assert ask.count() == 0 and page.problems == [] and studio.session.read_only == ""
        painted(studio.session, 0.9)
    studio.session.close()
    assert not note_of(path).exists()


@pytest.mark.slow
def test_a_window_goes_on_in_a_project_that_was_closed_elsewhere(looked_at: tuple[Session, Page, Studio]) -> None:
    holder, page, studio = looked_at
    tab, session = page.tab, page.state()["session"]
    tab.locator(".toolbar .button[aria-pressed=false]:enabled").first.click()  # another tool, and another view
    page.drag((0.3, 0.5), (0.4, 0.5), button="middle")
    page.wait("the other view", lambda: page.camera() != page.state()["asset"]["home"])
    page.ask("window.notLoadedAnew = true")
    tool, camera = tab.locator(".toolbar [aria-pressed=true]").get_attribute("aria-label"), page.camera()
    painted(holder, 0.1)
    assert page.ask(STATE)["read_only"] and edit_here(page).count() == 0 and len(page.names()) == 1

    holder.close()
    page.wait("that it is free", edit_here(page).count)
    assert "ball is open nowhere else any more." in toasts(page)
    assert page.ask(STATE)["read_only"] and page.problems == []
    edit_here(page).click()
    page.wait("that it can be edited", lambda: not page.ask(STATE)["read_only"])
    assert edit_here(page).count() == 0 and tab.locator(".header .tag").count() == 0
    page.wait("the newest layers", lambda: len(page.names()) == 2)
    assert page.ask("window.notLoadedAnew") and page.state()["session"] == session
    assert tab.locator(".toolbar [aria-pressed=true]").get_attribute("aria-label") == tool
    assert page.camera() == camera

    tab.keyboard.press("b")
    page.drag((0.45, 0.5), (0.5, 0.5))
    page.wait("a stroke of its own", lambda: len(page.state()["history"]) == 4)
    page.settled()
    assert studio.session.verify() == [] and len(studio.session.history) == 4
    with Session.load(studio.session.path or "") as other:
        assert other.read_only.startswith("open elsewhere"), "there is one writer"


@pytest.mark.slow
def test_who_came_back_first_keeps_it(looked_at: tuple[Session, Page, Studio], monkeypatch: pytest.MonkeyPatch) -> None:
    holder, page, studio = looked_at
    path = studio.session.path
    assert path is not None
    holder.close()
    page.wait("that it is free", edit_here(page).count)
    with Session.load(path, readonly=False):
        page.wait("that it is not free", lambda: edit_here(page).count() == 0)
        page.wait("a line", lambda: "was opened elsewhere again, and stays read only here." in toasts(page))
    page.wait("that it is free again", edit_here(page).count)
    monkeypatch.setattr(lock_watch, "_look", None)  # nobody looks in time
    with Session.load(path, readonly=False) as other:
        edit_here(page).click()
        page.wait("a refusal", lambda: "own.splatproj: open elsewhere" in toasts(page))
        assert page.ask(STATE)["read_only"] and studio.session.read_only
        painted(other, 0.2)
        assert len(other.layers) == 2 and len(studio.session.layers) == 1


IN_SIGHT = """() => {
  const one = [...document.querySelectorAll(".header > .button")].find((each) => each.innerText === "Edit here");
  const { x, y, right, width, height } = one.getBoundingClientRect();
  return x >= 0 && right <= innerWidth && one.contains(document.elementFromPoint(x + width / 2, y + height / 2));
}"""


@pytest.mark.slow
def test_the_button_is_in_sight_in_narrow_windows(looked_at: tuple[Session, Page, Studio]) -> None:
    holder, page, _ = looked_at
    holder.close()
    page.wait("that it is free", edit_here(page).count)
    for width, height in ((1400, 800), (900, 520), (768, 1024), (390, 844)):
        page.tab.set_viewport_size({"width": width, "height": height})
        page.wait(f"it at {width}", lambda: page.ask(IN_SIGHT))
    assert page.serious() == []
    page.tab.set_viewport_size({"width": 900, "height": 520})


def post(server: Server, name: str, **fields: Any) -> httpx.Response:
    return httpx.post(f"{server.url}api/do/{name}", json=fields, timeout=60)


def state(server: Server) -> dict[str, Any]:
    return httpx.get(f"{server.url}api/state", timeout=60).json()


def stroke(server: Server) -> None:
    """Paint a square through a studio."""
    begun = post(server, "paint.begin", camera=wire(studio_scenes.view()), kind="paint").json()["stroke"]
    pixels = np.full((12, 12, 4), (30, 40, 220, 255), np.uint8)
    post(server, "paint.dab", stroke=begun, x=40, y=40, width=12, height=12, rgba=encoded(pixels))
    assert post(server, "paint.end", stroke=begun).status_code == 200


@posix_only
@pytest.mark.slow
def test_of_two_studios_one_is_killed_and_the_other_goes_on(browser: Any, tmp_path: Path) -> None:
    """Two processes; the one that is killed has a step that the other has not seen, and finds it taken afterwards."""
    path = tmp_path / "own.splatproj"
    Session(studio_scenes.ball(), path).close()
    first, second = Server(path, tmp_path / "one"), Server(path, tmp_path / "two")
    with contextlib.ExitStack() as stack:
        for server in (first, second):
            stack.callback(server.end, crash=True)
            server.start()
        with window(browser, second.url, still=True) as page:
            stroke(first)
            assert page.ask(STATE)["read_only"] and post(second, "project.take_over").status_code == 400
            first.end(crash=True)
            page.wait("that it is free", edit_here(page).count)
            edit_here(page).click()
            page.wait("the step of the one that was killed", lambda: len(page.names()) == 1)
            assert not page.ask(STATE)["read_only"]
            first.start()
            project = state(first)["project"]
            assert project["read_only"] and not project["is_free"]
            assert post(first, "undo").status_code == 400
            stroke(second)
            page.wait("a step of its own", lambda: len(page.names()) == 2)
        second.end(crash=False)
        assert post(first, "project.take_over").status_code == 200
        assert len(state(first)["layers"]) == 2 and post(first, "undo").status_code == 200
