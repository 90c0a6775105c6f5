"""Every tool by pen and by finger, without mouse and keyboard, in a real browser; and which tools symmetry mirrors."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.server.uploads.image_registration import png_bytes
from tests.support import studio_scenes
from tests.support.studio_pages import POINTER, Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


class Hand:
    """A pen or a finger."""

    def __init__(self, page: Page, kind: str) -> None:
        self.page, self.kind, self.number = page, kind, 20

    def tool(self, name: str) -> None:
        """Touch a button of the toolbar."""
        self.page.tab.locator(".toolbar").get_by_role("button", name=name, exact=True).click()

    def drag(self, *points: tuple[float, float]) -> None:
        """Down, along, up; shares of the view."""
        self.number += 1
        self.page.pointer("down", self.number, self.kind, *points[0])
        for point in points[1:]:
            self.page.pointer("move", self.number, self.kind, *point)
        self.page.pointer("up", self.number, self.kind, *points[-1], 0.0)

    def step(self, label: str) -> None:
        """The newest step is this one, and it is saved."""
        self.page.wait(f"{label} by {self.kind}", lambda: self.newest().startswith(label))
        self.page.settled()

    def newest(self) -> str:
        state = self.page.state()
        return state["history"][state["cursor"]]["label"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pen", "touch"])
def test_every_tool_answers(opened: tuple[studio_scenes.Live, Page], kind: str) -> None:
    _, page = opened
    hand, tab = Hand(page, kind), page.tab
    hand.tool("Brush")
    hand.drag((0.42, 0.45), (0.5, 0.45), (0.58, 0.45))
    hand.step("Brush in Paint")
    tab.get_by_role("tab", name="Brush").click()
    tab.locator(".tips input[type=file]").set_input_files(
        {"name": "cross.png", "mimeType": "image/png", "buffer": cross()}
    )
    page.wait("the tip of the picture", lambda: "A picture" in tab.locator(".tips").inner_text())
    hand.drag((0.45, 0.4), (0.55, 0.4))
    hand.step("Brush in Paint")
    tab.locator(".presets").get_by_title("Round", exact=True).click()
    tab.get_by_role("button", name="Mask of the layer").click()
    mask = tab.get_by_role("group", name="Mask of Paint")
    mask.get_by_role("button", name="Paint").click()
    page.wait("the mask", lambda: page.state()["layers"][0]["mask"])
    hand.drag((0.42, 0.45), (0.45, 0.45))
    hand.step("Hide in the mask of Paint")
    mask.get_by_role("button", name="Remove").click()
    page.wait("no mask", lambda: page.state()["layers"][0]["mask"] is None)
    tab.get_by_role("button", name="Mask of the layer").click()
    hand.tool("Line")
    hand.drag((0.42, 0.55), (0.58, 0.58))
    hand.step("Line in Paint")
    hand.tool("Eraser")
    hand.drag((0.5, 0.45), (0.58, 0.45))
    hand.step("Erase in Paint")
    hand.tool("Clone")
    tab.get_by_role("button", name="Set the source").click()
    hand.drag((0.44, 0.45))
    hand.drag((0.5, 0.62), (0.53, 0.62))
    hand.step("Clone in Paint")
    hand.tool("Heal")
    hand.drag((0.5, 0.62), (0.53, 0.62))
    hand.step("Heal in Paint")
    hand.tool("Paint bucket")
    hand.drag((0.5, 0.35))
    hand.step("Bucket in Paint")
    hand.tool("Eyedropper, as seen")
    before = tab.get_by_role("textbox", name="Colour", exact=True).input_value()
    hand.drag((0.56, 0.68))
    page.wait("a colour", lambda: tab.get_by_role("textbox", name="Colour", exact=True).input_value() != before)
    hand.tool("Text")
    tab.get_by_role("checkbox", name="On the surface", exact=True).uncheck()
    hand.drag((0.5, 0.5))
    page.wait("the text", lambda: tab.get_by_role("button", name="Apply").count())
    tab.get_by_role("button", name="Apply").click()
    page.wait("its layer", lambda: len(page.names()) == 2)
    hand.step("add Text")
    hand.tool("Select an area to paint in")
    for select, points in (
        ("rectangle", [(0.44, 0.4), (0.5, 0.5)]),
        ("lasso", [(0.45, 0.4), (0.55, 0.4), (0.55, 0.5), (0.45, 0.5)]),
        ("brush", [(0.45, 0.6), (0.55, 0.6)]),
        ("color", [(0.5, 0.4)]),
    ):
        tab.locator(".options").get_by_label("Select", exact=True).select_option(select)
        revision = page.state()["selection"]["revision"]
        hand.drag(*points)
        page.wait(f"a selection: {select}", lambda r=revision: page.state()["selection"]["revision"] > r)
        page.wait("Gaussians in it", lambda: page.state()["selection"]["gaussians"])
    hand.tool("Turn the view")
    eye = page.camera()["world_to_camera"]
    hand.drag((0.4, 0.5), (0.5, 0.5))
    page.wait("another view", lambda: page.camera()["world_to_camera"] != eye)


@pytest.mark.slow
def test_symmetry_mirrors_strokes_and_says_where_it_does_not(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    tab, keys = page.tab, page.tab.keyboard
    keys.press("b")
    tab.locator(".options").get_by_role("button", name="Symmetry").click()
    tab.get_by_role("tab", name="Brush").click()
    tab.get_by_label("Plane", exact=True).select_option("x")
    page.wait("the plane", lambda: page.state() is not None)

    def touched(points: list[tuple[float, float]]) -> tuple[int, int]:
        """How many Gaussians left and right of the plane a stroke changed."""
        before = live.studio.session.splats
        page.drag(*points)
        version = live.studio.session.version
        page.wait("the stroke", lambda: live.studio.session.version > version or not same(before))
        page.settled()
        after = live.studio.session.splats
        n = min(len(before), len(after))
        changed = (before.sh[:n] != after.sh[:n]).any((1, 2)) | (before.opacities[:n] != after.opacities[:n])
        points_after = np.concatenate([before.means[:n][changed], after.means[n:]])
        return int((points_after[:, 0] < -0.05).sum()), int((points_after[:, 0] > 0.05).sum())

    def same(before: Any) -> bool:
        return live.studio.session.splats is before

    points = [(0.42, 0.45), (0.44, 0.45)]
    assert min(touched(points)) > 0, "brush: on both sides"
    keys.press("j")
    assert "healing stays on this side" in tab.locator(".options").inner_text()
    left, right = touched([(0.42, 0.6), (0.44, 0.6)])
    assert (left == 0) != (right == 0), "heal: on one side"
    for key, words in (("t", "text is placed"), ("m", "only this side is selected"), ("p", "pictures are placed")):
        keys.press(key)
        page.wait(words, lambda w=words: w in tab.locator(".options").inner_text())
    keys.press("b")
    tab.locator(".options").get_by_role("button", name="Symmetry").click()
    page.wait("no hint", lambda: "Symmetry:" not in tab.locator(".options").inner_text())


RAW = """([type, x, y, pressure, buttons]) => {
  const stage = document.getElementById("stage");
  const box = stage.getBoundingClientRect();
  stage.setPointerCapture = () => {};
  stage.dispatchEvent(new PointerEvent(type, {
    pointerId: 40, pointerType: "pen", pressure, buttons, button: type === "pointerdown" ? 0 : -1,
    clientX: box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true, cancelable: true,
  }));
}"""
"""One event of a pen, as the system sends it: with what is pressed."""


def widths(live: studio_scenes.Live, page: Page, *positions: float) -> list[int]:
    """Rows of the latest stroke's mask at shares of the view's width."""
    digest = page.state()["layers"][-1]["views"][-1]["mask"]
    picture = Image.open(io.BytesIO(live.http.get(f"/api/blobs/{digest}").content)).convert("L")
    mask = np.asarray(picture) > 127
    return [int(mask[:, int(x * mask.shape[1])].sum()) for x in positions]


@pytest.mark.slow
def test_a_pen_presses_from_nothing_is_taken_back_and_ends_where_it_was_seen(browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True, resolution="1") as (live, page):
        keys = page.tab.keyboard
        keys.press("b")

        def pen(event: str, x: float, y: float, pressure: float = 0.5, buttons: int = 1) -> None:
            page.ask(RAW, [f"pointer{event}", x, y, pressure, buttons])

        def strokes() -> int:
            return sum(layer["strokes"] for layer in page.state()["layers"])

        # the first contact says 0: no blot
        pen("down", 0.42, 0.4, 0.0)
        for k in range(1, 8):
            pen("move", 0.42 + 0.02 * k, 0.4, 0.1)
        pen("up", 0.56, 0.4, 0.0, 0)
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        start, end = widths(live, page, 0.425, 0.54)
        assert 0 < start <= end < 14, (start, end)

        # Ctrl-Z with the pen down takes back that stroke and no earlier one
        pen("down", 0.42, 0.5)
        pen("move", 0.5, 0.5)
        keys.press("Control+z")
        pen("move", 0.55, 0.5)
        pen("up", 0.55, 0.5, 0.0, 0)
        page.settled()
        assert strokes() == 1 and page.state()["cursor"] == 1

        # ... and right after it went up, that stroke and no earlier one
        pen("down", 0.42, 0.5)
        pen("move", 0.5, 0.5)
        pen("up", 0.5, 0.5, 0.0, 0)
        keys.press("Control+z")
        page.settled()
        page.wait("the first one alone", lambda: strokes() == 1 and page.state()["cursor"] == 1)

        # a move without a button: its end was not seen
        pen("down", 0.42, 0.55)
        pen("move", 0.48, 0.55)
        pen("move", 0.6, 0.65, 0.0, 0)
        page.wait("that stroke", lambda: strokes() == 2)
        page.settled()
        assert widths(live, page, 0.46, 0.56)[0] > 0 == widths(live, page, 0.56)[0]

        # taken away by the system: what it drew stays
        pen("down", 0.42, 0.6)
        pen("move", 0.5, 0.6)
        pen("cancel", 0.5, 0.6, 0.0, 0)
        page.wait("that stroke, too", lambda: strokes() == 3)
        page.settled()


@pytest.mark.slow
def test_the_barrel_of_a_pen_turns_the_view_and_its_other_end_erases(browser: Any, tmp_path: Path) -> None:
    """Pointer events say button 5 of the eraser and 2 of the barrel (W3C's Pointer Events 3, 5.1.1.2)."""
    pen = RAW.replace("[type, x, y, pressure, buttons]", "[type, x, y, pressure, buttons, button]")
    pen = pen.replace('button: type === "pointerdown" ? 0 : -1', "button")
    with opened_page(browser, tmp_path, still=True, resolution="1") as (_, page):
        page.tab.keyboard.press("b")

        def drawn(y: float, *pressed: tuple[int, int]) -> None:
            """From left to right; pressed: (buttons, button) at the first point and at those where they change."""
            for k, (buttons, button) in enumerate(pressed):
                page.ask(pen, ["pointermove" if k else "pointerdown", 0.42 + 0.05 * k, y, 0.5, buttons, button])
                page.ask(pen, ["pointermove", 0.45 + 0.05 * k, y, 0.5, buttons, -1])
            page.ask(pen, ["pointerup", 0.4 + 0.05 * len(pressed), y, 0.0, 0, pressed[0][1]])

        def labels() -> list[str]:
            page.settled()
            return [step["label"] for step in page.state()["history"]][1:]

        drawn(0.45, (1, 0))
        page.wait("a stroke", lambda: labels() == ["Brush in Paint"])
        drawn(0.46, (32, 5))
        page.wait("that it is erased", lambda: labels() == ["Brush in Paint", "Erase in Paint"])
        # The barrel pressed during a stroke changes nothing; alone it turns the view, as the right button does.
        drawn(0.55, (1, 0), (3, 2), (1, 2))
        page.wait("one stroke", lambda: labels()[2:] == ["Brush in Paint"])
        before = page.camera()["world_to_camera"]
        drawn(0.5, (2, 2), (2, -1))
        page.tab.wait_for_timeout(500)
        assert len(labels()) == 3
        assert page.camera()["world_to_camera"] != before


@pytest.mark.slow
def test_a_stroke_ends_where_the_window_was_resized_under_it(browser: Any, tmp_path: Path) -> None:
    """It went on in the pixels of the new view, and lay beside the pen."""
    with opened_page(browser, tmp_path, still=True) as (live, page):
        page.tab.keyboard.press("b")
        page.pointer("down", 50, "pen", 0.42, 0.5)
        page.pointer("move", 50, "pen", 0.5, 0.5)
        drawn_in = page.camera()
        page.tab.set_viewport_size({"width": 700, "height": 480})
        page.wait("another view", lambda: page.camera()["width"] != drawn_in["width"])
        page.pointer("move", 50, "pen", 0.6, 0.75)
        page.pointer("up", 50, "pen", 0.6, 0.75, 0.0)
        page.wait("what was drawn", lambda: page.names() == ["Paint"])
        page.settled()
        view = page.state()["layers"][-1]["views"][-1]
        assert view["camera"]["width"] == drawn_in["width"]
        assert widths(live, page, 0.46)[0] > 0 == sum(widths(live, page, 0.56, 0.6, 0.65))
        page.drag((0.45, 0.4), (0.55, 0.4))
        page.wait("the next one", lambda: page.state()["layers"][-1]["strokes"] == 2)
        page.settled()


@pytest.mark.slow
def test_a_stroke_reads_the_view_that_it_is_drawn_on(opened: tuple[studio_scenes.Live, Page]) -> None:
    """A button that moves the camera right after a quick stroke: it read the pixels of the next view."""
    _, page = opened
    page.tab.keyboard.press("b")
    page.drag((0.45, 0.4), (0.55, 0.4))  # the view is read anew after it
    page.wait("a stroke", lambda: page.names() == ["Paint"])
    page.settled()
    page.ask(f"() => {{ window.pointer = {POINTER}; }}")
    before, meanwhile = page.ask("""() => {
      const { viewer, camera } = window.studio;
      const before = JSON.stringify(camera.value);
      viewer.revision++;  // what was read of it counts no more
      for (const [type, x] of [["down", 0.45], ["move", 0.5], ["up", 0.5]])
        window.pointer([`pointer${type}`, 60, "touch", x, 0.6, 0.5]);
      window.studio.go({ ...window.studio.pose.value, fov: 70 });
      return [before, JSON.stringify(camera.value)];
    }""")
    assert meanwhile == before, "the camera waits until the stroke has read it"
    page.wait("the other view", lambda: page.camera() != json.loads(before))
    page.wait("the stroke", lambda: page.state()["layers"][0]["strokes"] == 2)
    page.settled()


@pytest.mark.slow
@pytest.mark.parametrize("palm", ["before", "within"])
def test_the_palm_of_the_hand_that_draws_ends_no_stroke(palm: str, opened: tuple[studio_scenes.Live, Page]) -> None:
    """It dropped the stroke and turned the view; one that lay there first turned it once the pen was up."""
    _, page = opened
    page.tab.keyboard.press("b")
    page.pointer("down", 30, "pen", 0.42, 0.4)  # a pen was seen: fingers turn the view
    page.pointer("up", 30, "pen", 0.42, 0.4, 0.0)
    page.wait("a dab", lambda: page.names() == ["Paint"])
    page.settled()
    eye = page.camera()["world_to_camera"]
    if palm == "before":
        page.pointer("down", 32, "touch", 0.6, 0.7)
    page.pointer("down", 31, "pen", 0.44, 0.55)
    page.pointer("move", 31, "pen", 0.47, 0.55)
    if palm == "within":
        page.pointer("down", 32, "touch", 0.6, 0.7)
    page.pointer("move", 32, "touch", 0.65, 0.75)
    page.pointer("move", 31, "pen", 0.52, 0.55)
    page.pointer("up", 31, "pen", 0.52, 0.55, 0.0)
    page.pointer("move", 32, "touch", 0.72, 0.8)
    page.pointer("up", 32, "touch", 0.65, 0.75)
    page.wait("the stroke", lambda: page.state()["layers"][0]["strokes"] == 2)
    page.settled()
    assert page.camera()["world_to_camera"] == eye


@pytest.mark.slow
def test_a_pen_without_pressure_paints(browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True, resolution="1") as (live, page):
        page.tab.keyboard.press("b")
        page.ask(RAW, ["pointerdown", 0.42, 0.5, 0.0, 1])
        for k in range(1, 10):
            page.ask(RAW, ["pointermove", 0.42 + 0.015 * k, 0.5, 0.0, 1])
        page.ask(RAW, ["pointerup", 0.56, 0.5, 0.0, 0])
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        start, end = widths(live, page, 0.44, 0.54)
        assert start == end > 15, "as wide as half of the pressure, all along"


def cross() -> bytes:
    """A PNG of a dark cross on white."""
    pixels = np.full((16, 16), 255, np.uint8)
    pixels[6:10] = pixels[:, 6:10] = 0
    return png_bytes(np.repeat(pixels[..., None], 3, -1))
