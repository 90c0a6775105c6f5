"""A session of forty steps as an artist makes them, in a real browser, with the server killed in its middle: after each
step what the artist sees is looked at: the list of layers, the pixels, the figures."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera
from splatpainter.io import read, write
from splatpainter.receipts import verify
from splatpainter.rendering import render
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball
from tests.support.studio_pages import FEW_PIXELS, Page, window
from tests.support.studio_process import Server
from tests.support.systems import posix_only

SHOTS = os.environ.get("SPLATPAINTER_SCREENSHOTS")
"""Folder for a screenshot of each step."""


class Artist:
    """The page and what was seen of it last."""

    def __init__(self, page: Page) -> None:
        self.page, self.tab, self.keys = page, page.tab, page.tab.keyboard
        self.stage = self.tab.locator("#stage")
        self.steps: list[str] = []
        self.seen = page.pixels()

    def did(
        self, what: str, *, changed: bool = True, where: tuple[float, float] | None = None, resized: bool = False
    ) -> np.ndarray:
        """A step is over: saved, without complaints, and the view is another one (or the same). where: the place that
        must have changed, shares of the view. resized: the view has other pixels now. Returns what is seen."""
        self.page.fold()
        self.page.settled()
        self.steps.append(what)
        if changed:
            self.page.wait(f"other pixels after: {what}", lambda: self._differs(where))
        now = self.page.pixels()
        if not changed and not resized:
            assert np.abs(now - self.seen).mean() < 2e-3, what
        if SHOTS:
            self.tab.screenshot(path=f"{SHOTS}/{len(self.steps):02d}.png")
        self.seen = now
        return now

    def _differs(self, where: tuple[float, float] | None) -> bool:
        now = self.page.pixels()
        difference = np.abs(now - self.seen)
        if where is not None:
            difference = difference[spot(now, *where)]
            return bool(difference.mean() > 0.02)
        return bool(difference.max() > 0.02)

    def button(self, name: str) -> Any:
        return self.tab.get_by_role("button", name=name, exact=True)

    def layer(self, name: str) -> dict[str, Any]:
        return next(one for one in self.page.state()["layers"] if one["name"] == name)

    def choose(self, name: str) -> None:
        self.tab.locator(".layer-name", has=self.tab.get_by_text(name, exact=True)).click()

    def names(self, *expected: str) -> None:
        """The list of layers, from below, is this one."""
        self.page.wait(f"the layers {expected}", lambda: self.page.names() == list(expected))
        rows = self.tab.locator(".layer-name b").all_inner_texts()
        assert rows == list(expected)[::-1], "the panel lists what there is, uppermost first"

    def color(self, code: str) -> None:
        self.tab.get_by_role("textbox", name="Colour", exact=True).fill(code)

    def tab_of(self, name: str) -> None:
        self.tab.get_by_role("tab", name=name).click()

    def number(self, label: str, value: str, group: str = "") -> None:
        within = self.tab.get_by_role("region", name=group) if group else self.tab
        field = within.get_by_role("textbox", name=f"{label}, number")
        field.fill(value)
        field.press("Enter")

    def selected(self) -> int:
        return self.page.state()["selection"]["gaussians"]

    def label(self) -> str:
        """Of the newest step of the history that is in effect."""
        state = self.page.state()
        return state["history"][state["cursor"]]["label"]

    def count(self) -> int:
        """Gaussians, as the footer says."""
        text = self.tab.locator("footer").inner_text()
        return int(re.search(r"([\d,]+) Gaussians", text).group(1).replace(",", ""))  # type: ignore[union-attr]


def spot(pixels: np.ndarray, x: float, y: float, half: int = 3) -> tuple[slice, slice]:
    """A few pixels around a place, in shares of the view."""
    row, column = int(y * pixels.shape[0]), int(x * pixels.shape[1])
    return slice(row - half, row + half + 1), slice(column - half, column + half + 1)


def colored_ball() -> Splats:
    """Of another colour on every side, so that a hole shows, and dense enough for sheets and fills."""
    splats = ball(4000, degree=0)
    colors = 0.55 + 0.25 * splats.means
    return replace(splats, sh=((colors - 0.5) / SH_C0)[:, None].astype(np.float32))


@pytest.fixture
def studio(browser: Any, tmp_path: Path) -> Iterator[tuple[Server, Page, Path]]:
    asset = tmp_path / "ball.ply"
    write(asset, colored_ball())
    server = Server(asset, tmp_path)
    try:
        server.start()
        with window(browser, server.url, still=True, resolution="0.5") as page:  # holes and letters are looked at
            yield server, page, asset
    finally:
        with contextlib.suppress(ProcessLookupError):
            server.end(crash=False)


@posix_only
@pytest.mark.slow
def test_forty_steps_of_an_artist_with_a_crash_in_the_middle(studio: tuple[Server, Page, Path], tmp_path: Path) -> None:
    server, page, asset = studio
    a = Artist(page)
    tab, keys = a.tab, a.keys

    # 1-6: look, paint
    assert page.state()["asset"]["gaussians"] == 4000 == a.count() and page.names() == []
    a.did("opened the asset", changed=False)
    a.stage.press("ArrowRight")
    a.did("turned it")
    keys.press("b")
    a.color("#d02020")
    page.drag((0.44, 0.45), (0.56, 0.45))
    a.names("Paint")
    now = a.did("painted a red stroke", where=(0.5, 0.45))
    red = now[spot(now, 0.5, 0.45)].mean((0, 1))
    assert red[0] > red[1] + 0.3
    a.tab_of("Brush")
    tab.locator(".presets").get_by_title("Chalk").click()
    a.color("#2040d0")
    page.drag((0.44, 0.55), (0.56, 0.55))
    page.wait("two strokes", lambda: a.layer("Paint")["strokes"] == 2)
    a.did("painted with chalk", where=(0.5, 0.55))
    tab.locator(".presets button").first.click()
    a.button("New layer to paint into").click()
    a.names("Paint", "Paint 2")
    a.did("made a layer", changed=False)
    a.color("#20a040")
    page.drag((0.5, 0.4), (0.5, 0.6))
    page.wait("its stroke", lambda: a.layer("Paint 2")["strokes"] == 1)
    now = a.did("painted over both", where=(0.5, 0.45))
    green = now[spot(now, 0.5, 0.45)].mean((0, 1))
    assert green[1] > green[0] + 0.1

    # 7-9: opacity and eye
    a.number("Opacity", "50", "Layers")
    page.wait("half of it", lambda: a.layer("Paint 2")["opacity"] == 0.5)
    now = a.did("made it half transparent", where=(0.5, 0.45))
    mixed = now[spot(now, 0.5, 0.45)].mean((0, 1))
    assert min(red[0], green[0]) < mixed[0] < max(red[0], green[0])
    a.button("Hide Paint 2").click()
    page.wait("it to be hidden", lambda: not a.layer("Paint 2")["visible"])
    now = a.did("hid it", where=(0.5, 0.45))
    assert np.abs(now[spot(now, 0.5, 0.45)].mean((0, 1)) - red).max() < 0.06
    a.button("Show Paint 2").click()
    page.wait("it again", lambda: a.layer("Paint 2")["visible"])
    a.did("showed it", where=(0.5, 0.45))

    # 10-12: a text, other words, a sticker
    keys.press("t")
    tab.get_by_role("checkbox", name="On the surface", exact=True).uncheck()
    tab.get_by_role("textbox", name="Text", exact=True).fill("TEA")
    a.number("Size", "60")
    page.drag((0.5, 0.66))
    page.wait("the text", lambda: a.button("Apply").count())
    a.stage.press("Enter")
    a.names("Paint", "Paint 2", "Text: TEA")
    a.did("wrote a word")
    a.button("Change Text: TEA").click()
    page.wait("it to be laid again", lambda: not a.layer("Text: TEA")["visible"])
    tab.get_by_role("textbox", name="Text", exact=True).fill("MILK")
    a.button("Apply").click()
    a.names("Paint", "Paint 2", "Text: MILK")
    a.did("changed the word")
    keys.press("p")
    with tab.expect_file_chooser() as chooser:
        a.button("Choose a picture").click()
    chooser.value.set_files({"name": "stripes.png", "mimeType": "image/png", "buffer": stripes()})
    page.wait("the sticker", lambda: a.button("Apply").count())
    tab.get_by_role("checkbox", name="On the surface", exact=True).check()
    page.wait("it on the surface", lambda: page.ask("!!window.studio.placement.value?.anchor"))
    a.stage.press("Enter")
    a.names("Paint", "Paint 2", "Text: MILK", "stripes")
    a.did("stuck a picture on it")

    # 13-17: select, grow, delete, fill
    keys.press("l")
    page.drag((0.56, 0.3), (0.62, 0.3), (0.62, 0.4), (0.56, 0.4), (0.56, 0.3))
    lasso = page.wait("a selection", a.selected)
    a.did("drew a lasso", changed=False)
    a.number("Amount", "4")
    tab.locator(".selection-panel").get_by_role("button", name="Grow", exact=True).click()
    page.wait("more of it", lambda: a.selected() > lasso)
    a.did("grew it", changed=False)
    before, rows = a.seen, a.count()
    a.stage.focus()
    keys.press("Delete")
    page.wait("a hole", lambda: page.names()[-1] == "Hide")
    a.did("deleted it", where=(0.59, 0.35))
    keys.press("Control+z")
    page.wait("it again", lambda: page.names()[-1] == "stripes" and a.selected() > lasso)
    a.did("took that back", where=(0.59, 0.35))
    a.stage.focus()
    keys.press("Shift+F5")
    a.names("Paint", "Paint 2", "Text: MILK", "stripes", "Fill: removed", "Fill")
    now = a.did("removed and filled it", changed=False)
    assert np.abs(now - before)[spot(now, 0.59, 0.35)].mean() < 0.1 and a.count() > rows, "as if nothing had been there"

    # 18-20: a mask, clone, heal; SwiftShader's time is that of the pixels, and from here on a few are enough
    page.set_resolution(FEW_PIXELS)
    a.did("chose fewer pixels", changed=False, resized=True)
    a.choose("Paint")
    a.button("Mask of the layer").click()
    tab.get_by_role("group", name="Mask of Paint").get_by_role("button", name="Paint", exact=False).first.click()
    page.wait("its mask", lambda: a.layer("Paint")["mask"] is not None)
    tab.get_by_role("group", name="Mask of Paint").get_by_label("Brush").select_option("hide")
    page.drag((0.44, 0.45), (0.47, 0.45))
    page.wait("its part", lambda: a.layer("Paint")["mask"]["parts"] == 1)
    a.did("hid the stroke's end by a mask", where=(0.455, 0.45))
    tab.get_by_role("group", name="Mask of Paint").get_by_role("button", name="Paint", exact=False).first.click()
    a.button("Mask of the layer").click()
    a.choose("Paint 2")
    keys.press("s")
    keys.down("Alt")
    page.drag((0.54, 0.45))
    keys.up("Alt")
    page.drag((0.42, 0.62), (0.45, 0.62))
    page.wait("the clone", lambda: a.label().startswith("Clone in Paint 2"))
    a.did("cloned the red", where=(0.43, 0.62))
    keys.press("j")
    keys.down("Alt")
    page.drag((0.4, 0.4))
    keys.up("Alt")
    page.drag((0.42, 0.62), (0.45, 0.62))
    page.wait("the healing", lambda: a.label().startswith("Heal in Paint 2"))
    a.did("healed it", where=(0.43, 0.62))

    # 21-26: undo and redo, a look, a LUT, another name, a copy
    healed = a.seen
    for left in (2, 1):  # the healing showed what the clone had hidden: both ways it is seen to change
        keys.press("Control+z")
        page.wait("a stroke less", lambda n=left: a.layer("Paint 2")["strokes"] == n)
        a.did(f"took back to {left} strokes", where=(0.43, 0.62))
    for right in (2, 3):
        keys.press("Control+Shift+z")
        page.wait("a stroke more", lambda n=right: a.layer("Paint 2")["strokes"] == n)
        now = a.did(f"did {right} strokes again", where=(0.43, 0.62))
    assert np.abs(now - healed).max() < 0.02
    a.tab_of("Adjust")
    a.number("Exposure", "0.5")
    a.button("Apply as layer").click() if a.button("Apply as layer").count() else a.button("Make it a layer").click()
    page.wait("the look", lambda: page.state()["layers"][-1]["kind"] == "look")
    a.did("made it brighter", where=(0.4, 0.35))
    with tab.expect_file_chooser() as chooser:
        tab.get_by_text("LUT (.cube)").click()
    lut = b"LUT_1D_SIZE 2\n0 0 0\n0.7 1 1\n"
    chooser.value.set_files({"name": "cold.cube", "mimeType": "text/plain", "buffer": lut})
    page.wait("its name", lambda: tab.get_by_text("cold.cube in place of the sliders").count())
    a.button("Apply as layer").click() if a.button("Apply as layer").count() else a.button("Make it a layer").click()
    page.wait("the LUT", lambda: len(page.names()) == 8)
    now = a.did("laid a LUT over it", where=(0.4, 0.35))
    names = page.names()
    tab.locator(".layer-name").first.focus()
    keys.press("F2")
    tab.get_by_label("Layer name").fill("Cold")
    keys.press("Enter")
    a.names(*names[:-1], "Cold")
    a.did("named it", changed=False)
    a.choose("stripes")
    keys.press("Control+j")
    page.wait("the copy", lambda: "stripes copy" in page.names())
    a.did("copied the sticker", changed=False)
    tab.locator(".layer-name", has=tab.get_by_text("stripes copy", exact=True)).focus()
    keys.press("Alt+ArrowDown")
    page.wait("its place", lambda: page.names().index("stripes copy") == 3)
    a.did("moved the copy down", changed=False)
    panel = tab.get_by_role("tabpanel")
    panel.evaluate("(panel) => (panel.scrollTop = 1e6)")
    a.tab_of("History")
    inside = "(row) => row.getBoundingClientRect().bottom - row.closest('.tab-panel').getBoundingClientRect().bottom"
    assert panel.locator("[aria-current=true]").evaluate(inside) < 1, "the newest step is in sight"
    a.tab_of("Brush")
    assert panel.evaluate("(panel) => panel.scrollTop") == 0

    # 27-30: the server dies while a stroke is on its way; everything that was acknowledged is there
    listed, history, gaussians = page.names(), len(page.state()["history"]), a.count()
    camera = page.camera()
    server.end(crash=True)
    page.wait("that it is gone", lambda: "Saved" not in tab.locator(".connection").inner_text())
    a.steps.append("the server was killed")
    server.start()
    page.wait("the server again", lambda: tab.locator(".connection").inner_text().strip() == "Saved")
    note = tab.get_by_role("alert").filter(has_text="The studio was started again")
    note.wait_for()
    assert "You were in ball.ply (9 layers" in note.inner_text()
    a.steps.append("the page found it again")
    if SHOTS:
        tab.screenshot(path=f"{SHOTS}/offer.png")
    note.get_by_role("button", name="Continue").click()
    a.names(*listed)
    page.wait("the view", lambda: page.ask("window.studio.viewer.count") == gaussians)
    assert len(page.state()["history"]) == history and a.count() == gaussians
    assert page.camera() == camera, "nobody moved"
    a.did("went on", changed=False)

    # 31-36: as if nothing had happened
    keys.press("Control+z")
    page.wait("the step before the crash taken back", lambda: page.names().index("stripes copy") == 4)
    keys.press("Control+Shift+z")
    a.names(*listed)
    a.did("undid and redid over the crash", changed=False)
    a.choose("Paint 2")
    keys.press("i")
    field = tab.get_by_role("textbox", name="Colour", exact=True)
    before_pick = field.input_value()
    page.drag((0.5, 0.74))
    page.wait("another colour", lambda: field.input_value() != before_pick)
    a.did("picked a colour", changed=False)
    keys.press("b")
    a.color("#f0d020")
    page.drag((0.42, 0.35), (0.5, 0.35))
    page.wait("a stroke", lambda: a.layer("Paint 2")["strokes"] == 4)
    a.did("painted on", where=(0.46, 0.35))
    keys.press("e")
    page.drag((0.48, 0.35), (0.52, 0.35))
    page.wait("a stroke", lambda: a.layer("Paint 2")["strokes"] == 5)
    a.did("erased a part of it", where=(0.49, 0.35))
    keys.press("u")
    page.drag((0.42, 0.28), (0.5, 0.3))
    page.wait("a stroke", lambda: a.layer("Paint 2")["strokes"] == 6)
    a.did("drew a line", where=(0.46, 0.29))
    a.choose("stripes copy")
    a.button("Delete the layer").click()
    page.wait("eight layers", lambda: len(page.names()) == 8)
    a.did("deleted the copy", changed=False)
    a.choose("Paint 2")
    keys.press("Control+e")
    page.wait("seven layers", lambda: len(page.names()) == 7)
    a.did("merged the two", changed=False)

    # 37-40: export and proof
    a.tab_of("Receipt")
    keys.press("Control+s")
    tab.locator(".formats label", has=tab.get_by_text("PLY", exact=True)).click()
    with tab.expect_download() as download:
        tab.locator("dialog").get_by_role("button", name="Export", exact=True).click()
    exported = tmp_path / "exported.ply"
    exported.write_bytes(Path(download.value.path()).read_bytes())
    a.steps.append("exported it")
    keys.press("Escape")
    proof = verify(asset, exported)
    assert proof.ok, proof
    a.steps.append("proved it")
    splats = read(exported)
    assert len(splats) == a.count()
    wire = page.camera()
    matrix = np.array(wire["world_to_camera"])
    view = Camera(wire["width"], wire["height"], wire["fx"], wire["fy"], wire["cx"], wire["cy"], matrix)
    drawn = render(splats, view).colors[0]
    shape = a.seen.shape[:2]
    picture = np.asarray(Image.fromarray((np.clip(drawn, 0, 1) * 255).astype(np.uint8)).resize(shape[::-1])) / 255
    inside = render(splats, view).alphas[0, ..., 0] > 0.99
    inside = np.asarray(Image.fromarray(inside).resize(shape[::-1]))
    assert np.abs(picture - a.seen)[inside].mean() < 0.05, "the file shows what the page showed"
    a.steps.append("and it looks as it did")
    assert len(a.steps) >= 40, a.steps
    page.problems = [problem for problem in page.problems if "WebSocket" not in problem and "ERR_" not in problem]


def stripes() -> bytes:
    """A PNG of orange and black stripes."""
    pixels = np.zeros((24, 40, 3), np.uint8)
    pixels[:, ::8] = (255, 128, 0)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return file.getvalue()
