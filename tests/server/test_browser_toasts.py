"""What the studio says in a corner of the view is not in the way of the pen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.support.studio_pages import opened_page

UNDER = """(toast) => {
    const at = (element) => {
        const box = element.getBoundingClientRect();
        return document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
    };
    const button = toast.querySelector("button");
    return [at(toast.querySelector("p")).closest("#stage") !== null, button.contains(at(button))];
}"""


def test_a_stroke_goes_through_what_is_said(browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True) as (_, page):
        page.tab.keyboard.press("s")
        page.drag((0.5, 0.5), (0.55, 0.5))
        toast = page.tab.locator(".toast", has_text="Choose where to copy from")
        page.wait("a word", toast.count)
        assert toast.first.evaluate(UNDER) == [True, True]
        page.tab.keyboard.press("b")
        box, stage = toast.first.locator("p").bounding_box(), page.tab.locator("#stage").bounding_box()
        x = (box["x"] + box["width"] / 2 - stage["x"]) / stage["width"]
        y = (box["y"] + box["height"] / 2 - stage["y"]) / stage["height"]
        page.drag((x, y), (0.5, 0.5))
        page.wait("its layer", lambda: page.names() == ["Paint"])
