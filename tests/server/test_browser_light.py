"""The panel of new light in a real browser: each gesture is a step, and undo gives the captured light back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page, on which nothing glides."""
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


def test_a_light_is_a_layer_whose_gestures_are_steps(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    first, before = page.pixels(), live.studio.session.splats
    page.tab.get_by_role("tab", name="Light").click()
    page.wait("thumbnails", lambda: page.tab.locator(".skies img").count() == 8)
    assert page.ask("[...document.querySelectorAll('.skies img')].every((one) => one.decode())")
    page.tab.get_by_role("radio", name="Sunset").click()
    page.wait("the layer", lambda: page.names() == ["Light"])
    page.wait("its look", lambda: np.abs(page.pixels() - first).mean() > 0.001)
    lit, count = page.pixels(), len(page.state()["history"])

    def options() -> dict[str, Any]:
        return page.state()["layers"][0]["parameters"]

    page.tab.get_by_role("button", name="Sun", exact=True).click()
    page.wait("the sun", lambda: len(options().get("sun", ())) == 1)
    start = options()["sun"]
    page.tab.locator(".sun-ball").scroll_into_view_if_needed()
    ball = page.tab.locator(".sun-ball").bounding_box()
    x, y = ball["x"] + ball["width"] / 2, ball["y"] + ball["height"] / 2
    page.tab.mouse.move(x, y)
    page.tab.mouse.down()
    still = page.pixels()
    page.tab.mouse.move(x - 40, y, steps=8)
    page.wait("the light that follows", lambda: np.abs(page.pixels() - still).mean() > 0.001)
    assert options()["sun"] == start and len(page.state()["history"]) == count + 1, "nothing is a step yet"
    page.tab.mouse.up()
    page.wait("the sun from the left", lambda: float(options()["sun"][0].split(",")[0]) < -30)
    page.wait("an idle panel", lambda: page.tab.locator(".layer .spinner").count() == 0)
    assert len(page.state()["history"]) == count + 2, "adding it and dragging it are two steps"

    slider = page.tab.get_by_role("textbox", name="New look, number")
    slider.fill("50")
    slider.press("Enter")
    page.wait("half of it", lambda: page.state()["layers"][0]["opacity"] == 0.5)
    page.tab.get_by_role("button", name="Before: hide this light").click()
    page.wait("the captured light", lambda: np.array_equal(page.pixels(), first))
    assert len(page.state()["history"]) == count + 4
    for _ in range(3):
        page.tab.keyboard.press("Control+z")
    page.wait("the sun where it was", lambda: options()["sun"] == start)
    page.tab.keyboard.press("Control+z")
    page.wait("the sky alone", lambda: "sun" not in options() and np.array_equal(page.pixels(), lit))
    assert page.tab.get_by_role("radio", name="Sunset").get_attribute("aria-checked") == "true"
    assert page.tab.locator(".sun-ball").count() == 0
    page.tab.get_by_role("radio", name="None").click()
    page.wait("no layer without light", lambda: page.names() == [])
    assert page.serious() == []
    page.tab.keyboard.press("Control+z")
    page.wait("it again", lambda: page.names() == ["Light"])
    page.tab.keyboard.press("Control+z")
    page.wait("the captured light", lambda: page.names() == [] and np.array_equal(page.pixels(), first))
    assert (live.studio.session.splats.sh == before.sh).all()


def test_what_is_selected_is_pixelated(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    before = live.studio.session.splats
    page.tab.get_by_role("tab", name="Select").click()
    page.tab.locator("summary", has_text="Pixelate").click()
    button = page.tab.locator(".selection-panel").get_by_role("button", name="Pixelate", exact=True)
    assert button.is_disabled(), "nothing is selected"
    page.tab.keyboard.press("Control+a")
    page.wait("all of it", lambda: page.state()["selection"]["gaussians"] == len(before))
    size = page.tab.get_by_role("textbox", name="Cell, number")
    size.fill("20")
    size.press("Enter")
    page.tab.get_by_label("Style").select_option("blur")
    button.click()
    page.wait("the layer", lambda: page.names() == ["Pixelate"])
    options = page.state()["layers"][0]["parameters"]
    assert (options["size"], options["style"]) == ("20%", "blur")
    assert (live.studio.session.splats.sh[:, 1:] == 0).all()
    page.tab.keyboard.press("Control+z")
    page.wait("no layer", lambda: page.names() == [])
    assert (live.studio.session.splats.sh == before.sh).all()
