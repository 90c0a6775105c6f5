"""The brush of the studio's page, in a real browser: its size at every pixel setting, presets, tips, colours."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support import studio_scenes
from tests.support.studio_pages import FEW_PIXELS, Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page."""
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


def test_brushes_are_sized_chosen_kept_and_loaded(opened: tuple[studio_scenes.Live, Page], tmp_path: Path) -> None:
    """A brush covers the same share of the view at half and at full pixels; in world units it grows with the asset. A
    preset paints, is kept by the browser, and comes back from its file."""
    _, page = opened
    tab = page.tab
    radius = "window.studio.brushRadius(0.5, 0.5) / window.studio.camera.value.height"
    tab.get_by_label("Pixels").select_option("0.5")
    half = page.ask(radius)
    tab.get_by_label("Pixels").select_option("1")
    assert page.ask(radius) == pytest.approx(half, rel=1e-2)
    tab.get_by_label("Pixels").select_option(FEW_PIXELS)
    tab.get_by_label("Unit of the size").select_option("world")
    page.wait("the surface", lambda: page.ask("window.studio.surface()"))
    far = page.ask(radius)
    page.ask("window.studio.go({...window.studio.pose.value, fov: window.studio.pose.value.fov * 0.6})")
    assert page.ask(radius) > 1.4 * far
    tab.get_by_label("Unit of the size").select_option("screen")
    tab.get_by_role("tab", name="Brush").click()
    tab.locator(".presets").get_by_title("Chalk").click()
    assert tab.locator(".tips button[aria-pressed=true]").get_attribute("aria-label") == "Chalk"
    page.drag((0.42, 0.5), (0.58, 0.52))
    page.wait("a stroke", lambda: page.names() == ["Paint"])
    page.settled()
    tab.get_by_label("Name of the brush").fill("Dusty")
    tab.get_by_label("Save this brush under this name, in this browser").click()
    with tab.expect_download() as download:
        tab.get_by_label("Save your brushes to a file").click()
    saved = json.loads(Path(download.value.path()).read_text(encoding="utf-8"))
    assert [one["name"] for one in saved["brushes"]] == ["Dusty"] and saved["brushes"][0]["engine"]["tip"] == "chalk"
    saved["brushes"][0]["name"] = "Copied"
    file = tmp_path / "brushes.json"
    file.write_text(json.dumps(saved), encoding="utf-8")
    tab.locator("input[type=file][accept*=json]").set_input_files(file)
    page.wait("the brush of the file", lambda: tab.locator(".presets").get_by_title("Copied", exact=True).count())
    page.open()  # the browser remembers
    tab.get_by_role("tab", name="Brush").click()
    assert tab.locator(".presets").get_by_title("Dusty", exact=True).count() == 1
    tab.get_by_role("tab", name="Colours").click()
    tab.get_by_text("Find", exact=True).click()
    page.wait("a palette", lambda: tab.get_by_role("group", name="Colours of the asset").locator("button").count() > 3)
    tab.get_by_role("group", name="Colours of the asset").locator("button").first.click()
    chosen = tab.get_by_label("Colour", exact=True).input_value()
    assert tab.get_by_role("group", name="Recent colours").locator("button").first.get_attribute("title") == chosen
