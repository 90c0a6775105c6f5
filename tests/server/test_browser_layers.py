"""Layers in the studio's page, in a real browser: strokes, texts, erasers and masks, what the panel says, and what is
offered again."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page

OPAQUE_PREVIEW = """() => {
  const overlay = document.querySelector(".cursor-overlay");
  const canvas = new OffscreenCanvas(overlay.width, overlay.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(overlay, 0, 0);
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let k = 3; k < data.length; k += 4) count += data[k] > 200 ? 1 : 0;
  return count;
}"""
"""Opaque pixels of what is drawn over the view."""


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page."""
    with opened_page(browser, tmp_path) as both:
        yield both


def test_every_painting_tool_paints(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Strokes, and the eraser's, go into the chosen paint layer; a text, and with Shift the eraser, are layers."""
    _, page = opened
    keys = page.tab.keyboard

    def painted(step: str, names: list[str]) -> None:
        page.wait(f"the step {step}", lambda: page.state()["history"][-1]["label"].startswith(step))
        page.settled()
        assert [name.split(":")[0] for name in page.names()] == names

    keys.press("u")
    page.drag((0.4, 0.45), (0.6, 0.5))
    painted("Line in Paint", ["Paint"])
    keys.press("s")
    keys.down("Alt")
    page.drag((0.45, 0.45))
    keys.up("Alt")
    page.drag((0.55, 0.55), (0.58, 0.55))
    painted("Clone in Paint", ["Paint"])
    keys.press("j")
    page.drag((0.5, 0.42), (0.53, 0.42))
    painted("Heal in Paint", ["Paint"])
    keys.press("g")
    page.tab.get_by_role("textbox", name="Tolerance, number").fill("2")
    page.drag((0.5, 0.6))
    painted("Bucket in Paint", ["Paint"])
    assert page.state()["layers"][0]["strokes"] == 4
    keys.press("e")
    page.drag((0.4, 0.45), (0.5, 0.48))
    painted("Erase in Paint", ["Paint"])
    assert page.state()["layers"][0]["strokes"] == 5
    keys.down("Shift")
    page.drag((0.4, 0.45), (0.6, 0.5))
    keys.up("Shift")
    painted("add Erase", ["Paint", "Erase to original"])
    keys.press("t")
    page.more()
    page.tab.get_by_label("On the surface").uncheck()
    page.drag((0.5, 0.5))
    page.wait("the text", lambda: page.tab.get_by_role("button", name="Apply").count())
    page.tab.locator("#stage").press("Escape")  # a canvas that is only cleared goes on showing what it showed
    page.wait("nothing over the view", lambda: not page.tab.locator(".cursor-overlay").is_visible())
    page.drag((0.5, 0.5))
    page.wait("the text", lambda: page.tab.get_by_role("button", name="Apply").count())
    page.tab.locator("#stage").press("Enter")
    painted("add Text", ["Paint", "Erase to original", "Text"])


def test_strokes_go_into_the_chosen_layer_from_several_views_and_undo_one_by_one(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    live, page = opened
    for x in (0.44, 0.52):  # the second is begun before the first is a layer
        page.drag((x, 0.5), (x + 0.03, 0.5))
    page.settled()
    assert page.names() == ["Paint"] and page.state()["layers"][0]["strokes"] == 2
    page.tab.locator("#stage").press("ArrowLeft")
    page.drag((0.5, 0.45), (0.53, 0.45))
    page.settled()
    (layer,) = live.studio.session.layers
    assert len(layer.strokes) == 3 and len(layer.cameras) == 2
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("the new layer", lambda: len(page.names()) == 2)
    page.drag((0.45, 0.55), (0.5, 0.55))
    page.settled()
    assert [one["strokes"] for one in page.state()["layers"]] == [3, 1]
    page.tab.locator(".layer-name").last.click()  # the lower one
    page.drag((0.45, 0.6), (0.5, 0.6))
    page.settled()
    assert [one["strokes"] for one in page.state()["layers"]] == [4, 1]
    for expected in ([3, 1], [3, 0], [3], [2], [1], []):
        page.tab.keyboard.press("Control+z")
        page.wait(f"the undo to {expected}", lambda e=expected: [o["strokes"] for o in page.state()["layers"]] == e)
    page.tab.keyboard.press("Control+Shift+z")
    page.wait("the redo", lambda: [one["strokes"] for one in page.state()["layers"]] == [1])
    page.tab.get_by_role("button", name="Hide Paint").click()
    page.wait("hidden", lambda: not page.state()["layers"][0]["visible"])
    page.tab.locator(".layer-name").click()
    page.drag((0.45, 0.6), (0.5, 0.6))
    page.wait("the reason", lambda: page.tab.get_by_text("Paint is hidden.").count())
    assert page.state()["layers"][0]["strokes"] == 1


def test_words_and_stickers_are_changed_after_they_were_applied(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.lay_text("TEA")
    page.fold()
    page.settled()
    first = page.pixels()
    page.tab.keyboard.press("b")
    page.tab.locator("#stage").press("ArrowLeft")
    page.tab.get_by_role("button", name="Change Text: TEA").click()
    page.wait("it to be hidden", lambda: not page.state()["layers"][0]["visible"])
    words = page.tab.get_by_role("textbox", name="Text", exact=True)
    assert words.input_value() == "TEA"
    words.fill("MILK")
    opaque = page.ask(OPAQUE_PREVIEW)
    page.tab.locator("#stage").press("3")
    page.wait("it fainter, as it will be", lambda: page.ask(OPAQUE_PREVIEW) < opaque / 2)
    page.tab.locator("#stage").press("0")
    words.press("Enter")
    page.wait("the other words", lambda: page.names() == ["Text: MILK"])
    page.fold()
    page.settled()
    changed = page.pixels()
    assert np.abs(changed - first).mean() > 0.001 and len(page.state()["history"]) == 3
    page.tab.get_by_role("button", name="Change Text: MILK").click()
    page.wait("it to be hidden", lambda: not page.state()["layers"][0]["visible"])
    page.tab.locator("#stage").press("Escape")
    page.fold()
    page.wait("it as it was", lambda: page.state()["layers"][0]["visible"] and np.array_equal(page.pixels(), changed))
    page.tab.keyboard.press("p")
    stripes = np.zeros((24, 40, 3))
    stripes[:, ::8] = (1, 0.5, 0)
    file = io.BytesIO()
    Image.fromarray((stripes * 255).astype(np.uint8)).save(file, "png")
    with page.tab.expect_file_chooser() as chooser:
        page.tab.get_by_role("button", name="Choose a picture").click()
    chooser.value.set_files({"name": "stripes.png", "mimeType": "image/png", "buffer": file.getvalue()})
    page.wait("the sticker", lambda: page.tab.get_by_role("button", name="Apply").count())
    page.tab.get_by_label("On the surface").check()
    page.tab.locator("#stage").press("Enter")  # before the page knows the surface
    page.wait("its layer", lambda: page.names() == ["Text: MILK", "stripes"])
    page.settled()
    assert page.state()["layers"][1]["placed"]["unit"] > 0, "it lies on the surface"
    page.tab.get_by_role("button", name="Change stripes").click()
    page.wait("it to be hidden", lambda: not page.state()["layers"][1]["visible"])
    page.wait("it on the surface", lambda: page.ask("!!window.studio.placement.value?.anchor"))
    page.drag((0.5, 0.5), (0.56, 0.5))
    page.tab.get_by_role("button", name="Apply").click()
    page.wait("it elsewhere", lambda: page.state()["layers"][1]["visible"])
    page.settled()
    placed = page.state()["layers"][1]["placed"]
    assert placed["x"] > 1.05 * page.camera()["width"] / 2
    assert placed["unit"] > 0 and placed["view"]["width"] == page.camera()["width"]
    assert live.studio.session.files.blob(placed["image"])[:4] == b"\x89PNG"


def test_the_panel_shows_at_once_what_was_asked_and_says_what_was_refused(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    live, page = opened
    page.drag((0.45, 0.5), (0.5, 0.5))
    page.settled()
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("the new layer", lambda: len(page.names()) == 2)
    page.drag((0.45, 0.55), (0.55, 0.55))
    page.settled()
    footer = page.tab.locator(".last-edit")
    latest = footer.inner_text()
    assert latest.startswith("Brush in Paint 2")
    saved = page.tab.locator(".connection")

    def visible() -> list[bool]:
        return [layer["visible"] for layer in page.state()["layers"]]

    with live.studio.session._core.lock:  # the server is busy
        page.tab.get_by_role("button", name="Hide Paint 2").click()
        page.tab.get_by_role("button", name="Show Paint 2").wait_for()
        page.tab.get_by_label("Blend").select_option("color")
        opacity = page.tab.get_by_role("region", name="Layers").get_by_role("textbox", name="Opacity, number")
        opacity.fill("40")
        opacity.press("Enter")
        page.tab.locator(".layer-name").first.focus()
        page.tab.keyboard.press("Alt+ArrowDown")
        page.wait("the order", lambda: page.tab.locator(".layer-name b").all_inner_texts() == ["Paint", "Paint 2"])
        row = page.tab.locator(".layer").nth(1)
        assert "40 %, colour" in row.inner_text() and row.locator(".spinner").count() == 1
        assert page.tab.locator(".layer").nth(0).locator(".spinner").count() == 0
        page.wait("the job", lambda: "Hiding Paint 2" in page.tab.locator(".jobs").inner_text())
        assert saved.inner_text().strip() == "Saving"
        assert visible() == [True, True] and page.names() == ["Paint", "Paint 2"]
    page.wait("the end of it", lambda: not page.tab.locator(".spinner").count())
    page.settled()
    assert page.names() == ["Paint 2", "Paint"] and visible() == [False, True]
    assert page.state()["layers"][0]["opacity"] == 0.4
    page.wait("the figures of what is visible", lambda: footer.inner_text().startswith("Brush in Paint "))
    for _ in range(4):
        page.tab.keyboard.press("Control+z")
    page.wait("the figures again", lambda: footer.inner_text() == latest)
    page.tab.keyboard.press("Control+z")
    page.wait("those of the first stroke", lambda: footer.inner_text().startswith("Brush in Paint "))

    page.drag((0.02, 0.05), (0.05, 0.05))  # beside the asset
    reason = page.tab.locator(".refusal")
    page.wait("the reason", reason.count)
    assert "Not done: Brush" in reason.inner_text() and "masked pixels" in reason.inner_text()
    page.tab.get_by_role("button", name="Dismiss").click()
    assert reason.count() == 1
    page.drag((0.45, 0.5), (0.5, 0.5))
    page.settled()
    page.wait("no reason any more", lambda: not reason.count())


def test_nothing_seems_lost(browser: Any, tmp_path: Path) -> None:
    """An asset that was painted is offered again; another window's project does not take this one's place unsaid."""
    from splatpainter.io import write

    (tmp_path / "shared").mkdir()
    for seed, name in enumerate(("one", "two")):
        write(tmp_path / "shared" / f"{name}.ply", studio_scenes.ball(300, seed))
    with opened_page(browser, tmp_path) as (live, page):
        tab = page.tab

        def open_file(name: str) -> None:
            tab.keyboard.press("Control+o")
            tab.get_by_role("button", name=name, exact=True).click()
            page.wait(f"{name}", lambda: page.state()["asset"]["name"] == name)
            dialog = tab.get_by_role("dialog", name="Open", exact=True)  # it goes with the command's answer
            page.wait("the dialog to be closed", lambda: dialog.count() == 0)

        open_file("one.ply")
        page.drag((0.45, 0.5), (0.55, 0.5))
        page.settled()
        project = page.state()["project"]["id"]
        open_file("two.ply")
        assert tab.get_by_role("dialog").count() == 0
        open_file("one.ply")
        offer = tab.get_by_role("button", name="Continue (1 layer,")
        offer.wait_for()
        assert re.fullmatch(r"Continue \(1 layer, \d\d:\d\d( [AP]M)?\)", offer.inner_text().strip())
        assert page.ask("document.activeElement.textContent").startswith("Continue"), "Enter goes on"
        offer.click()
        page.wait("the layer", lambda: page.names() == ["Paint"] and page.state()["project"]["id"] == project)
        tab.keyboard.press("Control+o")
        entry = tab.get_by_role("dialog", name="Open").locator(".list button", has_text="1 layer")
        entry.wait_for()
        assert "open now" in entry.inner_text() and entry.locator("img").count() == 1
        tab.get_by_role("button", name="Close").click()
        open_file("two.ply")
        open_file("one.ply")
        tab.get_by_role("button", name="Start over").click()
        page.wait("no dialog", lambda: tab.get_by_role("dialog").count() == 0)
        assert page.names() == [] and page.state()["project"]["id"] != project

        page.drag((0.45, 0.5), (0.55, 0.5))
        page.settled()
        project = page.state()["project"]["id"]
        tab.context.set_offline(True)
        page.ask("window.studio.link.lose()")
        live.post("asset.open", file="two.ply")
        tab.context.set_offline(False)
        note = tab.get_by_role("alert").filter(has_text="has another project open now")
        note.wait_for()
        assert "You were in one.ply (1 layer" in note.inner_text()
        tab.get_by_role("button", name="Back to one.ply").click()
        page.wait("the project", lambda: page.state()["project"]["id"] == project and page.names() == ["Paint"])
        page.wait("no note", lambda: note.count() == 0)
        page.problems = [problem for problem in page.problems if "WebSocket" not in problem]


def test_the_eraser_takes_the_layers_paint_and_leaves_what_is_below(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened

    def middle() -> np.ndarray:
        pixels = page.pixels()
        height, width, _ = pixels.shape
        return pixels[height // 2 - 3 : height // 2 + 4, width // 2 - 3 : width // 2 + 4].mean((0, 1))

    bare = middle()
    page.drag((0.4, 0.5), (0.6, 0.5))
    page.settled()
    red = middle()
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("the new layer", lambda: len(page.names()) == 2)
    page.tab.get_by_role("textbox", name="Colour").fill("#2040d0")
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.settled()
    assert middle()[2] > 0.5 > middle()[0]
    page.tab.keyboard.press("e")
    page.drag((0.44, 0.5), (0.56, 0.5))
    page.settled()
    page.wait("the red again", lambda: np.abs(middle() - red).max() < 0.05)
    assert page.names() == ["Paint", "Paint 2"]
    page.tab.keyboard.press("Control+z")
    page.wait("the blue again", lambda: middle()[2] > 0.5)
    page.tab.keyboard.down("Shift")
    page.drag((0.5, 0.42), (0.5, 0.58))
    page.wait("a layer of its own", lambda: page.names() == ["Paint", "Paint 2", "Erase to original"])
    page.settled()
    assert np.abs(middle() - bare).max() < 0.1, "below all paint"
    page.drag((0.47, 0.42), (0.47, 0.58))
    page.settled()
    page.tab.keyboard.up("Shift")
    page.tab.locator("#stage").press("ArrowRight")
    page.drag((0.53, 0.42), (0.53, 0.58))
    page.wait("one of the other view", lambda: page.names()[-1] == "Erase to original 2")
    page.settled()
    labels = [step["label"] for step in page.state()["history"]][-3:]
    assert labels == ["add Erase to original", "Erase to original", "add Erase to original 2"]


def test_masks_hide_and_show_a_layer(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Painted with the brush, taken from the selection, by a rule; off and away again."""
    _, page = opened
    tab = page.tab
    before = page.pixels()
    height, width, _ = before.shape

    def red(pixels: np.ndarray, x: float) -> float:
        """How much of the stroke shows at a share of the width."""
        at = int(x * width)
        part = (slice(height // 2 - 3, height // 2 + 4), slice(at - 3, at + 4))
        full = np.abs(painted[part] - before[part]).mean()
        return float(np.abs(pixels[part] - before[part]).mean() / full)

    page.drag((0.4, 0.5), (0.6, 0.5))
    page.settled()
    painted = page.pixels()
    tab.get_by_role("button", name="Mask of the layer").click()
    panel = tab.get_by_role("group", name="Mask of Paint")
    panel.get_by_role("button", name="Paint").click()
    page.wait("the mask", lambda: page.state()["layers"][0]["mask"])
    page.drag((0.56, 0.5), (0.6, 0.5))
    page.wait("the painted mask", lambda: page.state()["layers"][0]["mask"]["parts"] == 1)
    page.settled()
    masked = page.pixels()
    assert red(masked, 0.42) > 0.8 and red(masked, 0.58) < 0.3
    assert (
        page.state()["layers"][0]["strokes"] == 1
        and page.state()["history"][-1]["label"] == "Hide in the mask of Paint"
    )
    panel.get_by_label("Brush").select_option("show")
    page.drag((0.56, 0.5), (0.6, 0.5))
    page.wait("it shown again", lambda: red(page.pixels(), 0.58) > 0.8)
    page.settled()
    panel.get_by_role("button", name="Hide all").click()
    page.wait("nothing of it", lambda: np.array_equal(page.pixels(), before))
    tab.keyboard.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    panel.get_by_role("button", name="Selection").click()
    page.wait("the left half", lambda: red(page.pixels(), 0.42) > 0.8)
    assert red(page.pixels(), 0.58) < 0.2
    tab.keyboard.press("Control+d")
    panel.get_by_label("Rule").select_option("height")
    page.wait("the lower half", lambda: page.state()["history"][-1]["label"] == "mask (height) of Paint")
    steps = len(page.state()["history"])
    panel.get_by_role("textbox", name="To, number").fill("100")
    panel.get_by_role("textbox", name="To, number").press("Enter")
    page.wait("all heights", lambda: red(page.pixels(), 0.5) > 0.9)
    assert len(page.state()["history"]) == steps
    panel.get_by_label("Rule").select_option("coverage")
    panel.get_by_label("Shows", exact=True).select_option("As in the original")
    page.wait("by coverage", lambda: page.state()["history"][-1]["label"] == "mask (coverage) of Paint")
    page.settled()
    page.wait("all of it", lambda: red(page.pixels(), 0.5) > 0.9)
    panel.get_by_label("Shows", exact=True).select_option("Predicted")
    page.wait("nothing of it", lambda: red(page.pixels(), 0.5) < 0.1)
    panel.get_by_role("button", name="Hide all").click()
    page.wait("nothing of it", lambda: np.array_equal(page.pixels(), before))
    panel.get_by_role("button", name="Off").click()
    page.wait("all of it", lambda: np.array_equal(page.pixels(), painted))
    panel.get_by_role("button", name="Remove").click()
    page.wait("no mask", lambda: page.state()["layers"][0]["mask"] is None)
    page.drag((0.45, 0.4), (0.5, 0.4))
    page.settled()
    assert page.state()["layers"][0]["strokes"] == 1  # the rectangle is in hand
    tab.keyboard.press("b")
    page.drag((0.45, 0.4), (0.5, 0.4))
    page.settled()
    assert page.state()["layers"][0]["strokes"] == 2
