"""The first minutes: the tour, and files that are dropped anywhere on the window."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatpainter.io import write
from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page

DROP_LINK = """([address, selector]) => {
  const dataTransfer = new DataTransfer();
  dataTransfer.setData("text/uri-list", "# from another window\\r\\n" + address);
  const drop = new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true });
  document.querySelector(selector).dispatchEvent(drop);
  return drop.defaultPrevented;
}"""


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    with opened_page(browser, tmp_path, still=True) as (live, page):
        yield live, page


def test_the_tour_goes_by_keys_is_skipped_and_comes_back(opened: tuple[studio_scenes.Live, Page]) -> None:
    """It does not come by itself where a program drives the browser; axe's rules for dialogues hold."""
    _, page = opened
    card = page.tab.locator(".tour")
    assert card.count() == 0
    page.url = page.tab.url.split("?")[0] + "?tour"
    page.open()
    card.wait_for()
    assert card.get_attribute("role") == "dialog"
    titles = []
    for k in range(5):
        page.wait("focus", lambda: page.ask("document.activeElement.className").find("primary") >= 0)
        assert card.locator("p").first.inner_text() == f"{k + 1} of 5"
        titles.append(card.get_by_role("heading").inner_text())
        assert page.ask("document.querySelector('.tour').getAttribute('aria-labelledby')") == "tour-title"
        framed = page.tab.locator(".tour-frame").bounding_box()
        assert framed["width"] * framed["height"] > 2000
        box, size = card.bounding_box(), page.tab.viewport_size
        assert box["x"] >= 0 and box["x"] + box["width"] <= size["width"] and box["y"] + box["height"] <= size["height"]
        page.tab.keyboard.press("ArrowRight" if k % 2 else "Enter")
    assert titles == ["Look around", "Paint", "Layers", "Nothing is lost", "Share it"]
    page.wait("end", lambda: card.count() == 0)
    assert page.ask("document.activeElement.id") == "stage"
    assert page.ask("localStorage.getItem('splatpainter.tour')") == "seen"
    page.tab.keyboard.press("Shift+?")
    page.tab.get_by_role("button", name="Tour").click()
    card.wait_for()
    page.wait("focus", lambda: page.ask("document.activeElement.className").find("primary") >= 0)
    page.tab.keyboard.press("b")
    page.tab.keyboard.press("Escape")
    page.wait("end", lambda: card.count() == 0)


def test_files_and_links_from_other_windows(opened: tuple[studio_scenes.Live, Page], tmp_path: Path) -> None:
    """A file opens wherever it is dropped, also on the list of layers; a link that may not be read says what to do, and
    the page stays."""
    live, page = opened
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("a layer", lambda: page.names())
    assert page.ask(DROP_LINK, ["https://example.com/a%20b.ply?x=1", ".layer"])
    page.wait("why", lambda: page.tab.get_by_text("a b.ply is a link.").count())
    write(tmp_path / "small.ply", studio_scenes.ball(70))
    made = live.studio.downloads.folder() / "other.ply"
    made.write_bytes((tmp_path / "small.ply").read_bytes())
    address = live.url + live.studio.downloads.add(made)
    assert page.ask(DROP_LINK, [address, "footer"])
    page.wait("the asset", lambda: page.state()["asset"]["name"] == "other.ply")
    assert page.state()["asset"]["gaussians"] == 70
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("a layer", lambda: page.names())
    page.ask(
        "document.querySelector('.app').classList.remove('app'), document.querySelector('.layer').classList.add('app')"
    )
    write(tmp_path / "tiny.ply", studio_scenes.ball(50))
    page.drop("tiny.ply", (tmp_path / "tiny.ply").read_bytes(), "")
    page.wait("the asset", lambda: page.state()["asset"]["name"] == "tiny.ply")
