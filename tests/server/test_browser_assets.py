"""Several assets in the studio's page: added from a file, moved by numbers and by handles, painted, undone, removed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.io import write
from tests.support import studio_scenes
from tests.support.lift_scenes import sheet
from tests.support.studio_pages import Page, opened_page

COVERED = """[...document.querySelectorAll(".asset-handles .grab.ring, .asset-handles .middle")].filter((handle) => {
  const box = handle.getBoundingClientRect();
  return document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2) !== handle;
}).map((handle) => handle.textContent)"""
"""Handles that another one lies over."""


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    with opened_page(browser, tmp_path, still=True, resolution="0.35") as (live, page):
        yield live, page


def asset(page: Page, number: int) -> dict[str, Any]:
    return page.state()["assets"][number]


def pull(opened: tuple[studio_scenes.Live, Page], title: str, x: float, y: float) -> None:
    """Drag a handle by CSS pixels, once it stands still: handles follow what the server says of their asset."""
    live, page = opened
    page.settled()
    page.wait("the server's state", lambda: page.state()["version"] == live.studio.session.version)
    handle = page.tab.locator(".asset-handles .grab").filter(has=page.tab.locator(f"title:text-is('{title}')"))
    boxes: list[Any] = [None]
    page.wait("a handle at rest", lambda: boxes.append(handle.bounding_box()) or boxes[-1] == boxes[-2])
    box = boxes[-1]
    at = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.tab.mouse.move(*at)
    page.tab.mouse.down()
    for k in range(1, 5):
        page.tab.mouse.move(at[0] + x * k / 4, at[1] + y * k / 4)
    page.tab.mouse.up()


def test_a_second_asset_is_added_moved_painted_and_removed(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path
) -> None:
    live, page = opened
    write(tmp_path / "rug.ply", sheet(30, degree=1, half=0.6))
    near = page.ask("window.studio.pose.value.distance")
    page.tab.get_by_role("button", name="Add asset...").click()
    with page.tab.expect_file_chooser() as chooser:
        page.tab.locator("dialog").get_by_role("button", name="Choose a file").click()
    chooser.value.set_files(tmp_path / "rug.ply")
    page.wait("two assets", lambda: len(page.state()["assets"]) == 2)
    page.wait("its numbers", lambda: page.tab.get_by_label("Move X, number").count())
    page.wait("both in the window", lambda: page.ask("window.studio.pose.value.distance") > 1.2 * near)
    page.tab.set_viewport_size({"width": 1100, "height": 900})
    rows = page.tab.locator(".layer-list").evaluate("(list) => list.clientHeight / 43")
    assert rows > 5, "the list of layers keeps room beside the assets and the numbers of the chosen one"
    page.tab.set_viewport_size({"width": 900, "height": 520})
    field = page.tab.get_by_label("Move X, number")
    field.fill("0.2")
    field.press("Enter")
    page.wait("it to move", lambda: asset(page, 1)["move"][0] == 0.2)
    page.wait("the view", lambda: page.ask("window.studio.viewer.count") == len(live.studio.session.splats))
    before = asset(page, 1)
    pull(opened, "Move in the view", 60, 10)
    page.wait("a drag", lambda: asset(page, 1)["move"] != before["move"])
    pull(opened, "Scale: drag to the right or left", 40, 0)
    page.wait("a larger one", lambda: asset(page, 1)["scale"] > 1.1)
    pull(opened, "Turn about Z", 20, 30)
    page.wait("a turn", lambda: abs(asset(page, 1)["turn"][2]) > 1)
    page.tab.keyboard.press("Numpad1")  # along an axis: its disc stands aside
    page.wait("no handle under another", lambda: page.ask(COVERED) == [])
    page.tab.keyboard.press("Numpad0")
    middle = np.array(asset(page, 1)["center"])
    page.settled()
    labels = [step["label"] for step in page.state()["history"]]
    assert labels == ["open", "add asset rug.ply", *["move asset rug.ply"] * 4], labels
    page.tab.locator(".asset-list .layer-name").last.click()  # no handles over the view
    page.tab.keyboard.press("b")
    page.drag((0.45, 0.5), (0.75, 0.5))
    page.settled()
    assert {layer["asset"] for layer in page.state()["layers"]} == {"", asset(page, 1)["id"]}
    assert len(page.state()["history"]) == 7
    page.tab.get_by_role("button", name="Hide asset rug.ply").click()
    page.wait("it to be hidden", lambda: not asset(page, 1)["visible"])
    page.tab.get_by_role("button", name="Remove asset rug.ply").click()
    page.wait("one asset", lambda: len(page.state()["assets"]) == 1)
    assert [layer["asset"] for layer in page.state()["layers"]] == [""]
    for _ in range(2):
        page.tab.keyboard.press("Control+z")
    page.wait("both again", lambda: len(page.state()["assets"]) == 2 and asset(page, 1)["visible"])
    np.testing.assert_allclose(asset(page, 1)["center"], middle, atol=1e-6)
    page.wait("the view", lambda: page.ask("window.studio.viewer.count") == len(live.studio.session.splats))
