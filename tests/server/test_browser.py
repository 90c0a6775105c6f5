"""The studio's page in a real browser: it draws what the renderer draws, paints, keeps, and says what it does."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support import studio_scenes
from tests.support.studio_pages import (
    FLAGS,
    STATIC,
    SWIFTSHADER,
    WEB,
    WITH_WINDOWS,
    Page,
    chromium,
    opened_page,
    window,
)

SOURCES = (
    "index.html",
    "package-lock.json",
    "package.json",
    "public",
    "scripts",
    "src",
    "tsconfig.json",
    "vite.config.ts",
)


def test_the_bundle_is_that_of_the_sources() -> None:
    """scripts/record.ts writes the hash of what the bundle was made from: `npm run build` in web/ makes them agree."""
    digest = hashlib.sha256()
    files = [path for name in SOURCES for path in ([WEB / name] if (WEB / name).is_file() else (WEB / name).rglob("*"))]
    named = {path.relative_to(WEB).as_posix(): path for path in files if path.is_file()}
    for name in sorted(named):
        data = named[name].read_bytes()
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
    assert json.loads((STATIC / "build.json").read_text())["sources"] == digest.hexdigest()


def test_the_bundle_is_small_and_alone() -> None:
    import gzip

    names = sorted(path.name for path in STATIC.iterdir())
    assert names == [
        "build.json", "engine.js", "favicon.svg", "index.html", "studio.css", "studio.js", "viewer.js",
    ]  # fmt: skip
    assert sum(len(gzip.compress(path.read_bytes(), mtime=0)) for path in STATIC.iterdir()) <= 2_500_000


@pytest.fixture
def gpu_browser(browser: Any) -> Iterator[Any]:
    """One that puts the page together as for users, by SwiftShader, beside the other: Playwright's loop runs once per
    process."""
    one = browser.browser_type.launch(executable_path=chromium(WITH_WINDOWS), args=[*FLAGS, *SWIFTSHADER])
    yield one
    one.close()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page."""
    with opened_page(browser, tmp_path) as (live, page):
        yield live, page
        assert all(url.startswith((live.url, "blob:", "data:")) for url in page.requests)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = float(np.mean((a - b) ** 2))
    return 999.0 if error == 0 else -10 * np.log10(error)


def drawn(splats: Splats, camera: dict[str, Any]) -> np.ndarray:
    return np.clip(render(splats, Camera.from_json(json.dumps(camera))).colors[0], 0, 1)


def test_the_browser_draws_what_the_renderer_draws(gpu_browser: Any, tmp_path: Path) -> None:
    """The demo asset, SH degree 3, from two sides, off-centre: 45 dB at least; its 8 bits allow 59. The driver has
    nothing to complain of, such as a picture that is read back for no reason."""
    from splatpainter.server.uploads.storage import demo

    asset = demo()
    with studio_scenes.live(studio_scenes.make_studio(tmp_path, asset)) as live:
        page = Page(gpu_browser, live.url, 760, 420, gpu_compositing=True)
        try:
            home = page.camera()
            shifted = home | {"cx": home["cx"] + 11.25, "cy": home["cy"] - 7.5, "fx": home["fx"] * 1.1}
            for camera in (home, shifted):
                page.ask("(camera) => window.studio.viewer.setCamera(camera)", camera)
                assert psnr(page.pixels(), drawn(asset, camera)) > 45
            assert page.problems == []
        finally:
            page.tab.close()


COUNT_PICTURES = """() => {
  const { blit } = window.studio.viewer;
  const show = blit.show;
  window.pictures = 0;
  blit.show = function (...words) {
    window.pictures++;
    return show.apply(this, words);
  };
}"""
"""The grid is hidden: each picture is put onto the canvas once."""


def test_a_turned_view_is_drawn_once_as_it_is_sorted_and_once_sorted_anew(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    """Spark left to itself draws it five to seven times, which a computer without a graphics card feels."""
    _, page = opened
    before = page.pixels()
    page.ask(COUNT_PICTURES)
    camera = page.camera()
    page.ask("(camera) => window.studio.viewer.setCamera(camera)", camera | {"cx": camera["cx"] + 5.5})
    turned = page.pixels()
    assert not np.array_equal(turned, before)
    page.tab.wait_for_timeout(200)
    assert page.ask("window.pictures") in (1, 2)
    assert np.array_equal(page.pixels(), turned) and page.ask("window.pictures") in (1, 2), "nothing is new"
    page.ask("window.studio.viewer.invalidate()")
    page.wait("one more where one is asked for", lambda: page.ask("window.pictures") in (2, 3))


def test_a_stroke_is_where_it_was_painted_and_undo_brings_every_pixel_back(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    live, page = opened
    before = page.pixels()
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    after = page.pixels()
    height, width, _ = after.shape
    change = abs(after - before).max(-1)
    rows, columns = np.mgrid[0:height, 0:width]
    reach = 20 * 0.5  # the brush is 40 pixels of the screen wide, 20 of the view
    inside = (abs(rows - height / 2) < 0.5 * reach) & (abs(columns - width / 2) < 0.05 * width)
    outside = (abs(rows - height / 2) > 4 * reach) | (abs(columns - width / 2) > 0.05 * width + 4 * reach)
    assert change[inside].mean() > 0.1
    assert change[outside].mean() < 0.01
    assert np.linalg.norm(after[inside].mean(0) - np.array([0xC8, 0x44, 0x2E]) / 255) < 0.15
    assert psnr(after, drawn(live.studio.session.splats, page.camera())) > 45
    page.tab.locator("#stage").press("ArrowLeft")  # from the side it is there too
    side = page.pixels()
    assert psnr(side, drawn(live.studio.session.splats, page.camera())) > 45
    page.tab.locator("#stage").press("ArrowRight")
    page.tab.keyboard.press("Control+z")
    page.wait("the undo", lambda: page.names() == [])
    page.wait("the pixels", lambda: np.array_equal(page.pixels(), before))
    page.tab.keyboard.press("Control+Shift+z")
    page.wait("the redo", lambda: page.names() == ["Paint"])
    page.wait("the pixels", lambda: np.array_equal(page.pixels(), after))


def test_limits_are_shown_while_painting_and_go_with_the_layer(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.more()
    page.tab.get_by_role("button", name="Limits", exact=True).click()
    for name, value in (("Angle limit", "40"), ("Depth-edge limit", "3")):
        field = page.tab.get_by_role("textbox", name=f"{name}, number")
        field.fill(value)
        field.press("Enter")
    hatch = page.tab.locator(".left-out")
    assert hatch.count() == 0
    page.tab.get_by_label("Show what will not be painted").check()
    page.wait("the hatch", hatch.count)
    assert "/api/blobs/" in hatch.evaluate("element => getComputedStyle(element).maskImage")
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", page.names)
    page.settled()
    (stroke,) = live.studio.session.layers[-1].strokes
    assert stroke.operation.limits() == {"angle_limit": 40.0, "depth_edge_limit": 3.0}  # pyright: ignore[reportAttributeAccessIssue]
    page.tab.keyboard.press("e")  # the eraser has no limits
    page.wait("no hatch", lambda: hatch.count() == 0)


def test_a_selection_limits_the_stroke(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.tab.keyboard.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    page.wait("the selection", lambda: page.tab.get_by_role("button", name="Deselect").count())
    page.tab.keyboard.press("b")
    page.drag((0.42, 0.5), (0.58, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    (view,) = page.state()["layers"][0]["views"]
    mask = np.asarray(Image.open(io.BytesIO(live.http.get(f"/api/blobs/{view['mask']}").content)).convert("L"))
    height, width = mask.shape
    assert mask[height // 2, int(0.43 * width) : int(0.49 * width)].min() > 0
    assert mask[:, int(0.51 * width) :].max() == 0


def test_a_pen_presses_and_fingers_turn_and_pinch(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.pointer("down", 5, "pen", 0.4, 0.5, 0.05)
    for k in range(1, 11):
        page.pointer("move", 5, "pen", 0.4 + 0.02 * k, 0.5, 0.1 * k)
    page.pointer("up", 5, "pen", 0.6, 0.5, 0.0)
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    (view,) = page.state()["layers"][0]["views"]
    mask = np.asarray(Image.open(io.BytesIO(live.http.get(f"/api/blobs/{view['mask']}").content)).convert("L")) > 127
    width = mask.shape[1]
    assert mask[:, int(0.58 * width)].sum() > 2 * mask[:, int(0.44 * width)].sum() > 0
    before = page.camera()["world_to_camera"]
    page.pointer("down", 7, "touch", 0.5, 0.5)
    page.pointer("move", 7, "touch", 0.6, 0.5)
    page.pointer("up", 7, "touch", 0.6, 0.5)
    turned = page.camera()["world_to_camera"]
    assert turned[0] != before[0]
    assert abs(turned[2][3] - before[2][3]) < 0.1 * before[2][3]
    for finger, x in ((7, 0.4), (8, 0.6)):
        page.pointer("down", finger, "touch", x, 0.5)
    page.pointer("move", 8, "touch", 0.8, 0.5)
    assert page.camera()["world_to_camera"][2][3] < 0.7 * turned[2][3]
    assert page.names() == ["Paint"]


def test_a_dropped_picture_a_look_and_the_order_of_layers_outlive_a_reload(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    live, page = opened
    camera = Camera.from_json(json.dumps(page.camera()))
    camera = replace(camera, asset_sha256=live.studio.session.original.sha256)
    edited = drawn(live.studio.session.splats, page.camera())
    height, width, _ = edited.shape
    edited[height // 2 - 15 : height // 2 + 15, width // 2 - 15 : width // 2 + 15] = (0.1, 0.9, 0.2)
    page.drop("patch.png", png(edited, camera), "image/png")
    apply = page.tab.get_by_role("button", name="Apply as layer")
    page.wait("the check", lambda: page.tab.get_by_text("its camera is in the file").count())
    apply.click()
    page.wait("the picture's layer", lambda: page.names() == ["patch"])

    def from_green() -> float:
        return float(np.linalg.norm(page.pixels()[height // 2, width // 2] - (0.1, 0.9, 0.2)))

    page.wait("the picture on the ball", lambda: from_green() < 0.2)

    page.tab.get_by_role("tab", name="Adjust").click()
    before = page.pixels()
    page.tab.get_by_role("textbox", name="Exposure, number").fill("-1.5")
    page.tab.get_by_role("textbox", name="Exposure, number").press("Enter")
    page.wait("the preview", lambda: page.pixels().mean() < 0.8 * before.mean())
    assert page.names() == ["patch"]
    apply.click()
    page.wait("the adjustment layer", lambda: page.names() == ["patch", "Adjustment"])
    assert page.pixels().mean() < 0.8 * before.mean() and from_green() > 0.3

    page.tab.locator(".layer-name").first.focus()
    page.tab.keyboard.press("Alt+ArrowDown")
    page.wait("the order", lambda: page.names() == ["Adjustment", "patch"])
    page.wait("the picture over the adjustment", lambda: from_green() < 0.2)
    page.tab.get_by_role("button", name="Hide patch").click()
    page.wait("hidden", lambda: not page.state()["layers"][1]["visible"])
    page.wait("the ball without it", lambda: from_green() > 0.4)
    saved_state = page.state()
    pixels = page.pixels()
    page.open()
    assert page.state() | {"clients": 0} == saved_state | {"clients": 0}
    assert np.array_equal(page.pixels(), pixels)


def test_export_and_verify(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    page.tab.get_by_role("tab", name="Receipt").click()
    page.tab.get_by_role("button", name="Verify").click()
    page.wait("the proof", lambda: page.tab.get_by_text("Proved").count())
    page.tab.keyboard.press("Control+s")
    page.tab.get_by_role("radio", name="PLY everything").check()
    with page.tab.expect_download() as download:
        page.tab.get_by_role("button", name="Export", exact=True).click()
    assert Path(download.value.path()).read_bytes()[:3] == b"ply"


def test_a_conflict_is_shown_and_settled(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Red from the front, blue over it from the side: the panel says so, and each policy shows what it promises."""
    _, page = opened

    def blueness() -> float:
        middle = page.pixels()[:, :, [0, 2]]
        height, width, _ = middle.shape
        red, blue = middle[height // 2 - 4 : height // 2 + 5, width // 2 - 4 : width // 2 + 5].mean((0, 1))
        return float(blue - red)

    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    page.tab.locator("#stage").press("ArrowLeft")
    page.tab.get_by_role("textbox", name="Colour").fill("#2040d0")
    page.tab.get_by_role("button", name="New layer to paint into").click()
    page.wait("the new layer", lambda: len(page.names()) == 2)
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the second stroke", lambda: page.state()["layers"][1]["strokes"] == 1)
    page.settled()
    assert [one["reason"] for one in page.state()["conflicts"]] == [""], "they overlap by a third"
    assert page.tab.locator(".in-conflict").count() == 0
    page.drag((0.3, 0.5), (0.7, 0.5))
    page.wait("the third stroke", lambda: page.state()["layers"][1]["strokes"] == 2)
    page.settled()
    latest = blueness()
    assert latest > 0.3
    low, high = page.names()
    warning = page.tab.locator(".in-conflict")
    assert warning.inner_text() == f"{high} and {low}, of different views, cover each other"
    warning.click()
    page.wait("the conflict", lambda: page.tab.get_by_text("painted from another view.").count())
    choice = page.tab.get_by_label("Show", exact=True)
    choice.select_option("first")
    page.wait("the lower layer", lambda: blueness() < -0.3)
    page.wait("it decided", lambda: not page.tab.locator(".in-conflict").count())
    choice.select_option("blend")
    page.wait("a blend", lambda: -0.3 < blueness() < 0.3)
    choice.select_option("latest")
    page.wait("the upper layer", lambda: abs(blueness() - latest) < 0.02)


def test_a_layer_goes_out_and_comes_back_as_a_file(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    painted = page.pixels()
    with page.tab.expect_download() as download:
        page.tab.get_by_role("button", name="Save the layer as a file").click()
    assert download.value.suggested_filename == "Paint.splatlayer"
    data = Path(download.value.path()).read_bytes()
    page.tab.get_by_role("button", name="Delete the layer").click()
    page.wait("the empty list", lambda: page.names() == [])
    page.drop("Paint.splatlayer", data, "")
    page.wait("the layer again", lambda: page.names() == ["Paint"])
    page.wait("its pixels", lambda: np.array_equal(page.pixels(), painted))


def test_two_windows_agree_and_a_lost_connection_comes_back(
    browser: Any, opened: tuple[studio_scenes.Live, Page]
) -> None:
    live, page = opened
    with window(browser, live.url) as other:
        other.ask("window.studio.link.lose()")
        page.drag((0.45, 0.5), (0.55, 0.5))
        page.wait("the layer", lambda: page.names() == ["Paint"])
        page.settled()
        other.wait("the layer in the other window", lambda: other.names() == ["Paint"])
        assert np.array_equal(other.pixels(), page.pixels())


def test_a_dialog_opens_right_after_another_was_closed(opened: tuple[studio_scenes.Live, Page]) -> None:
    """The browser says `close` a task later: it must not close what a key has opened in between."""
    _, page = opened
    page.tab.keyboard.press("Control+o")
    page.wait("Open", page.tab.get_by_role("dialog", name="Open").count)
    page.ask(
        """() => {
            document.querySelector("dialog").close();
            const save = { key: "s", code: "KeyS", ctrlKey: true, bubbles: true };
            document.body.dispatchEvent(new KeyboardEvent("keydown", save));
        }"""
    )
    save = page.tab.get_by_role("dialog", name="Save and export")
    page.wait("Save and export", save.count)
    page.ask("new Promise((done) => setTimeout(done, 50))")
    assert save.count() == 1
    page.tab.keyboard.press("Escape")
    page.tab.keyboard.press("?")
    page.wait("Shortcuts", page.tab.get_by_role("dialog", name="Shortcuts").count)


def test_nothing_serious_for_those_who_cannot_see_or_point(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    for name in ("Brush", "Colours", "History", "Adjust", "Pictures", "Views", "Receipt"):
        page.tab.get_by_role("tab", name=name).click()
        assert page.serious() == [], name
    for key, title in (("Control+o", "Open"), ("Control+s", "Save and export"), ("?", "Shortcuts")):
        page.tab.keyboard.press(key)
        dialog = page.tab.get_by_role("dialog", name=title)
        page.wait(title, dialog.count)
        assert page.serious() == [], title
        if key != "?":
            page.tab.keyboard.press("Escape")
    dialog.get_by_role("button", name="Tour").click()
    page.wait("the tour", lambda: page.tab.get_by_role("button", name="Next").count())
    assert page.serious() == [], "tour"
    page.tab.keyboard.press("Escape")
    for panel, button, title in (
        ("Pictures", "Edit with a source", "Edit with a source"),
        ("Views", "More...", "Export the view"),
        ("Views", "Turntable...", "Turntable"),
    ):
        page.tab.get_by_role("tab", name=panel).click()
        page.tab.get_by_role("button", name=button).click()
        page.wait(title, page.tab.get_by_role("dialog", name=title).count)
        assert page.serious() == [], title
        page.tab.keyboard.press("Escape")
    page.tab.keyboard.press("t")
    box = page.tab.locator("#stage").bounding_box()
    page.tab.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait("the text under its handles", lambda: page.tab.get_by_role("button", name="Apply").count())
    assert page.serious() == [], "text on the surface"
    page.tab.keyboard.press("Escape")


def png(pixels: np.ndarray, camera: Camera) -> bytes:
    """With its camera inside."""
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    info.add_text("splatpainter", camera.to_json())
    file = io.BytesIO()
    Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(file, "png", pnginfo=info)
    return file.getvalue()


def test_one_click_turns_the_asset_over(opened: tuple[studio_scenes.Live, Page]) -> None:
    """What was up is down, in the picture and in the project; no Gaussian changes; a second click undoes it."""
    live, page = opened

    def down() -> float:
        """How much of the world's y the picture's downward axis is."""
        camera = page.camera()
        return camera["world_to_camera"][1][1] if camera else 0.0

    before = live.studio.session.splats
    page.wait("-y above", lambda: down() > 0.9)
    button = page.tab.get_by_role("button", name="Upside down?")
    button.click()
    page.wait("+y above", lambda: down() < -0.9)
    assert page.state()["asset"]["up"] == [0, 1, 0] and live.studio.session.scene.up == "+y"
    assert live.studio.session.splats is before and len(page.state()["history"]) == 1
    page.open()
    page.wait("+y above, still", lambda: down() < -0.9)
    button.click()
    page.wait("-y above again", lambda: down() > 0.9)
    assert live.studio.session.scene.up == "-y"
