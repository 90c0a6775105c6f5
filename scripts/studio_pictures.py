"""Remake the pictures of the studio in docs/images: the screenshots of its guide (studio*.jpg) and the README's moving
picture (painting.webp), by driving a real Chromium over a studio of the demo asset.

    python scripts/studio_pictures.py [NAME ...]    # studio, paint, select, text, layers, light, files, moving

Needs Playwright, Chromium and the built page. A minute or two; nothing of it depends on the machine's speed.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Page

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.studio_pages import browsing  # noqa: E402

IMAGES = ROOT / "docs" / "images"
ASSET = ROOT / "src" / "splatpainter" / "demo_asset.sog"
SIZE = (1280, 800)
"""Of the window, pixels."""
WIDTH = 1100
"""Of a screenshot in the guide, pixels."""
LARGEST = 150_000
"""Bytes of a picture."""
MOVING_SIZE = (900, 520)
FRAME_SIZE = (420, 300)
"""Of the moving picture's window, and of its frames, pixels."""
EMPTY_ABOVE = 0.17
"""Share of the view above the teapot that is left out."""
FRAME_MS, LAST_FRAME_MS = 90, 1200
"""How long frames are shown."""
PATIENCE = 120.0
"""Seconds."""
LEMON = (0.677, 0.601)
"""Middle of the lemon on the view from behind, shares of the view's width and height."""


class Artist:
    """One who works in the studio's page."""

    def __init__(self, tab: Page) -> None:
        self.tab = tab
        self.press = tab.keyboard.press

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Page pixels of a point of the view, shares of its width and height."""
        box = self.tab.locator("#stage").bounding_box()
        assert box is not None
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def drag(self, *points: tuple[float, float], each: Callable[[], None] = lambda: None) -> None:
        """With the mouse; `each` is called where it is."""
        self.tab.mouse.move(*self.point(*points[0]))
        self.tab.mouse.down()
        for one in points[1:]:
            self.tab.mouse.move(*self.point(*one), steps=1)
            each()
        self.tab.mouse.up()

    def until(self, script: str) -> None:
        """Until an expression is true. Asked again and again: the page's policy lets no script of ours wait in it."""
        end = time.monotonic() + PATIENCE
        while not self.tab.evaluate(script):
            if time.monotonic() > end:
                raise SystemExit(f"studio_pictures: the page did not get to: {script}")
            self.tab.wait_for_timeout(150)

    def saved(self) -> None:
        """Until everything is a layer and the picture is that state."""
        self.until("document.querySelector('.connection').innerText.trim() === 'Saved'")
        self.tab.wait_for_timeout(400)

    def from_behind(self) -> None:
        self.press("Control+Numpad1")
        self.tab.wait_for_timeout(600)
        self.saved()

    def use(self, key: str, color: str = "", size: float = 0, **brush: float) -> None:
        """Take up a tool, in a colour and with a brush of a size."""
        self.press(key)
        if color:
            self.tab.locator(".swatch input").evaluate(
                "(field, value) => { field.value = value; for (const name of ['input', 'change'])"
                " field.dispatchEvent(new Event(name, { bubbles: true })); }",
                color,
            )
        for label, value in {"Size": size, **brush}.items():
            if value:
                field = self.tab.locator(".options").get_by_label(f"{label}, number")
                field.fill(str(value))
                field.press("Enter")

    def stripes(self, colors: tuple[str, ...] = ("#2456a8", "#c8442e", "#2456a8")) -> None:
        """Paint stripes on the lemon."""
        x, y = LEMON
        for k, color in enumerate(colors):
            self.use("b", color, 16)
            off = 0.03 * (k - 1)
            self.drag(*[(x + off + 0.012 * math.sin(t), y - 0.05 + 0.019 * t) for t in range(6)])
        self.saved()

    def word(self, text: str) -> None:
        """Write on the teapot's front; the words are not laid yet."""
        self.use("t", "#c8442e")
        self.until("!!window.studio.surface(0.5, 0.55)")
        self.tab.mouse.click(*self.point(0.5, 0.555))
        self.tab.wait_for_timeout(300)
        self.tab.keyboard.type(text)
        self.until("!!window.studio.placement.value?.anchor")

    def flat_away(self) -> None:
        """Until what is placed is shown as it will be laid."""
        self.until("!document.querySelector('.options').innerText.includes('Flat until')")
        self.tab.wait_for_timeout(400)

    def tab_of(self, name: str) -> None:
        self.tab.get_by_role("tab", name=name).click()
        self.tab.wait_for_timeout(300)


def studio(artist: Artist) -> None:
    artist.word("TEA")
    artist.flat_away()
    artist.press("Enter")
    artist.until("window.studio.state.value.layers.length === 1")
    artist.saved()
    artist.use("b", "#e0b030", 14)
    artist.drag(*[(0.42 + 0.012 * t, 0.335 - 0.006 * math.sin(t / 3)) for t in range(14)])
    artist.saved()
    artist.tab_of("History")


def paint(artist: Artist) -> None:
    artist.from_behind()
    artist.stripes()
    artist.tab_of("Brush")
    artist.tab.mouse.move(*artist.point(0.62, 0.52))
    artist.tab.wait_for_timeout(500)


def select(artist: Artist) -> None:
    artist.from_behind()
    artist.press("l")
    x, y = LEMON
    turns = [2 * math.pi * k / 24 for k in range(25)]
    artist.drag(*[(x + 0.085 * math.cos(t), y + 0.11 * math.sin(t)) for t in turns])
    artist.until("window.studio.state.value.selection.gaussians > 0")
    artist.tab.wait_for_timeout(1500)


def text(artist: Artist) -> None:
    artist.word("Earl Grey")
    artist.flat_away()


def layers(artist: Artist) -> None:
    artist.from_behind()
    artist.stripes(("#2456a8",))
    artist.tab_of("Adjust")
    for label, value in (("Temperature", 0.5), ("Saturation", 0.3)):
        field = artist.tab.locator("#tab-panel").get_by_label(f"{label}, number").first
        field.fill(str(value))
        field.press("Enter")
    artist.saved()


def files(artist: Artist) -> None:
    artist.press("Control+s")
    artist.until("[...document.querySelectorAll('.formats .size')].every((one) => one.innerText.includes('about'))")
    artist.tab.locator("dialog").get_by_label("Axes").focus()


def light(artist: Artist) -> None:
    """A sunset, a sun from the left, and a warm lamp before the pot."""
    artist.tab_of("Light")
    artist.until("document.querySelectorAll('.skies img').length >= 8")
    artist.tab.get_by_role("radio", name="Sunset").click()
    artist.saved()
    artist.tab.get_by_role("button", name="Sun", exact=True).click()
    artist.saved()
    artist.tab.get_by_role("button", name="Point", exact=True).click()
    artist.saved()
    artist.until("!document.querySelector('.layer .spinner')")
    artist.tab.wait_for_timeout(800)


SCREENSHOTS: dict[str, Callable[[Artist], None]] = {
    "studio": studio,
    "paint": paint,
    "select": select,
    "text": text,
    "layers": layers,
    "light": light,
    "files": files,
}


def moving(artist: Artist) -> list[Image.Image]:
    """A stroke changes the asset, which is turned then."""
    frames: list[Image.Image] = []

    def frame() -> None:
        box = artist.tab.locator("#stage").bounding_box()
        assert box is not None
        top, height = box["y"] + EMPTY_ABOVE * box["height"], (1 - EMPTY_ABOVE) * box["height"]
        width = height * FRAME_SIZE[0] / FRAME_SIZE[1]
        clip = {"x": box["x"] + (box["width"] - width) / 2, "y": top, "width": width, "height": height}
        data = artist.tab.screenshot(clip=clip)  # type: ignore[arg-type]
        frames.append(Image.open(io.BytesIO(data)).convert("RGB").resize(FRAME_SIZE, Image.Resampling.LANCZOS))

    artist.tab.set_viewport_size({"width": MOVING_SIZE[0], "height": MOVING_SIZE[1]})
    artist.saved()
    artist.use("b", "#c8442e", 22)
    artist.tab.locator(".gizmo").evaluate("(one) => (one.style.visibility = 'hidden')")
    frame()
    turns = [k / 13 for k in range(14)]
    artist.drag(*[(0.41 + 0.2 * t, 0.52 + 0.05 * math.sin(6.3 * t)) for t in turns], each=frame)
    artist.use("b", "#2456a8", 14)
    artist.drag(*[(0.42 + 0.18 * t, 0.6 + 0.03 * math.sin(9 * t)) for t in turns[::2]], each=frame)
    artist.saved()
    artist.tab.mouse.move(2, 2)
    for key in ["ArrowRight"] * 8 + ["ArrowLeft"] * 8:
        artist.press(key)
        artist.tab.evaluate("window.studio.viewer.settle()")
        artist.tab.wait_for_timeout(150)
        frame()
    return frames


@contextlib.contextmanager
def served() -> Iterator[str]:
    """The address of a studio of the demo asset; its project goes with it."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "splatpainter", "studio", str(ASSET), "--no-browser"]
        environment = {**os.environ, "SPLATPAINTER_PROJECTS": folder}
        server = subprocess.Popen(command, stderr=subprocess.PIPE, env=environment, encoding="utf-8")
        assert server.stderr is not None
        try:
            yield next(found[0] for line in server.stderr if (found := re.search(r"http://\S+", line)))
        finally:
            server.terminate()
            server.wait()


@contextlib.contextmanager
def working(browser: Any) -> Iterator[Artist]:
    """An artist before a new studio."""
    with served() as url:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, reduced_motion="reduce")
        page.add_init_script("localStorage.setItem('splatpainter.tour', 'seen')")
        page.goto(url)
        artist = Artist(page)
        artist.until("(window.studio?.viewer.count ?? 0) > 0")
        artist.saved()
        yield artist
        page.close()


def write(path: Path, save: Callable[[Path, int], None]) -> None:
    """With the best quality that keeps within the bounds."""
    for quality in (85, 80, 75, 70, 62, 54, 46, 38):
        save(path, quality)
        size = path.stat().st_size
        if size <= LARGEST:
            print(f"{path.relative_to(ROOT)}: {size} bytes, quality {quality}")
            return
    raise SystemExit(f"{path}: expected at most {LARGEST} bytes, got {size}")


def screenshot(artist: Artist, name: str) -> None:
    SCREENSHOTS[name](artist)
    shown = Image.open(io.BytesIO(artist.tab.screenshot())).convert("RGB")
    small = shown.resize((WIDTH, round(WIDTH * shown.height / shown.width)), Image.Resampling.LANCZOS)
    title = "studio" if name == "studio" else f"studio-{name}"
    write(
        IMAGES / f"{title}.jpg",
        lambda path, quality: small.save(path, quality=quality, optimize=True, progressive=True),
    )


def main(names: list[str]) -> int:
    known = (*SCREENSHOTS, "moving")
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SystemExit(f"studio_pictures: expected some of {', '.join(known)}, got {' '.join(unknown)}")
    with browsing() as browser:
        for name in names or known:
            with working(browser) as artist:
                if name != "moving":
                    screenshot(artist, name)
                    continue
                frames = moving(artist)
                times = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
                write(
                    IMAGES / "painting.webp",
                    lambda path, quality, frames=frames, times=times: frames[0].save(
                        path, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=quality, method=6
                    ),
                )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
