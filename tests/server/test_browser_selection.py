"""Selections in a real browser: by mouse, keyboard, pen and fingers; what they limit, hide, crop and keep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
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


def count(page: Page) -> int:
    return page.state()["selection"]["gaussians"]


def selected(page: Page, what: str = "a selection") -> int:
    return page.wait(what, lambda: count(page))


def other(page: Page, before: int, what: str) -> int:
    page.wait(what, lambda: count(page) not in (0, before))
    return count(page)


def click(page: Page, name: str) -> None:
    page.tab.locator(".selection-panel").get_by_role("button", name=name, exact=True).click()


def outline(page: Page) -> np.ndarray:
    """[H, W] bool: where the overlay is tinted."""
    width, height, data = page.ask(
        """() => {
          const overlay = document.querySelector(".cursor-overlay");
          const canvas = new OffscreenCanvas(overlay.width, overlay.height);
          const context = canvas.getContext("2d", { willReadFrequently: true });
          context.drawImage(overlay, 0, 0);
          const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
          const blue = [];
          for (let k = 0; k < data.length; k += 4) blue.push(data[k + 3] > 30 && data[k + 2] > data[k] + 60 ? 1 : 0);
          return [canvas.width, canvas.height, blue.join("")];
        }"""
    )
    return np.frombuffer(data.encode(), np.uint8).reshape(height, width) == ord("1")


def test_a_selection_follows_the_asset_and_limits_strokes_from_every_side(
    opened: tuple[studio_scenes.Live, Page],
) -> None:
    live, page = opened
    page.tab.keyboard.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    selected(page)
    page.wait("its tint", lambda: outline(page).any())
    first = outline(page)
    assert first[:, : int(0.49 * first.shape[1])].any() and not first[:, int(0.52 * first.shape[1]) :].any()
    for _ in range(4):
        page.tab.locator("#stage").press("ArrowRight")  # 30 degrees
    page.wait("the tint elsewhere", lambda: outline(page).any() and not np.array_equal(outline(page), first))
    around = outline(page)
    before = live.studio.session.splats
    weights = live.studio.selection.weights()
    assert weights is not None
    page.tab.keyboard.press("b")
    rows, columns = np.nonzero(around)
    y = rows.mean() / around.shape[0]
    page.drag((0.42, y), (0.58, y))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    layer = live.studio.session.layers[0]
    (view,) = layer.strokes[0].views if layer.strokes else layer.views
    mask = live.studio.session._core.replay.main.mask(view)
    grown = around[:: around.shape[0] // mask.shape[0], :: around.shape[1] // mask.shape[1]][: mask.shape[0]]
    left = columns.min() / around.shape[1]
    right = columns.max() / around.shape[1]
    painted = np.nonzero(mask.any(0))[0] / mask.shape[1]
    assert painted.min() >= left - 0.02 and painted.max() <= right + 0.02 and grown.any()
    assert painted.max() - painted.min() < 0.16  # the stroke was longer
    changed = (before.sh != live.studio.session.splats.sh[: len(before)]).any((1, 2))
    assert changed.any()


def test_keys_and_the_card_change_it(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys = page.tab.keyboard
    keys.press("Control+a")
    assert selected(page) == 600
    keys.press("Control+d")
    page.wait("nothing", lambda: count(page) == 0)
    keys.press("Control+Shift+d")
    assert selected(page, "it again") == 600
    keys.press("l")
    page.drag((0.4, 0.35), (0.6, 0.35), (0.5, 0.6))
    lasso = other(page, 600, "the lasso's")
    keys.press("Control+Shift+i")
    rest = other(page, lasso, "the rest")
    assert rest == 600 - lasso
    keys.press("Control+Shift+i")
    page.wait("the lasso's again", lambda: count(page) == lasso)
    by = page.tab.get_by_role("textbox", name="Amount, number")
    by.fill("20")
    by.press("Enter")
    click(page, "Grow")
    bigger = other(page, lasso, "more")
    assert bigger > lasso
    click(page, "Shrink")
    assert other(page, bigger, "less") < bigger
    click(page, "Connected")
    page.wait("everything", lambda: count(page) == 600)
    keys.press("w")
    page.drag((0.5, 0.5))
    other(page, 600, "one colour")
    keys.press("Control+d")
    page.wait("nothing", lambda: count(page) == 0)
    keys.press("q")
    page.drag((0.45, 0.4), (0.55, 0.4))
    alike = selected(page, "what was painted")
    keys.down("Shift")
    page.drag((0.4, 0.5), (0.6, 0.5))
    keys.up("Shift")
    more = other(page, alike, "painted to it")
    assert more > alike
    keys.down("Alt")
    page.drag((0.45, 0.5), (0.55, 0.5))
    keys.up("Alt")
    assert other(page, more, "painted away") < more
    keys.press("Control+d")
    page.wait("nothing", lambda: count(page) == 0)
    keys.press("l")
    page.drag((0.4, 0.35), (0.6, 0.35), (0.5, 0.6))
    keys.press("Delete")  # means the lasso, which is still on its way
    page.wait("what was circled to be hidden", lambda: page.names() == ["Hide"])


def test_what_is_selected_is_hidden_cropped_and_kept(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    keys = page.tab.keyboard
    before = page.pixels()
    keys.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    selected(page)
    page.tab.get_by_text("Saved in the project").click()
    page.tab.get_by_role("textbox", name="Name of the selection").fill("Left")
    click(page, "Save the selection under this name")
    page.wait("its name", lambda: page.state()["selection"]["names"] == ["Left"])
    page.tab.locator("#stage").focus()
    keys.press("NumpadDecimal")  # deletes nothing
    keys.press("f")
    keys.press("Delete")
    page.wait("the layer", lambda: page.names() == ["Hide"])
    page.wait("nothing selected", lambda: count(page) == 0)
    splats = live.studio.session.splats
    hidden = int((splats.opacities == 0).sum())
    assert 20 < hidden < 400 and len(splats) == 600
    page.wait("other pixels", lambda: np.abs(page.pixels() - before).mean() > 0.003)
    keys.press("Control+z")
    page.wait("no layer", lambda: page.names() == [])
    page.open()
    keys.press("m")
    page.tab.locator(".selection-panel").get_by_role("button", name="Left", exact=True).click()
    selected(page, "it again")
    keys.press("Shift+Delete")
    page.wait("the crop", lambda: page.names() == ["Crop"])
    cropped = live.studio.session.splats.opacities == 0  # what lies across the edge is faded by both
    assert 350 < cropped.sum() < 600 - hidden and not (cropped & (splats.opacities == 0)).any()
    keys.press("Control+z")
    page.wait("no layer", lambda: page.names() == [])
    page.tab.get_by_text("Box", exact=True).click()
    click(page, "Set a box")
    page.wait("its lines", lambda: page.tab.locator(".cursor-overlay").is_visible())
    field = page.tab.get_by_role("textbox", name="Y from, number")
    field.fill("0")
    field.press("Enter")
    click(page, "Crop to box")
    page.wait("the crop", lambda: page.names() == ["Crop box"])
    splats = live.studio.session.splats
    assert (splats.opacities[splats.means[:, 1] < -0.01] == 0).all()
    assert (splats.opacities[splats.means[:, 1] > 0.01] > 0).all()


def marked(page: Page) -> int:
    """Pixels of the overlay that have the colour of marks."""
    return page.ask("""() => {
      const overlay = document.querySelector(".cursor-overlay");
      const canvas = new OffscreenCanvas(overlay.width, overlay.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(overlay, 0, 0);
      const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
      let count = 0;
      for (let k = 0; k < data.length; k += 4)
        count += data[k + 3] > 170 && data[k + 3] < 240 && data[k] < 90 && data[k + 2] > 200 ? 1 : 0;
      return count;
    }""")


def test_floaters_are_found_and_hidden(browser: Any, tmp_path: Path) -> None:
    from tests.session.test_selection import planted

    ball = studio_scenes.ball(3000)
    splats, number = planted(replace(ball, means=ball.means * np.array([0.4, 1, 1], np.float32)))
    opacities = splats.opacities.copy()
    opacities[-number:] *= 0.05
    splats = replace(splats, opacities=opacities)
    with opened_page(browser, tmp_path, splats=splats) as (live, page):
        page.tab.keyboard.press("m")
        page.tab.get_by_text("Floaters", exact=True).click()
        click(page, "Find floaters")
        assert selected(page, "floaters") > 0.85 * number
        page.wait("marks of what is hardly seen", lambda: marked(page) > 50)
        page.tab.locator("#stage").focus()
        page.tab.keyboard.press("Delete")
        page.wait("the layer", lambda: page.names() == ["Hide"])
        page.wait("no marks", lambda: marked(page) == 0)
        opacities = live.studio.session.splats.opacities
        assert (opacities[-number:] == 0).mean() > 0.85 and (opacities[:-number] > 0).all()
        page.settled()
        page.tab.get_by_text("Box", exact=True).click()
        click(page, "Set a box")
        sides = [float(page.tab.get_by_role("textbox", name=f"{axis} to, number").input_value()) for axis in "XYZ"]
        assert 0.35 < sides[0] < 0.75 and sides[1] > 0.9, "the box has the asset's shape"


def test_fingers_and_a_pen_select(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.keyboard.press("m")
    for number, kind, left in ((7, "touch", 0.4), (9, "pen", 0.45)):
        before = count(page)
        page.pointer("down", number, kind, left, 0.35)
        page.pointer("move", number, kind, 0.6, 0.6)
        page.pointer("up", number, kind, 0.6, 0.6)
        other(page, before, f"that of the {kind}")


def test_nothing_serious_about_the_card(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.keyboard.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    selected(page)
    for name in ("By value", "Floaters", "Box", "Saved in the project"):
        page.tab.locator(".selection-panel summary").get_by_text(name, exact=True).click()
    click(page, "Set a box")
    page.tab.keyboard.press("?")
    assert page.serious() == []


BOX_HANDLES = """([low, high]) => {
  const { camera } = window.studio;
  const view = camera.value;
  const center = low.map((v, axis) => (v + high[axis]) / 2);
  const stage = document.getElementById("stage").getBoundingClientRect();
  return [0, 1, 2].flatMap((axis) => [-1, 1].map((sign) => {
    const at = center.map((v, k) => (k === axis ? (sign < 0 ? low : high)[k] : v));
    const [x, y, z] = view.world_to_camera.map((row) => row[0] * at[0] + row[1] * at[1] + row[2] * at[2] + row[3]);
    const pixel = [view.fx * x / z + view.cx, view.fy * y / z + view.cy];
    return [pixel[0] / view.width * stage.width + stage.left, pixel[1] / view.height * stage.height + stage.top];
  }));
}"""


def test_undo_takes_back_selections_and_the_box_has_handles(opened: tuple[studio_scenes.Live, Page]) -> None:
    """Ctrl-Z goes back through selections; a face of the box is pulled by its handle with any tool, without painting;
    Escape takes the pull back."""
    live, page = opened
    mouse, keys = page.tab.mouse, page.tab.keyboard
    keys.press("m")
    page.drag((0.3, 0.2), (0.5, 0.8))
    selected(page)
    first = count(page)
    keys.press("Control+a")
    page.wait("all", lambda: count(page) > first)
    keys.press("Control+z")
    page.wait("the first again", lambda: count(page) == first)
    keys.press("Control+z")
    page.wait("nothing", lambda: count(page) == 0)
    assert page.tab.get_by_role("button", name="Undo").is_disabled()
    keys.press("Control+Shift+z")
    page.wait("it again", lambda: count(page) == first)
    keys.press("b")
    page.tab.get_by_role("tab", name="Select").click()
    page.tab.get_by_text("Box", exact=True).click()
    click(page, "Set a box")
    fields = [[f"{axis} {side}, number" for axis in "XYZ"] for side in ("from", "to")]
    sides = [[float(page.tab.get_by_role("textbox", name=name).input_value()) for name in row] for row in fields]
    handles = page.ask(BOX_HANDLES, sides)
    top = page.tab.get_by_role("textbox", name="Y from, number")
    start = float(top.input_value())
    x, y = handles[2]  # -y is up

    def pull() -> float:
        mouse.move(x, y)
        mouse.down()
        mouse.move(x, y + 40, steps=4)
        return float(top.input_value())

    assert pull() > start + 0.05
    keys.press("Escape")
    page.wait("as it was", lambda: float(top.input_value()) == start)
    mouse.up()
    pulled = pull()
    mouse.up()
    assert pulled > start + 0.05 and page.names() == []
    page.tab.get_by_title("Select what is in the box").click()
    means = live.studio.session.splats.means
    expected = int((means[:, 1] > pulled).sum())
    page.wait("what is in it", lambda: abs(count(page) - expected) < 12)


def test_what_is_selected_is_filled_from_around(opened: tuple[studio_scenes.Live, Page]) -> None:
    """A blot on the ball is gone; what is not selected keeps its Gaussians. Undo brings the blot back."""
    live, page = opened
    page.tab.get_by_role("textbox", name="Colour").fill("#000000")
    page.drag((0.49, 0.5), (0.51, 0.5))
    page.wait("the blot", lambda: page.names() == ["Paint"])
    page.settled()
    blotted = page.pixels()
    height, width, _ = blotted.shape
    middle = np.s_[height // 2 - 4 : height // 2 + 5, width // 2 - 4 : width // 2 + 5]
    dark = blotted[middle].mean()
    page.tab.keyboard.press("m")
    page.drag((0.42, 0.4), (0.58, 0.6))
    selected(page)
    page.tab.get_by_role("tab", name="Select").click()
    button = page.tab.get_by_title("Heal the selected part of this view from its surroundings")
    page.wait("its picture", button.is_enabled)
    button.click()
    page.wait("the fill", lambda: page.state()["history"][-1]["label"].startswith("Heal from around"))
    page.settled()
    page.tab.keyboard.press("Control+d")
    page.wait("nothing selected", lambda: count(page) == 0)
    filled = page.pixels()
    assert filled[middle].mean() > dark + 0.15, "what lies around is brighter"
    assert np.abs(filled - blotted)[: height // 4].max() < 0.02
    cursor = page.state()["cursor"]
    page.tab.keyboard.press("Control+z")
    page.wait("the selection", lambda: count(page) > 0)
    page.tab.keyboard.press("Control+z")
    page.wait("the blot", lambda: page.state()["cursor"] == cursor - 1)
