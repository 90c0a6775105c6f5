"""Two windows of real browsers on one studio: they paint in turn and at the same time, and end up with the same asset,
bit for bit, and with every stroke of both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page, window

VERSION = "window.studio.state.value.version"


@pytest.fixture
def windows(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page, Page]]:
    """A studio with the ball, and two pages, which must not complain."""
    with opened_page(browser, tmp_path, still=True) as (live, one):
        with window(browser, live.url, still=True) as two:
            yield live, one, two


def strokes(page: Page) -> int:
    return sum(layer["strokes"] or 0 for layer in page.state()["layers"])


def exported_asset(page: Page) -> bytes:
    """The PLY that a window's own export gives."""
    page.tab.keyboard.press("Control+s")
    page.tab.locator(".formats label", has=page.tab.get_by_text("PLY", exact=True)).click()
    with page.tab.expect_download() as download:
        page.tab.locator("dialog").get_by_role("button", name="Export", exact=True).click()
    return Path(download.value.path()).read_bytes()


def together(one: Page, two: Page) -> None:
    """Both windows have everything and say the same."""
    for page in (one, two):
        page.settled()
    one.wait("one version", lambda: one.ask(VERSION) == two.ask(VERSION))
    ignored = {"clients"}
    first, second = ({k: v for k, v in page.state().items() if k not in ignored} for page in (one, two))
    assert first == second
    count = "window.studio.viewer.count"
    one.wait("the same Gaussians", lambda: one.ask(count) == two.ask(count))  # a busy page takes them in slices


def test_two_windows_paint_in_turn_and_at_once(windows: tuple[studio_scenes.Live, Page, Page], tmp_path: Path) -> None:
    live, one, two = windows
    for k, page in enumerate((one, two, one, two)):  # in turn
        page.drag((0.42 + 0.04 * k, 0.45), (0.44 + 0.04 * k, 0.45))
        page.settled()
        one.wait(f"{k + 1} strokes", lambda k=k: strokes(one) == strokes(two) == k + 1)
    together(one, two)
    for x in (0.44, 0.5):  # both pens are down at once, and up in either order
        one.pointer("down", 1, "pen", x, 0.55)
        two.pointer("down", 1, "pen", x, 0.6)
        for step in range(3):
            one.pointer("move", 1, "pen", x + 0.01 * step, 0.55)
            two.pointer("move", 1, "pen", x + 0.01 * step, 0.6)
        for page in (one, two) if x < 0.45 else (two, one):
            page.pointer("up", 1, "pen", x + 0.03, 0.58)
    one.wait("all strokes", lambda: strokes(one) == strokes(two) == 8)
    together(one, two)
    assert len(live.studio.session.history) == 9

    np.testing.assert_array_equal(one.pixels(), two.pixels())
    exported = [exported_asset(page) for page in (one, two)]
    assert exported[0] == exported[1]
    live.studio.session.files.export(tmp_path / "session.ply")
    assert exported[0] == (tmp_path / "session.ply").read_bytes()
    assert live.studio.session.verify() == []


def test_first_strokes_at_once_and_one_history_for_both(windows: tuple[studio_scenes.Live, Page, Page]) -> None:
    """Two first strokes make two layers. Undo takes back the latest step, whoever made it, and says so in the other
    window; a stroke whose layer went away under the pen becomes a layer of its own."""
    live, one, two = windows
    for page, y in ((one, 0.45), (two, 0.55)):
        page.pointer("down", 1, "pen", 0.45, y)
        page.pointer("move", 1, "pen", 0.5, y)
    for page in (one, two):
        page.pointer("up", 1, "pen", 0.5, 0.5)
    one.wait("both strokes", lambda: strokes(one) == strokes(two) == 2)
    together(one, two)
    one.pointer("down", 1, "pen", 0.45, 0.6)
    one.pointer("move", 1, "pen", 0.5, 0.6)
    for left in (1, 0):
        two.tab.keyboard.press("Control+z")
        two.wait("the undo", lambda n=left: strokes(two) == n)
    one.wait("the news", lambda: one.tab.get_by_text("Another window undid: Brush in Paint").count())
    one.pointer("up", 1, "pen", 0.52, 0.6)
    one.wait("the stroke", lambda: strokes(one) == strokes(two) == 1)
    together(one, two)
    assert one.names() == ["Paint"] and [step["label"] for step in one.state()["history"]] == ["open", "Brush in Paint"]
    one.drag((0.45, 0.5), (0.5, 0.5))  # it is the chosen layer now
    one.wait("the next stroke", lambda: strokes(two) == 2)
    together(one, two)
    assert len(live.studio.session.layers) == 1
