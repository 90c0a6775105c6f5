"""A layer whose text is being changed is hidden meanwhile: only as long as the page is there that changes it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatpainter.server.held_layers import HELD, HeldLayers
from splatpainter.server.page_state import PageState
from tests.support.studio_pages import Page
from tests.support.studio_process import Server, served_page
from tests.support.systems import posix_only


@pytest.fixture
def changing(browser: Any, tmp_path: Path) -> Iterator[tuple[Server, Page]]:
    """A page in which a text, which is a layer, is being changed."""
    with served_page(browser, tmp_path) as (server, page):
        page.lay_text("TEA")
        page.settled()
        change(page)
        yield server, page


def change(page: Page) -> None:
    page.tab.get_by_role("button", name="Change Text: TEA").click()
    page.wait("it to be hidden", lambda: not visible(page))


def visible(page: Page) -> bool:
    (layer,) = page.state()["layers"]
    return layer["visible"]


def lost(page: Page) -> bool:
    return "lost" in page.tab.locator(".connection").inner_text()


@posix_only
@pytest.mark.slow
def test_a_reload_shows_the_layer_again(changing: tuple[Server, Page]) -> None:
    _, page = changing
    page.open()
    page.wait("the layer", lambda: visible(page))
    assert [step["label"] for step in page.state()["history"]][1:] == ["add Text: TEA", "show Text: TEA"]
    page.tab.get_by_role("button", name="Hide Text: TEA").click()  # hidden on purpose, it stays hidden
    page.wait("it to be hidden", lambda: not visible(page))
    page.open()
    page.tab.wait_for_timeout(3000)
    assert not visible(page)


@posix_only
@pytest.mark.slow
@pytest.mark.parametrize("crash", [True, False])
def test_a_studio_that_ends_leaves_no_layer_hidden(changing: tuple[Server, Page], crash: bool) -> None:
    server, page = changing
    server.end(crash=crash)
    page.wait("that it is gone", lambda: lost(page))
    page.tab.goto("about:blank")
    server.start()
    page.open()
    page.tab.get_by_role("button", name="Continue").click()
    page.wait("its project", lambda: page.names() == ["Text: TEA"])
    assert visible(page)


@posix_only
@pytest.mark.slow
def test_who_comes_back_goes_on_changing(changing: tuple[Server, Page]) -> None:
    """Apply waits while it is asked whether to go back, for the text is of a layer of another project."""
    server, page = changing
    tab, project = page.tab, page.state()["project"]["id"]
    server.end(crash=True)
    page.wait("that it is gone", lambda: lost(page))
    server.start()
    question = tab.get_by_role("alert").filter(has_text="The studio was started again")
    question.wait_for()
    tab.get_by_role("button", name="Apply").click()
    page.wait("a word on why not", lambda: "Apply waits for your answer" in tab.locator(".toasts").inner_text())
    assert page.names() == [] and page.state()["project"]["id"] != project
    question.get_by_role("button", name="Continue").click()
    page.wait("their project", lambda: page.state()["project"]["id"] == project)
    page.wait("it to be hidden again", lambda: not visible(page))
    tab.get_by_role("textbox", name="Text", exact=True).fill("MILK")
    tab.get_by_role("button", name="Apply").click()
    page.wait("the other words in the same layer", lambda: page.names() == ["Text: MILK"] and visible(page))


@posix_only
@pytest.mark.slow
def test_who_stays_lays_a_layer_of_its_own(changing: tuple[Server, Page]) -> None:
    server, page = changing
    server.end(crash=True)
    page.wait("that it is gone", lambda: lost(page))
    server.start()
    page.tab.get_by_role("button", name="Stay here").click()
    page.tab.get_by_role("button", name="Apply").click()
    page.wait("a layer here", lambda: page.names() == ["Text: TEA"])
    page.settled()
    assert [step["label"] for step in page.state()["history"]][1:] == ["add Text: TEA"]


@posix_only
@pytest.mark.slow
def test_a_lost_connection_shows_it_until_it_is_back(changing: tuple[Server, Page]) -> None:
    _, page = changing
    page.tab.context.set_offline(True)
    page.ask("window.studio.link.lose()")
    page.tab.wait_for_timeout(3500)
    page.tab.context.set_offline(False)
    page.wait("the connection", lambda: not lost(page))
    page.wait("it to be hidden again", lambda: not visible(page))
    page.tab.keyboard.press("Escape")
    page.wait("it as it was", lambda: visible(page))


def test_only_what_is_hidden_to_be_changed_is_held() -> None:
    """A layer that was switched off by its eye, in whatever gesture, stays so when the page goes."""
    held, page, other = HeldLayers(), PageState("one"), PageState("other")
    for layer, visible, gesture in (("1", False, None), ("2", False, "eyes 4"), ("3", True, f"{HELD}3 5")):
        held.note(page, layer, visible, gesture)
        assert not held.of(page)
    held.note(page, "4", False, f"{HELD}4 6")
    assert held.of(page) and not held.of(other)
    held.note(page, "4", True, None)
    assert not held.of(page)
