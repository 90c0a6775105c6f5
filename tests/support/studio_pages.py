"""Driving the studio's page in a real headless Chromium, for the browser tests.

Where there is no Chromium or no Playwright the tests are skipped with a line; with SPLATPAINTER_REQUIRE_BROWSER set
(as in CI) that is a failure. There is no graphics card to draw on: Mesa's llvmpipe draws where it is installed, else
SwiftShader, which is in every Chromium and takes two to three times as long. So views are small here.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import numpy as np
import pytest

from splatpainter.splats import Splats
from tests.support import studio_scenes

WITH_WINDOWS = ("chromium", "chromium-browser")
PROGRAMS = ("chromium-headless-shell", *WITH_WINDOWS)
"""The first one that is there. The headless shell has no windows and services around pages: it starts in half of the
CPU time, and opens pages in two thirds."""
FLAGS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync"
).split()
SWIFTSHADER = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LLVMPIPE = ("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
LLVMPIPE_ENVIRONMENT = {"EGL_PLATFORM": "surfaceless", "LIBGL_ALWAYS_SOFTWARE": "1"}
WITHOUT_LLVMPIPE: set[str] = set()
"""Chromium programs that turned out to draw with something else."""
DRIVER = """() => {
  const context = document.createElement("canvas").getContext("webgl2");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  return names ? context.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
}"""
SOFTWARE_COMPOSITING = "--disable-gpu-compositing"
"""The page around the view is put together without GL, which SwiftShader would emulate: half of the browser's time."""
READS_OF_COMPOSITOR = "GPU stall due to ReadPixels"
"""In the driver's message about the compositor, which then reads the view back. Not ignored with GPU compositing."""
STATIC = Path(__file__).resolve().parents[2] / "src/splatpainter/server/static"
WEB = Path(__file__).resolve().parents[2] / "web"
IDLE_TABS: dict[Any, list[Any]] = {}
"""Browser -> tabs that pages have left, the latest last. A new tab would be a new process, which compiles the code and
its shaders anew: a third of the time of most tests."""
FEW_PIXELS = "0.25"
"""Pixels of the view per pixel of the screen, in each direction: fewer than users can choose. SwiftShader's time
for those of a view at half resolution was half of the time of all browser tests."""
PATIENCE = 90.0
"""Seconds until something that must happen is taken as not happening."""
SHORTEST_PAUSE_MS, LONGEST_PAUSE_MS = 40.0, 150.0
"""Between two questions whether it has happened: longer and longer, as each one is work for four processes."""


def chromium(programs: tuple[str, ...] = PROGRAMS) -> str:
    """The browser's program; skips, or fails where it must be there."""
    program = os.environ.get("SPLATPAINTER_CHROMIUM") or next(filter(None, map(shutil.which, programs)), None)
    missing = "no Chromium (apt install chromium, or set SPLATPAINTER_CHROMIUM)" if program is None else ""
    try:
        import playwright.sync_api as _  # noqa: F401
    except ImportError:
        missing = "no Playwright (pip install playwright)"
    if missing and os.environ.get("SPLATPAINTER_REQUIRE_BROWSER"):
        pytest.fail(f"browser tests must run here, but there is {missing}")
    if missing:
        pytest.skip(f"browser tests: {missing}")
    assert program is not None
    return program


@contextlib.contextmanager
def browsing() -> Iterator[Any]:
    """A Playwright browser."""
    program = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = _with_llvmpipe(playwright, program)
        if browser is None:
            flags = [*FLAGS, *SWIFTSHADER, SOFTWARE_COMPOSITING]
            browser = playwright.chromium.launch(executable_path=program, args=flags)
        try:
            yield browser
        finally:
            IDLE_TABS.pop(browser, None)
            browser.close()


def _with_llvmpipe(playwright: Any, program: str) -> Any:
    """A browser that draws with Mesa's llvmpipe; None where it is not installed."""
    if sys.platform != "linux" or program in WITHOUT_LLVMPIPE:
        return None
    environment = {**os.environ, **LLVMPIPE_ENVIRONMENT}
    flags = [*FLAGS, *LLVMPIPE, SOFTWARE_COMPOSITING]
    browser = playwright.chromium.launch(executable_path=program, args=flags, env=environment)
    tab = browser.new_page()
    if "llvmpipe" in tab.evaluate(DRIVER):
        IDLE_TABS[browser] = [tab]
        return browser
    browser.close()
    WITHOUT_LLVMPIPE.add(program)
    return None


READ = """async () => {
  const image = await window.studio.viewer.read();
  let text = "";
  for (let k = 0; k < image.data.length; k += 8192)
    text += String.fromCharCode(...image.data.subarray(k, k + 8192));
  return [image.width, image.height, btoa(text)];
}"""
DROP = """([name, text, kind]) => {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([bytes], name, { type: kind }));
  const drop = new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true });
  document.querySelector(".app").dispatchEvent(drop);
}"""

ROWS_IN_VIEW = "(window.studio?.viewer.count > 0 && window.studio.viewer.camera !== null)"
"""JavaScript: whether the asset is on the screen. Gaussians go out before the greeting, from which the camera is."""
SET_RESOLUTION = """(select, resolution) => {
  if (select.value === resolution) return;
  if (![...select.options].some((option) => option.value === resolution)) select.add(new Option("Few", resolution));
  select.value = resolution;
  select.dispatchEvent(new Event("change", { bubbles: true }));
}"""
FROM_THE_START = """resolution => {
  window.resolutionOfView = resolution;  // of the script that was added last
  if (window.watchesResolution) return;
  window.watchesResolution = true;
  const set = %s;
  const watcher = new MutationObserver(() => {
    const select = document.querySelector('select[aria-label="Pixels"]');
    if (!select) return;
    watcher.disconnect();
    set(select, window.resolutionOfView);
  });
  watcher.observe(document, { childList: true, subtree: true });
}"""
"""Of each page that a tab loads: chosen before anything is drawn. The first pictures at the page's resolution were two
thirds of SwiftShader's time to open a page."""
LATE = """([words, pictures, sent = 0]) => {
  if (window.comesLate) return;
  window.comesLate = true;
  const Real = window.WebSocket;
  window.WebSocket = class extends Real {
    get onmessage() {
      return this.take;
    }
    set onmessage(take) {
      this.take = take;
      super.onmessage = (message) => {
        const wait = typeof message.data === "string" ? words : pictures;
        if (wait > 0) setTimeout(() => take(message), wait);
        else take(message);
      };
    }
    send(message) {
      if (sent > 0) setTimeout(() => this.readyState === Real.OPEN && super.send(message), sent);
      else super.send(message);
    }
  };
}"""
"""[words, pictures, sent], milliseconds: what the server says and draws reaches the page later, each kind in its own
order, and what the page sends reaches the server later: what busy machines do by chance."""
LATE_VARIABLE = "SPLATPAINTER_LATE"
"""Environment variable: "WORDS,PICTURES,SENT", milliseconds as of LATE, for every page. A test that fails with it
has not waited for what it reads."""
POINTER = """([type, id, kind, x, y, pressure]) => {
  const stage = document.getElementById("stage");
  const box = stage.getBoundingClientRect();
  stage.setPointerCapture = () => {};  // there is no such pointer to capture
  stage.dispatchEvent(new PointerEvent(type, {
    pointerId: id, pointerType: kind, pressure, button: type === "pointermove" ? -1 : 0, buttons: 1,
    clientX: box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true, cancelable: true,
  }));
}"""


class Page:
    """The studio in one browser window."""

    def __init__(
        self,
        browser: Any,
        url: str,
        width: int = 900,
        height: int = 520,
        *,
        gpu_compositing: bool = False,
        tab: Any = None,
        resolution: str = FEW_PIXELS,
    ) -> None:
        """gpu_compositing: that the browser was started without SOFTWARE_COMPOSITING. tab: one that another page has
        left; default: a new one. resolution: pixels of the view per pixel of the screen."""
        self.problems: list[str] = []
        """What the page's console complained of."""
        self.gpu_compositing = gpu_compositing
        self.requests: list[str] = []
        self.tab = browser.new_page() if tab is None else tab
        self.tab.set_viewport_size({"width": width, "height": height})
        self.listeners: dict[str, Callable[[Any], None]] = {
            "console": self.hear,
            "pageerror": lambda error: self.problems.append(str(error)),
            "request": lambda request: self.requests.append(request.url),
        }
        for event, listener in self.listeners.items():
            self.tab.on(event, listener)
        self.url = url
        self.resolution = resolution
        self.tab.add_init_script(f"({FROM_THE_START % SET_RESOLUTION})({json.dumps(resolution)})")
        if late := os.environ.get(LATE_VARIABLE):
            self.tab.add_init_script(f"({LATE})({json.dumps([float(one) for one in late.split(',')])})")
        self.open()

    def hear(self, message: Any) -> None:
        """Note what the console complains of."""
        from_compositor = not self.gpu_compositing and READS_OF_COMPOSITOR in message.text
        if message.type in ("error", "warning") and not from_compositor:
            self.problems.append(message.text)

    def open(self) -> None:
        """(Re)load and wait for the Gaussians."""
        self.tab.goto(self.url)
        self.tab.get_by_label("Pixels").evaluate(SET_RESOLUTION, self.resolution)
        self.wait("rows in a view", lambda: self.ask(ROWS_IN_VIEW))

    def set_resolution(self, resolution: str) -> None:
        """Pixels of the view per pixel of the screen, from now on."""
        width = self.camera()["width"]
        self.tab.get_by_label("Pixels").evaluate(SET_RESOLUTION, resolution)
        self.wait("a view of another size", lambda: self.camera()["width"] != width)

    def leave(self) -> None:
        """Make the tab as good as new: what it listened to, stored, emulated and pointed at. It goes to a file of the
        same server, as the browser would start another process for a page from elsewhere."""
        for event, listener in self.listeners.items():
            self.tab.remove_listener(event, listener)
        self.tab.mouse.move(0, 0)
        self.tab.goto(urljoin(self.url, "/favicon.svg"))
        self.ask("localStorage.clear()")
        self.tab.context.clear_cookies()
        self.tab.emulate_media(reduced_motion="null")

    def ask(self, script: str, value: Any = None) -> Any:
        """Evaluate JavaScript."""
        return self.tab.evaluate(script, value)

    def state(self) -> dict[str, Any]:
        """What the server last said."""
        return json.loads(self.ask("JSON.stringify(window.studio.state.value)"))  # a third of Playwright's own way

    def names(self) -> list[str]:
        """The layers, from the lowest."""
        return [layer["name"] for layer in self.state()["layers"]]

    def wait(self, what: str, ready: Callable[[], Any]) -> Any:
        """Until `ready` says something true, which is returned."""
        end, pause = time.monotonic() + PATIENCE, SHORTEST_PAUSE_MS
        while time.monotonic() < end:
            if answer := ready():
                return answer
            self.tab.wait_for_timeout(pause)
            pause = min(1.5 * pause, LONGEST_PAUSE_MS)
        raise AssertionError(f"the page did not get: {what}; it said {self.problems}")

    def pixels(self) -> np.ndarray:
        """[H, W, 3] float 0..1: the view as it is drawn."""
        width, height, text = self.ask(READ)
        return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)[..., :3] / 255

    def camera(self) -> dict[str, Any]:
        """Of the view."""
        return self.ask("window.studio.camera.value")

    def drag(self, *points: tuple[float, float], button: str = "left") -> None:
        """With the mouse over the view; points are shares of its width and height."""
        box = self.tab.locator("#stage").bounding_box()
        positions = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in points]
        self.tab.mouse.move(*positions[0])
        self.tab.mouse.down(button=button)
        for position in positions[1:]:
            self.tab.mouse.move(*position, steps=5)
        self.tab.mouse.up(button=button)

    def pointer(self, event: str, number: int, kind: str, x: float, y: float, pressure: float = 0.5) -> None:
        """A pen ("pen") or finger ("touch"), which Playwright has no hands for; x and y are shares of the view."""
        self.ask(POINTER, [f"pointer{event}", number, kind, x, y, pressure])

    def settled(self) -> None:
        """Until every stroke is a layer and the overlay is gone."""
        self.wait("saved strokes", lambda: self.tab.locator(".connection").inner_text().strip() == "Saved")

    def lay_text(self, text: str) -> None:
        """A layer of it in the middle of the view, facing the camera; the tool's settings stay in sight."""
        self.tab.keyboard.press("t")
        self.more()
        self.tab.get_by_label("On the surface").uncheck()
        self.tab.get_by_role("textbox", name="Text", exact=True).fill(text)
        self.drag((0.5, 0.5))
        self.wait("the text", lambda: self.tab.get_by_role("button", name="Apply").count())
        self.tab.locator("#stage").press("Enter")
        self.wait("the layer", lambda: self.names() == [f"Text: {text}"])

    def more(self) -> None:
        """Bring into sight the tool's settings that do not fit into its bar."""
        button = self.tab.locator(".options .more button")
        self.wait("settings that do not fit", button.count)
        if button.get_attribute("aria-pressed") == "false":
            button.click()

    def fold(self) -> None:
        """Put away what `more` brought out: the view is as high as it was."""
        for button in self.tab.locator(".settings-bar .more button[aria-pressed=true]").all():
            button.click()
            self.wait("folded settings", lambda: not self.tab.locator(".options-row.open").count())
            self.ask("new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(next)))")  # its new size

    def serious(self) -> list[str]:
        """What axe calls serious or critical about the page as it is; skips where axe is not installed."""
        axe = WEB / "node_modules/axe-core/axe.min.js"
        if not axe.is_file():
            pytest.skip(f"axe is not installed: run `npm ci` in {WEB.name}/")
        if not self.ask("!!window.axe"):
            self.ask(f"(0, eval)({json.dumps(axe.read_text(encoding='utf-8'))})")
        violations = self.ask("axe.run({ resultTypes: ['violations'] }).then((result) => result.violations)")
        impacts = ("serious", "critical")
        return [f"{one['id']}: {one['nodes'][0]['html']}" for one in violations if one["impact"] in impacts]

    def drop(self, name: str, data: bytes, kind: str) -> None:
        """Drop a file on the window."""
        self.ask(DROP, [name, base64.b64encode(data).decode(), kind])


@contextlib.contextmanager
def window(browser: Any, url: str, *, still: bool = False, resolution: str = FEW_PIXELS) -> Iterator[Page]:
    """A page of a studio, which must not complain. still: nothing in it glides."""
    idle = IDLE_TABS.setdefault(browser, [])
    page = Page(browser, url, tab=idle.pop() if idle else None, resolution=resolution)
    if still:
        page.tab.emulate_media(reduced_motion="reduce")
    try:
        yield page
        assert page.problems == [], page.problems
        page.leave()
    except BaseException:
        page.tab.close()
        raise
    idle.append(page.tab)


@contextlib.contextmanager
def opened_page(
    browser: Any, folder: Path, *, splats: Splats | None = None, still: bool = False, resolution: str = FEW_PIXELS
) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, or with `splats`, and its page. Where there is a `folder`/shared, its files may be
    named."""
    shared = folder / "shared"
    studio = studio_scenes.make_studio(folder, splats, shared=shared if shared.is_dir() else None)
    with (
        studio_scenes.live(studio) as live,
        window(browser, live.url, still=still, resolution=resolution) as page,
    ):
        yield live, page
