"""The window as users have it: dense screens, tablets held upright, a lost graphics card, words that are written."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from splatpainter.io import write
from splatpainter.server.commands import files as file_commands
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.server.work_queue import Ticket
from splatpainter.session import Session
from tests.support import studio_scenes
from tests.support.studio_pages import LATE, PATIENCE, ROWS_IN_VIEW, Page, opened_page

TOO_SMALL = """() => {
  const controls = document.querySelectorAll("button, select, input:not([hidden]), summary, [role=tab]");
  const shown = [...controls].filter((one) => one.checkVisibility() && one.getBoundingClientRect().width > 0);
  const nameOf = (one) => one.getAttribute("aria-label") || one.innerText || one.type;
  return shown
    .map((one) => [nameOf(one), (one.closest("label") ?? one).getBoundingClientRect()])
    .filter(([, { width, height }]) => width < 43.9 || height < 43.9)
    .map(([name, { width, height }]) => `${name}: ${Math.round(width)} x ${Math.round(height)}`);
}"""
"""Controls that a finger would miss: less than 44 pixels wide or high."""
BOX = "(name) => { const { x, y, width, height } = document.querySelector(name).getBoundingClientRect(); " + (
    "return [x, y, width, height]; }"
)


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    with opened_page(browser, tmp_path, still=True) as (live, page):
        yield live, page


@contextlib.contextmanager
def screen(browser: Any, folder: Path, width: int, height: int, resolution: str, **how: Any) -> Iterator[Page]:
    """A page on a screen of its own kind."""
    with studio_scenes.live(studio_scenes.make_studio(folder)) as live:
        context = browser.new_context(**how)
        try:
            page = Page(browser, live.url, width, height, tab=context.new_page(), resolution=resolution)
            page.tab.emulate_media(reduced_motion="reduce")
            yield page
            assert page.problems == []
        finally:
            context.close()


@pytest.mark.slow
def test_a_tablet_held_upright(browser: Any, tmp_path: Path) -> None:
    with screen(browser, tmp_path, 768, 1024, "0.25", has_touch=True, is_mobile=True) as page:
        tab = page.tab
        page.settled()
        x, y, width, height = page.ask(BOX, ".connection")
        assert width > 0 and x + width <= 768 and y + height < 60, "the state is in sight"
        assert page.ask(TOO_SMALL) == []
        for name in ("Brush", "Colours", "History", "Adjust", "Select", "Pictures", "Views", "Receipt"):
            tab.get_by_role("tab", name=name).click()
            assert page.ask(TOO_SMALL) == [], name
        for key in ("Control+s", "Control+o", "?"):
            tab.keyboard.press(key)
            tab.get_by_role("dialog").wait_for()
            assert page.ask(TOO_SMALL) == [], key
            tab.keyboard.press("Escape")
            page.wait("no dialogue", lambda: tab.get_by_role("dialog").count() == 0)
        before, camera = page.ask(BOX, "#stage"), page.camera()
        tab.get_by_role("button", name="Fold the panels away").click()
        page.wait("more room", lambda: page.ask(BOX, "#stage")[3] > before[3] + 200)
        page.wait("the view to fill it", lambda: page.camera()["height"] > camera["height"] + 40)
        now = page.camera()
        shorter = [min(one["width"], one["height"]) for one in (camera, now)]
        sizes = [one["fy"] / eye(one) / short for one, short in zip((camera, now), shorter, strict=True)]
        assert abs(sizes[0] / sizes[1] - 1) < 0.02, "the asset is as large in what is seen"
        tab.get_by_role("button", name="Show the panels").click()
        page.wait("the panels", lambda: page.ask(BOX, "#stage")[3] == before[3])
        page.wait("the view as it was", lambda: page.camera()["height"] == camera["height"])
        assert eye(page.camera()) == pytest.approx(eye(camera), rel=1e-9)


IN_SIGHT = """(name) => {
  const one = document.querySelector(name);
  const { x, y, right, width, height } = one.getBoundingClientRect();
  return x >= 0 && right <= innerWidth && one.contains(document.elementFromPoint(x + width / 2, y + height / 2));
}"""
"""Whether all of it is in the window, and nothing lies over it."""


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(390, 844), (600, 900), (900, 520)])
def test_nothing_lies_over_the_state_in_narrow_windows(browser: Any, tmp_path: Path, width: int, height: int) -> None:
    with screen(browser, tmp_path, width, height, "0.25", has_touch=True, is_mobile=True) as page:
        page.settled()
        for name in (".connection", ".header > .button:last-child", ".view-settings .more .button"):
            assert page.ask(IN_SIGHT, name), name
        for bar in (".view-settings", ".options"):
            page.tab.locator(f"{bar} .more .button").click()
            _, top, _, room = page.ask(BOX, "#stage")
            _, bar_top, _, bar_height = page.ask(BOX, f"{bar} .options-row")
            assert bar_top + bar_height <= top and room > 100
            page.tab.locator(f"{bar} .more .button").click()
        assert page.ask(CUT_OFF) == []


BEYOND = """() => {
  const controls = [...document.querySelectorAll("button, select, input, summary, dialog span")];
  const shown = controls.filter((one) => one.checkVisibility() && one.getBoundingClientRect().width > 0);
  const within = (one) => one.closest("dialog .formats label, .side > *") ?? document.body;
  const edgeOf = (one) => within(one).getBoundingClientRect().right;
  return shown
    .filter((one) => one.getBoundingClientRect().right > Math.min(innerWidth, edgeOf(one)) + 1)
    .map((one) => one.getAttribute("aria-label") || one.innerText || one.type);
}"""
"""Controls that reach out of their panel, or of the window; words of a dialogue that reach out of their row."""


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (820, 1180), (1024, 768)])
def test_every_panel_fits_where_fingers_touch(browser: Any, tmp_path: Path, width: int, height: int) -> None:
    """Hues made the panels of a tablet wider than they are; on a phone half of all sliders were outside."""
    with screen(browser, tmp_path, width, height, "0.25", has_touch=True, is_mobile=True) as page:
        page.settled()
        for tab in page.tab.get_by_role("tab").all():
            tab.click()
            assert page.ask(BEYOND) == [] and page.ask(TOO_SMALL) == [], tab.inner_text()
        assert page.ask(BOX, ".layer-settings input[type=range]")[2] > 40, "the opacity can be dragged"
        page.tab.keyboard.press("b")
        page.drag((0.45, 0.5), (0.55, 0.5))
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        assert page.ask(BEYOND) == [] and page.ask(TOO_SMALL) == [], "its words push nothing out of the last line"
        page.tab.keyboard.press("Control+s")
        page.tab.get_by_role("dialog").wait_for()
        assert page.ask(BEYOND) == [] and page.ask(TOO_SMALL) == []


CUT_OFF = """() => [...document.querySelectorAll(".options-row")].flatMap((row) => {
  const { left, right, bottom } = row.getBoundingClientRect();
  const boxes = [...row.children].map((one) => [one.innerText, one.getBoundingClientRect()]);
  return boxes.filter(([, b]) => b.top < bottom && (b.left < left - 1 || b.right > right + 1)).map(([text]) => text);
})"""
"""Settings in the first line of a bar of which only a part is seen."""
COLORS = "(names) => names.map((name) => getComputedStyle(document.querySelector(name)).backgroundColor)"


@pytest.mark.slow
def test_a_window_at_200_per_cent_and_in_the_system_s_colours(browser: Any, tmp_path: Path) -> None:
    """The panels pushed the header out of the window; what was chosen looked as everything else."""
    with screen(browser, tmp_path, 640, 360, "0.25") as page:
        tab = page.tab
        page.settled()
        for name in ("Brush", "History", "Light"):
            tab.get_by_role("tab", name=name).click()
            assert page.ask("[document.scrollingElement.scrollHeight, document.scrollingElement.scrollTop]") == [360, 0]
            assert page.ask(BOX, "#tab-panel")[3] > 100, name
        assert page.ask(BOX, ".header")[1] == 0 and page.ask(CUT_OFF) == []
        tab.emulate_media(forced_colors="active")
        pressed, other = page.ask(COLORS, [".toolbar [aria-pressed=true]", ".toolbar [aria-pressed=false]"])
        chosen, beside = page.ask(COLORS, ["[role=tab][aria-selected=true]", "[role=tab][aria-selected=false]"])
        assert pressed != other and chosen != beside
        track = "getComputedStyle(document.querySelector('input[type=range]')).forcedColorAdjust"
        assert page.ask(track) == "none", "the system would take its track away"


@pytest.mark.slow
def test_that_a_project_is_read_only_is_in_sight(browser: Any, tmp_path: Path) -> None:
    """It was cut off by the project's name, and nowhere on a tablet held upright."""
    studio_scenes.make_studio(tmp_path).session.close()
    studio = Studio(
        Session.load(tmp_path / "own.splatproj", readonly=True), "ball", StudioOptions(None, tmp_path / "projects")
    )
    with studio_scenes.live(studio) as live:
        page = Page(browser, live.url)
        for width, height in ((900, 520), (768, 1024), (390, 844)):
            page.tab.set_viewport_size({"width": width, "height": height})
            page.wait(f"it at {width}", lambda: page.ask(IN_SIGHT, ".header .tag"))
        page.tab.close()


def eye(camera: dict[str, Any]) -> float:
    """Distance of the camera from the ball's middle."""
    matrix = camera["world_to_camera"]
    return sum(matrix[k][3] ** 2 for k in range(3)) ** 0.5


@pytest.mark.slow
def test_the_view_has_the_pixels_of_a_dense_screen(browser: Any, tmp_path: Path) -> None:
    with screen(browser, tmp_path, 700, 420, "1", device_scale_factor=2) as page:
        _, _, width, height = page.ask(BOX, "#stage")
        camera = page.camera()
        assert (camera["width"], camera["height"]) == (round(2 * width), round(2 * height))
        radius = page.ask("window.studio.brushRadius(0.5, 0.5)")
        assert radius == pytest.approx(40, rel=1e-6), "a brush of 40 px is as wide on every screen"
        page.tab.keyboard.press("b")
        page.drag((0.45, 0.5), (0.55, 0.5))
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        page.set_resolution("2")
        camera = page.camera()
        assert 3.9e6 < camera["width"] * camera["height"] <= 4e6 or camera["width"] == round(4 * width)


def is_another(page: Page) -> bool:
    """Whether the page was loaded again; it cannot be asked while it is."""
    from playwright.sync_api import Error

    try:
        return page.ask(f"!window.before && {ROWS_IN_VIEW}")
    except Error:
        return False


@pytest.mark.slow
def test_a_lost_view_leaves_a_card_and_comes_back(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.keyboard.press("b")
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("a stroke", lambda: page.names() == ["Paint"])
    page.settled()
    page.pointer("down", 9, "pen", 0.45, 0.6)
    page.pointer("move", 9, "pen", 0.55, 0.6)
    page.ask("""() => {
      window.before = true;
      window.studio.viewer.renderer.getContext().getExtension("WEBGL_lose_context").loseContext();
    }""")
    card = page.tab.get_by_role("alert").filter(has_text="The graphics card took the view away")
    card.wait_for()
    assert "reloads in two seconds" in card.inner_text()
    page.tab.wait_for_timeout(1000)
    assert card.count() == 1 and page.ask("window.before"), "it stays until then"
    page.wait("another page", lambda: is_another(page))
    page.wait(
        "the stroke that was under the pen, too", lambda: [one["strokes"] for one in page.state()["layers"]] == [2]
    )
    page.settled()
    assert card.count() == 0
    page.problems = [one for one in page.problems if "Context Lost" not in one and "CONTEXT_LOST" not in one]


@pytest.mark.slow
def test_gaussians_that_come_long_before_the_greeting(browser: Any, tmp_path: Path) -> None:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        tab = browser.new_page()
        tab.add_init_script(f"({LATE})([700, 0])")
        page = Page(browser, live.url, tab=tab)
        assert page.pixels().std() > 0.01, "the ball is drawn"
        page.tab.keyboard.press("b")
        page.drag((0.45, 0.5), (0.55, 0.5))
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        assert page.problems == []
        tab.close()


@pytest.mark.slow
def test_a_click_with_the_text_tool_is_a_caret(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Letters are words, not shortcuts: B, E and E chose tools and dropped the text."""
    _, page = opened
    tab, keys = page.tab, page.tab.keyboard
    keys.press("t")
    tab.get_by_role("checkbox", name="On the surface", exact=True).uncheck()
    page.drag((0.5, 0.5))
    keys.type("BEE")
    field = tab.get_by_role("textbox", name="Text", exact=True)
    assert field.input_value() == "BEE"
    pressed = tab.get_by_role("button", name="Text", exact=True).get_attribute("aria-pressed")
    assert pressed == "true" and page.ask("window.studio.placement.value.kind") == "text"
    page.drag((0.5, 0.5), (0.52, 0.45))  # moved; the view has the keys
    assert page.ask("document.activeElement.id") == "stage"
    keys.type("S")
    assert field.input_value() == "BEES" and page.ask("window.studio.placement.value?.kind") == "text"
    keys.press("Backspace")
    assert field.input_value() == "BEE"
    keys.press("Enter")
    page.wait("its layer", lambda: page.names() == ["Text: BEE"])
    page.settled()
    keys.press("b")
    assert tab.get_by_role("button", name="Brush", exact=True).get_attribute("aria-pressed") == "true"


def picture_file() -> bytes:
    """A PNG of one colour."""
    file = io.BytesIO()
    Image.new("RGB", (40, 24), (20, 60, 200)).save(file, "png")
    return file.getvalue()


@pytest.mark.slow
def test_keys_mean_the_picture_that_is_being_placed(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Undo took strokes back while it moved nothing, Delete deleted the layer below, another tool left it there."""
    live, page = opened
    keys = page.tab.keyboard
    page.drag((0.5, 0.4), (0.55, 0.4))
    page.settled()
    keys.press("p")
    page.tab.get_by_role("checkbox", name="On the surface", exact=True).uncheck()

    def drop_picture() -> None:
        page.drop("stripe.png", picture_file(), "image/png")
        page.wait("it", lambda: page.ask("window.studio.placement.value !== null"))

    def x() -> Any:
        """Where it stands, a share of the view's width; None: nowhere."""
        return page.ask("(() => { const p = window.studio.placement.value; return p && p.x; })()")

    drop_picture()
    start = x()
    keys.press("ArrowRight")
    near = x()
    keys.press("Shift+ArrowRight")
    assert x() - near == pytest.approx(10 * (near - start)) and near > start
    keys.press("Control+z")
    keys.press("Control+z")
    assert x() == start
    page.drag((0.5, 0.5), (0.6, 0.5))
    moved = x()
    page.drag((0.6, 0.5), (0.7, 0.5))
    keys.press("Control+z")
    assert x() == moved
    keys.press("Control+Shift+z")
    assert x() > moved
    keys.press("Control+z")
    keys.press("Control+z")
    assert x() == start
    keys.press("Control+z")
    assert x() is None and page.state()["cursor"] == 1, "the stroke stays"
    drop_picture()
    box = page.tab.locator("#stage").bounding_box()
    page.tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.tab.mouse.down()
    keys.press("b")
    page.tab.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + box["height"] / 2)
    page.tab.mouse.up()
    assert x() is None
    keys.press("p")
    drop_picture()
    keys.press("Delete")
    assert x() is None and page.names() == ["Paint"]
    drop_picture()
    keys.press("Enter")
    page.wait("its layer", lambda: page.names() == ["Paint", "stripe"])
    page.settled()
    page.tab.get_by_role("button", name="Change stripe").click()
    page.wait("it to be hidden", lambda: not page.state()["layers"][1]["visible"])
    live.post("layer.delete", layer=page.state()["layers"][1]["id"])
    page.wait("it to be deleted elsewhere", lambda: page.names() == ["Paint"])
    keys.press("Enter")
    page.wait("a layer of its own", lambda: page.names() == ["Paint", "stripe"])
    page.settled()
    page.tab.get_by_role("button", name="Change stripe").click()
    page.wait("it to be hidden", lambda: not page.state()["layers"][1]["visible"])
    keys.press("Delete")
    page.wait("it to go with its layer", lambda: x() is None and page.names() == ["Paint"])
    keys.press("Control+z")
    page.wait("it as it was", lambda: [layer["visible"] for layer in page.state()["layers"]] == [True, True])
    page.tab.locator(".layer-name").first.click()
    page.tab.get_by_role("textbox", name="Opacity, number").last.click()
    keys.type("40")
    keys.press("Control+s")  # the browser would save its page
    page.wait("the dialogue", lambda: page.ask("document.activeElement.name") == "format")
    page.wait("the opacity", lambda: page.state()["layers"][1]["opacity"] == 0.4)


@pytest.mark.slow
def test_a_stroke_for_which_the_disk_has_no_room_is_kept_and_saved_elsewhere(browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True) as (live, page):
        tab, project = page.tab, page.state()["project"]["id"]
        tab.keyboard.press("b")
        page.drag((0.45, 0.4), (0.55, 0.4))
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        studio_scenes.fill_disk(live.studio.session)
        page.drag((0.45, 0.5), (0.55, 0.5))
        card = tab.get_by_role("alert").filter(has_text="The project cannot be saved where it is")
        card.wait_for()
        assert "disk is full" in card.inner_text() and "The stroke is kept" in card.inner_text()
        page.drag((0.45, 0.6), (0.55, 0.6))
        page.wait("both of them", lambda: "2 strokes are kept" in card.inner_text())
        painted = "() => document.querySelector('canvas.overlay').getContext('2d').getImageData(0, 0, 999, 999)"
        assert page.ask(f"({painted})().data.some((v) => v > 0)")
        card.get_by_role("button", name="Try again").click()
        page.wait("it again", lambda: card.count() == 1 and "2 strokes" in card.inner_text())
        card.get_by_role("button", name="Save it in the studio's own folder").click()
        page.wait("all strokes", lambda: page.state()["layers"][0]["strokes"] == 3)
        page.settled()
        assert card.count() == 0 and page.state()["project"]["id"] == project
        moved = live.studio.session.path
        assert moved is not None and moved.parent == live.studio.projects.root


@pytest.mark.slow
def test_a_bar_says_how_far_a_large_asset_is(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    write(tmp_path / "shared" / "large.ply", studio_scenes.ball(60_000, 1))
    with opened_page(browser, tmp_path, still=True) as (live, page):
        page.ask("""() => {
          window.bars = [];
          window.states = new Set();
          const look = () => {
            const bar = document.querySelector(".loading progress");
            if (bar) window.bars.push([bar.getAttribute("aria-label"), bar.value]);
            window.states.add(document.querySelector(".connection").innerText.trim());
          };
          new MutationObserver(look).observe(document.body, { childList: true, subtree: true, attributes: true });
        }""")
        page.tab.keyboard.press("Control+o")
        page.tab.get_by_role("button", name="large.ply", exact=True).click()
        page.wait("the asset", lambda: page.ask("window.studio.viewer.count") == 60_000)
        page.settled()
        bars = page.ask("window.bars")
        assert bars and {name for name, _ in bars} == {"Loading 60,000 Gaussians"}
        shares = [share for _, share in bars]
        assert shares == sorted(shares) and shares[-1] > shares[0]
        assert "Loading" in page.ask("[...window.states]") and page.tab.locator(".loading").count() == 0


@pytest.mark.slow
def test_opening_a_large_asset_is_in_sight_and_can_be_cancelled(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The dialogue lay over the bar and its Cancel until all was done, and Cancel did nothing."""
    (tmp_path / "shared").mkdir()
    write(tmp_path / "shared" / "large.ply", studio_scenes.ball(700, 1))
    go_on, at = threading.Semaphore(0), []
    cancelled: list[Ticket] = []
    cancel = Ticket.cancel
    monkeypatch.setattr(Ticket, "cancel", lambda ticket: (cancelled.append(ticket), cancel(ticket)))

    def slowly(stage: str, work: Any) -> Any:
        def run(*values: Any) -> Any:
            at.append(stage)
            go_on.acquire(timeout=PATIENCE)
            return work(*values)

        return run

    with opened_page(browser, tmp_path, still=True) as (live, page):
        projects = live.studio.projects.root
        before = sorted(projects.iterdir()), page.state()["session"]
        monkeypatch.setattr(file_commands, "read", slowly("read", file_commands.read))
        monkeypatch.setattr(file_commands, "Session", slowly("session", Session))

        job = page.tab.locator(".job")

        def opening(stage: str) -> None:
            page.tab.keyboard.press("Control+o")
            page.tab.get_by_role("button", name="large.ply", exact=True).click()
            assert page.tab.get_by_role("dialog").count() == 0
            page.wait("it to be read", lambda: at[-1:] == ["read"])
            if stage == "keeping it in a project":
                go_on.release()
                page.wait("it to be kept", lambda: at[-1:] == ["session"])
            page.wait("its bar", lambda: job.count() and stage in job.inner_text())
            assert page.tab.locator(".connection").inner_text().strip() == "Loading"

        for stage in ("reading", "keeping it in a project"):
            opening(stage)
            count = len(cancelled)
            job.get_by_role("button", name="Cancel").click()
            page.wait("the server to hear of it", lambda count=count: len(cancelled) > count)
            go_on.release()
            page.wait("none of it", lambda: job.count() == 0)
            page.settled()
            assert (sorted(projects.iterdir()), page.state()["session"]) == before
        opening("keeping it in a project")
        go_on.release()
        page.wait("the asset", lambda: page.ask("window.studio.viewer.count") == 700)
        page.settled()


@pytest.mark.slow
def test_strokes_drawn_while_another_asset_opens_are_the_first_ones(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first of them went into the project that was opened."""
    (tmp_path / "shared").mkdir()
    write(tmp_path / "shared" / "large.ply", studio_scenes.ball(700, 1))
    go_on, read = threading.Event(), file_commands.read

    def slowly(path: Path) -> Any:
        go_on.wait(PATIENCE)
        return read(path)

    monkeypatch.setattr(file_commands, "read", slowly)
    with opened_page(browser, tmp_path, still=True) as (_, page):
        page.tab.keyboard.press("b")
        page.drag((0.45, 0.4), (0.55, 0.4))
        page.wait("a stroke", lambda: page.names() == ["Paint"])
        page.settled()
        first = page.state()["project"]["id"]
        page.tab.keyboard.press("Control+o")
        page.tab.get_by_role("button", name="large.ply", exact=True).click()
        for y in (0.5, 0.6):
            page.drag((0.45, y), (0.55, y))
        go_on.set()
        page.wait("the other project", lambda: page.state()["project"]["id"] != first)
        question = page.tab.locator(".swapped")
        page.wait("both to wait", lambda: question.count() and "2 strokes drawn since wait" in question.inner_text())
        assert page.names() == [] and len(page.state()["history"]) == 1
        question.get_by_role("button").first.click()
        page.wait("all of them", lambda: [one["strokes"] for one in page.state()["layers"]] == [3])
        page.settled()
        assert page.state()["project"]["id"] == first
