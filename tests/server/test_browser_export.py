"""What the page gives out: the asset in every format with its size before it is written, films, views of any size, and
a page of its own that shows the asset from disk."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, look_at
from splatpainter.image_files import find_camera
from splatpainter.io import read
from splatpainter.rendering import render
from splatpainter.server.html_viewer import html_viewer
from splatpainter.splats import Splats
from splatpainter.video.mp4 import avif_samples
from tests.support import studio_scenes
from tests.support.studio_pages import PATIENCE, Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    with opened_page(browser, tmp_path, still=True) as (live, page):
        yield live, page


def downloaded(page: Page, button: str) -> tuple[str, bytes]:
    """(name, bytes) of what a button of the dialog gives out."""
    with page.tab.expect_download(timeout=1000 * PATIENCE) as download:
        page.tab.locator("dialog").get_by_role("button", name=button, exact=True).click()
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_every_format_says_its_size_before_it_is_written(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.tab.keyboard.press("Control+s")
    rows = page.tab.locator(".formats label")
    page.wait("sizes", lambda: all("about" in text for text in rows.all_inner_texts()))
    estimates = {}
    for text in rows.all_inner_texts():
        name, number, unit = re.search(r"^(.+?)\n.*about ([\d.]+) (kB|MB)", text, re.S).groups()  # type: ignore[union-attr]
        estimates[name.strip()] = float(number) * {"kB": 1e3, "MB": 1e6}[unit]
    for name, start in (("PLY", b"ply"), ("SPZ", b"NGSP"), ("SOG", b"PK"), ("Web page", b"<!doctype html>")):
        page.tab.locator(".formats label", has=page.tab.get_by_text(name, exact=True)).click()
        file, data = downloaded(page, "Export")
        assert data.startswith(start) or start == b"NGSP", file
        assert abs(estimates[name] - len(data)) <= 0.08 * len(data) + 500, (name, estimates[name], len(data))
    assert file == "ball.html" and b"</html>" in data[-20:]
    page.tab.locator(".formats label", has=page.tab.get_by_text("SPZ", exact=True)).click()
    dialog, row = page.tab.locator("dialog"), page.tab.locator(".formats label:has(input[value='.spz'])")
    usual = row.inner_text()
    dialog.get_by_label("SH degree").select_option("0")
    dialog.get_by_label("Version").select_option("4")
    page.wait("the size with options", lambda: "about" in row.inner_text() and row.inner_text() != usual)
    file, data = downloaded(page, "Export")
    live.studio.scratch.path.joinpath(file).write_bytes(data)
    written = read(live.studio.scratch.path / file)
    assert data.startswith(b"NGSP") and written.sh_degree == 0 < live.studio.session.splats.sh_degree
    least = float(re.search(r"about ([\d.]+) kB", row.inner_text()).group(1))  # type: ignore[union-attr]
    assert abs(1e3 * least - len(data)) <= 0.08 * len(data) + 500 and least < estimates["SPZ"]
    line = page.tab.locator(".python code").inner_text()
    assert line == f"session.files.export('{file}', options=sp.WriteOptions(sh_degree=0, spz_version=4))"
    page.tab.locator(".formats label", has=page.tab.get_by_text("PLY", exact=True)).click()
    dialog.get_by_label("Axes").select_option(label="y up, z back (OpenGL, three.js)")
    file, data = downloaded(page, "Export")
    assert "axes='rub'" in page.tab.locator(".python code").inner_text() and data.startswith(b"ply")


def test_a_film_of_the_chosen_size_and_background(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.get_by_role("tab", name="Views").click()
    page.tab.get_by_role("button", name="Turntable...").click()
    dialog = page.tab.locator("dialog")
    dialog.get_by_label("Size").select_option("custom")
    dialog.get_by_label("Width").fill("99999")
    assert dialog.get_by_role("button", name="Render and download").is_disabled()
    dialog.get_by_label("Width").fill("64")
    dialog.get_by_label("Height").fill("120")
    dialog.get_by_label("Background").select_option("color")
    dialog.get_by_label("Colour of the background").fill("#30c050")
    dialog.get_by_label("Seconds, number").fill("1")
    dialog.get_by_label("Seconds, number").press("Enter")
    dialog.get_by_label("Frames").select_option("15")
    name, data = downloaded(page, "Render and download")
    samples = avif_samples(data)
    assert (name, samples.width, samples.height, len(samples.frames)) == ("turntable.mp4", 64, 120, 15)
    player = page.tab.context.browser.new_page()  # the studio's page itself may play nothing
    seen = player.evaluate(FIRST_AND_LATER_FRAME, list(data))
    player.close()
    assert seen["size"] == [64, 120] and abs(seen["seconds"] - 1) < 0.01
    assert np.abs(np.subtract(seen["corner"], (0x30, 0xC0, 0x50))).max() < 8
    assert seen["difference"] > 3, "it turns"


FIRST_AND_LATER_FRAME = """async (bytes) => {
  const video = document.createElement("video");
  video.muted = true;
  video.src = URL.createObjectURL(new Blob([new Uint8Array(bytes)], { type: "video/mp4" }));
  await new Promise((ready, failed) => ((video.onloadeddata = ready), (video.onerror = () => failed(video.error))));
  const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const at = async (time) => {
    const sought = new Promise((done) => video.requestVideoFrameCallback(done));
    video.currentTime = time;
    await sought;
    context.drawImage(video, 0, 0);
    return context.getImageData(0, 0, canvas.width, canvas.height).data;
  };
  const [first, later] = [await at(0.01), await at(0.3)];
  const difference = first.reduce((sum, value, k) => sum + Math.abs(value - later[k]), 0) / first.length;
  const size = [video.videoWidth, video.videoHeight];
  return { size, seconds: video.duration, corner: [...first.slice(0, 3)], difference };
}"""


def test_a_view_of_another_shape_shows_what_the_window_shows(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.tab.get_by_role("tab", name="Views").click()
    page.tab.get_by_role("button", name="More...").click()
    dialog = page.tab.locator("dialog")
    dialog.get_by_label("Size").select_option("custom")
    dialog.get_by_label("Width").fill("90")
    dialog.get_by_label("Height").fill("150")
    dialog.get_by_label("Background").select_option("straight")
    name, data = downloaded(page, "Download")
    picture = Image.open(io.BytesIO(data))
    assert name.endswith(".png") and picture.size == (90, 150) and picture.mode == "RGBA"
    Path(live.studio.scratch.path / "view.png").write_bytes(data)
    camera, window = find_camera(live.studio.scratch.path / "view.png"), page.camera()
    assert camera.fx / 90 == pytest.approx(window["fx"] / min(window["width"], window["height"]))
    alpha = np.asarray(picture)[..., 3] / 255
    assert np.abs(alpha - render(live.studio.session.splats, camera).alphas[0, ..., 0]).max() < 0.01


def wide_ball() -> Splats:
    """One with all that a page has to carry: SH of degree 3, and Gaussians that cannot be drawn."""
    splats, rng = studio_scenes.ball(500), np.random.default_rng(1)
    sh = np.concatenate([splats.sh, rng.normal(0, 0.05, (500, 12, 3)).astype(np.float32)], 1)
    means = splats.means.copy()
    means[7] = np.nan
    return Splats(means, splats.quats, splats.scales, splats.opacities, sh)


def page_camera(name: str = "") -> Camera:
    return look_at((1.2, -1.0, -3.0), (0, 0, 0), (0, -1, 0), width=320, height=320, fov=45, background=(0.2, 0.3, 0.4))


def test_the_asset_as_one_file_opens_from_disk_and_asks_for_nothing(browser: Any, tmp_path: Path) -> None:
    """45 dB at least against the renderer, SH degree 3, with a name that would be markup; it turns by hand and keys."""
    splats, camera = wide_ball(), page_camera()
    file = tmp_path / "page.html"
    file.write_bytes(html_viewer(splats, camera, (0, -1, 0), "</script><b>ball</b> & co"))
    tab = browser.new_page(viewport={"width": 320, "height": 320})
    requests, problems = [], []
    tab.on("request", lambda request: requests.append(request.url))
    tab.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: problems.append(str(error)))
    try:
        tab.goto(file.as_uri())
        end = time.monotonic() + PATIENCE
        while not tab.evaluate("!!window.splat"):
            assert time.monotonic() < end and not problems, problems
            tab.wait_for_timeout(50)
        pixels = tab.evaluate("splat.viewer.read().then((image) => [...image.data])")
        seen = np.array(pixels, float).reshape(320, 320, 4)[..., :3] / 255
        truth = np.clip(render(splats, camera).colors[0], 0, 1)
        assert -10 * np.log10(np.mean((seen - truth) ** 2)) > 45
        assert tab.title() == "</script><b>ball</b> & co" == tab.locator("h1").inner_text()
        before = tab.evaluate("splat.pose().eye")
        tab.mouse.move(160, 160)
        tab.mouse.down()
        tab.mouse.move(220, 160, steps=3)
        tab.mouse.up()
        dragged = tab.evaluate("splat.pose().eye")
        tab.locator("main").press("ArrowLeft")
        turned = tab.evaluate("splat.pose().eye")
        distances = [np.linalg.norm(eye) for eye in (before, dragged, turned)]
        assert np.linalg.norm(np.subtract(before, dragged)) > 0.3 and np.linalg.norm(np.subtract(dragged, turned)) > 0.1
        assert max(distances) - min(distances) < 0.5
        tab.emulate_media(reduced_motion="reduce")
        tab.get_by_role("button", name="Reset").click()
        assert np.allclose(tab.evaluate("splat.pose().eye"), before)
        assert [url for url in requests if not url.startswith(("blob:", "data:"))] == [file.as_uri()]
        assert problems == []
    finally:
        tab.close()


def test_a_page_says_why_it_cannot_show_the_asset(browser: Any, tmp_path: Path) -> None:
    file, data = tmp_path / "page.html", html_viewer(wide_ball(), page_camera(), (0, -1, 0), "ball")
    file.write_bytes(data.replace(b'"count": 500', b'"count": 501'))
    tab = browser.new_page(viewport={"width": 320, "height": 320})
    try:
        tab.goto(file.as_uri())
        tab.get_by_role("alert").wait_for(timeout=1000 * PATIENCE)
        assert "cannot be shown: expected" in tab.get_by_role("alert").inner_text()
    finally:
        tab.close()


STATES_SEEN = """() => {
  window.statesSeen = [];
  const badge = document.querySelector(".connection");
  const look = () => window.statesSeen.push(badge.innerText.trim());
  new MutationObserver(look).observe(badge, { childList: true, subtree: true, characterData: true, attributes: true });
}"""


def test_the_state_says_working_while_a_film_is_rendered(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.get_by_role("tab", name="Views").click()
    page.tab.get_by_role("button", name="Turntable...").click()
    dialog = page.tab.locator("dialog")
    dialog.get_by_label("Size").select_option("custom")
    for side in ("Width", "Height"):
        dialog.get_by_label(side).fill("64")
    dialog.get_by_label("Seconds, number").fill("1")
    dialog.get_by_label("Seconds, number").press("Enter")
    dialog.get_by_label("Frames").select_option("15")
    page.tab.evaluate(STATES_SEEN)
    downloaded(page, "Render and download")
    page.wait("the end", lambda: page.tab.locator(".connection").inner_text().strip() == "Saved")
    seen = page.tab.evaluate("window.statesSeen")
    assert "Working" in seen and seen[-1] == "Saved", seen
