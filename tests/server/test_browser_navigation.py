"""Moving about and the keyboard in a real browser, by mouse, keyboard, fingers and pen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.cameras import Camera
from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page, on which nothing glides."""
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


def camera(page: Page) -> Camera:
    import json

    return Camera.from_json(json.dumps(page.camera()))


def surface(page: Page, x: float, y: float) -> np.ndarray:
    """[3] the point of the asset at shares x, y of the view, from the page's own Gaussians."""
    return np.array(
        page.ask(
            """([x, y]) => {
              const { camera, pose, viewer } = window.studio;
              const c = camera.value, m = c.world_to_camera, p = pose.value;
              const local = [(x * c.width - c.cx) / c.fx, (y * c.height - c.cy) / c.fy, 1];
              const d = [0, 1, 2].map((k) => m[0][k] * local[0] + m[1][k] * local[1] + m[2][k] * local[2]);
              const n = Math.hypot(...d);
              return viewer.hit(p.eye, d.map((v) => v / n));
            }""",
            [x, y],
        )
    )


def pixel(page: Page, point: np.ndarray) -> np.ndarray:
    """[2] shares of the view at which a point is seen."""
    view = camera(page)
    return view.project(point)[0] / (view.width, view.height)


def test_the_page_and_the_server_see_the_same_surface(browser: Any, tmp_path: Path) -> None:
    solid = replace(studio_scenes.ball(), scales=2 * studio_scenes.ball().scales)
    with opened_page(browser, tmp_path, splats=solid) as (live, page):
        view = page.camera()
        for x, y in ((0.5, 0.5), (0.42, 0.6)):
            answer = live.post("pick", camera=view, x=x * view["width"], y=y * view["height"])
            assert np.linalg.norm(surface(page, x, y) - answer["point"]) < 0.15
        assert page.ask("window.studio.viewer.hit(window.studio.pose.value.eye, [0, -1, 0])") is None


def test_the_wheel_goes_to_the_cursor_and_a_drag_turns_about_it(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    mouse = page.tab.mouse
    box = page.tab.locator("#stage").bounding_box()
    at = (0.45, 0.42)
    point = surface(page, *at)
    before = np.linalg.norm(camera(page).position - point)
    mouse.move(box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"])
    for _ in range(3):
        mouse.wheel(0, -240)
    page.wait("nearer", lambda: np.linalg.norm(camera(page).position - point) < 0.6 * before)
    assert pixel(page, point) == pytest.approx(at, abs=0.004)
    position = camera(page).position
    page.drag(at, (0.6, 0.5), button="right")  # in the brush, too
    assert np.linalg.norm(camera(page).position - position) > 0.1
    assert pixel(page, point) == pytest.approx(at, abs=0.004)
    page.drag(at, (0.5, 0.47), button="middle")
    assert pixel(page, point) == pytest.approx((0.5, 0.47), abs=0.004)
    assert page.names() == []
    page.tab.keyboard.press("h")
    double = (0.55, 0.5)
    goal = surface(page, *double)
    mouse.dblclick(box["x"] + double[0] * box["width"], box["y"] + double[1] * box["height"])
    page.wait("the middle", lambda: np.abs(pixel(page, goal) - 0.5).max() < 0.004)


def test_alt_drags_turn_and_alt_clicks_take_a_colour(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys = page.tab.keyboard
    before = camera(page).position
    keys.down("Alt")
    page.drag((0.45, 0.5), (0.6, 0.5))
    keys.up("Alt")
    assert np.linalg.norm(camera(page).position - before) > 0.3
    still = camera(page).position
    swatch = page.tab.get_by_label("Colour", exact=True)
    assert swatch.input_value() == "#c8442e"
    keys.down("Alt")
    page.drag((0.5, 0.5))
    keys.up("Alt")
    page.wait("another colour", lambda: swatch.input_value() != "#c8442e")
    assert np.array_equal(camera(page).position, still) and page.names() == []


def test_sides_by_the_number_pad_and_the_axes(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    keys = page.tab.keyboard

    def forward() -> np.ndarray:
        return camera(page).forward

    front = np.array(live.studio.state.asset.home.to_camera().forward)
    flat = front * (1, 0, 1) / np.linalg.norm(front * (1, 0, 1))
    for key, expected in (
        ("Numpad1", flat),
        ("Control+Numpad1", -flat),
        ("Numpad3", -np.cross(flat, (0, -1, 0))),
        ("Control+Numpad3", np.cross(flat, (0, -1, 0))),
        ("Numpad7", (0, 1, 0)),
        ("Control+Numpad7", (0, -1, 0)),
    ):
        keys.press(key)
        page.wait(key, lambda expected=expected: np.allclose(forward(), expected, atol=1e-6))
    page.tab.get_by_role("button", name="Look from +X").click()
    page.wait("+X", lambda: np.allclose(forward(), (-1, 0, 0), atol=1e-6))
    page.tab.get_by_role("button", name="Look from +X").click(force=True)  # from there: the other side
    page.wait("-X", lambda: np.allclose(forward(), (1, 0, 0), atol=1e-6))
    before = page.state()["asset"]["home"]
    page.tab.get_by_role("button", name="This side is the front").click()
    page.wait("the front", lambda: page.state()["asset"]["home"] != before)
    assert live.studio.session.scene.is_oriented
    keys.press("Numpad3")
    page.wait("its right side", lambda: abs(forward()[0]) < 1e-6)
    page.open()
    page.wait("the view", page.camera)
    home = forward()
    assert home[0] > 0.9  # from -X, a little from above
    keys.press("Numpad0")
    page.wait("home", lambda: np.allclose(forward(), home))


def test_flying_needs_the_right_button(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys, mouse = page.tab.keyboard, page.tab.mouse
    box = page.tab.locator("#stage").bounding_box()
    mouse.move(box["x"] + 0.1 * box["width"], box["y"] + 0.1 * box["height"])
    mouse.down(button="right")
    before = camera(page)
    keys.down("w")
    page.wait("forward", lambda: (camera(page).position - before.position) @ before.forward > 0.1)
    keys.up("w")
    mouse.up(button="right")
    flown = camera(page)
    assert np.allclose(flown.forward, before.forward)
    keys.press("d")  # not flying: black and white
    page.wait("black", lambda: page.tab.get_by_label("Colour", exact=True).input_value() == "#000000")
    assert np.array_equal(camera(page).position, flown.position)


def test_fingers_turn_pinch_and_paint_and_the_pens_other_end_erases(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    point = surface(page, 0.5, 0.5)
    before = np.linalg.norm(camera(page).position - point)
    page.pointer("down", 7, "touch", 0.45, 0.5)  # begins a stroke, which a second finger takes back
    page.pointer("move", 7, "touch", 0.44, 0.5)
    page.pointer("down", 8, "touch", 0.55, 0.5)
    page.wait("a free camera", lambda: page.tab.locator(".connection").inner_text().strip() == "Saved")
    for k in range(1, 9):
        page.pointer("move", 7, "touch", 0.44 - 0.02 * k, 0.5)
        page.pointer("move", 8, "touch", 0.55 + 0.02 * k, 0.5)
    page.pointer("up", 7, "touch", 0.28, 0.5)
    page.pointer("up", 8, "touch", 0.71, 0.5)
    assert np.linalg.norm(camera(page).position - point) < 0.6 * before
    assert page.names() == []
    page.pointer("down", 9, "pen", 0.45, 0.5)
    page.pointer("move", 9, "pen", 0.55, 0.5)
    page.pointer("up", 9, "pen", 0.55, 0.5)
    page.wait("paint", lambda: page.names() == ["Paint"])
    page.settled()
    page.ask(
        """() => {
          const stage = document.getElementById("stage"), box = stage.getBoundingClientRect();
          const send = (type, x) => stage.dispatchEvent(new PointerEvent(type, {
            pointerId: 9, pointerType: "pen", pressure: 0.5, bubbles: true, cancelable: true,
            button: type === "pointermove" ? -1 : 5, buttons: type === "pointerup" ? 0 : 32,
            clientX: box.left + x * box.width, clientY: box.top + 0.5 * box.height,
          }));
          send("pointerdown", 0.45); send("pointermove", 0.5); send("pointerup", 0.5);
        }"""
    )
    page.wait("the eraser", lambda: "rase" in page.state()["history"][-1]["label"])
    page.settled()


def test_photoshops_keys(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys = page.tab.keyboard
    tools = {
        "b": "Brush",
        "e": "Eraser",
        "g": "Paint bucket",
        "t": "Text",
        "i": "Eyedropper",
        "s": "Clone",
        "j": "Heal",
    }
    for key, name in tools.items():
        keys.press(key)
        pressed = page.tab.locator(".toolbar .button[aria-pressed=true]")
        assert pressed.get_attribute("aria-label").startswith(name)
    for key, kind in {"m": "rectangle", "l": "lasso", "w": "color", "q": "brush"}.items():
        keys.press(key)
        assert page.tab.locator(".options").get_by_label("Select", exact=True).input_value() == kind
    keys.press("b")
    swatch = page.tab.get_by_label("Colour", exact=True)
    keys.press("d")
    assert swatch.input_value() == "#000000"
    keys.press("x")
    assert swatch.input_value() == "#ffffff"
    opacity = page.tab.get_by_role("textbox", name="Opacity, number").first
    keys.press("3")
    assert opacity.input_value() == "30"
    page.tab.wait_for_timeout(700)  # or it was a second digit
    keys.press("4")
    keys.press("5")
    assert opacity.input_value() == "45"
    page.tab.wait_for_timeout(700)
    keys.press("0")
    assert opacity.input_value() == "100"
    keys.press("Shift+Digit5")
    assert page.tab.get_by_role("textbox", name="Flow, number").input_value() == "50"
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("a layer", lambda: page.names() == ["Paint"])
    page.settled()
    keys.press("NumpadDecimal")  # looks at the point under the cursor
    keys.press("Control+j")
    page.wait("a copy", lambda: page.names() == ["Paint", "Paint copy"])
    keys.press("Control+e")
    page.wait("one layer, with the name of the lower one", lambda: page.names() == ["Paint"])
    keys.press("Control+z")
    page.wait("two", lambda: len(page.names()) == 2)
    page.tab.locator(".layer-name").first.click()
    page.tab.locator("#stage").focus()
    keys.press("Delete")
    page.wait("one deleted", lambda: len(page.names()) == 1)


def test_what_was_clicked_does_not_keep_the_keys(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys, tools = page.tab.keyboard, page.tab.locator(".toolbar")
    tools.get_by_role("button", name="Brush").click()
    before = page.camera()["world_to_camera"]
    keys.down("Space")
    page.drag((0.5, 0.4), (0.6, 0.4))
    keys.up("Space")
    page.wait("another view", lambda: page.camera()["world_to_camera"] != before)
    assert page.names() == [], "it turned and did not paint"
    opacity = page.tab.get_by_role("region", name="Tool settings").get_by_role("textbox", name="Opacity, number")
    opacity.fill("35")
    opacity.press("Enter")
    assert opacity.input_value() == "35"
    keys.press("0")
    page.wait("all of it", lambda: opacity.input_value() == "100")
    page.tab.get_by_role("slider", name="Hardness").click()
    blend = page.tab.get_by_role("combobox", name="Background")
    blend.focus()
    blend.select_option(index=1)
    keys.press("e")
    assert tools.locator("[aria-pressed=true]").get_attribute("aria-label") == "Eraser"
    tools.get_by_role("button", name="Brush").focus()
    keys.press("Space")
    assert tools.locator("[aria-pressed=true]").get_attribute("aria-label") == "Brush", "where keys went, keys press"


def test_a_layer_is_transformed_without_control_t(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys = page.tab.keyboard
    page.drag((0.42, 0.5), (0.48, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    before = page.state()["layers"][0]["views"][0]["mask"]
    keys.press("Shift+T")
    page.wait("the handles", lambda: page.tab.get_by_role("button", name="Apply").count())
    assert not page.state()["layers"][0]["visible"]
    keys.press("Escape")
    page.wait("as it was", lambda: page.state()["layers"][0]["visible"])
    keys.press("Shift+T")
    page.wait("the handles", lambda: page.tab.get_by_role("button", name="Apply").count())
    page.drag((0.45, 0.5), (0.55, 0.58))
    keys.press("Enter")
    page.wait("it alone, moved", lambda: len(page.names()) == 1 and page.state()["layers"][0]["id"] != "1")
    page.settled()
    assert page.state()["layers"][0]["views"][0]["mask"] != before


def test_keys_can_be_changed_and_are_remembered(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    keys = page.tab.keyboard
    stage = page.tab.locator("#stage")
    stage.focus()
    keys.press("?")
    sheet = page.tab.get_by_role("dialog", name="Shortcuts")
    sheet.get_by_role("button", name="G: Paint bucket. Change the key").click()
    keys.press("Control+w")
    assert "Browsers keep Ctrl-W" in sheet.get_by_role("alert").inner_text()
    keys.press("b")
    assert "B is Brush." in sheet.get_by_role("alert").inner_text()
    sheet.get_by_role("button", name="Use it here").click()
    assert sheet.get_by_role("button", name="none: Brush. Change the key").count() == 1
    page.open()
    stage.focus()
    keys.press("b")
    fill = page.tab.get_by_role("button", name="Paint bucket", exact=True)
    assert fill.get_attribute("aria-pressed") == "true" and fill.get_attribute("title") == "Paint bucket (B)"
    keys.press("?")
    sheet.get_by_role("button", name="Reset all").click()
    sheet.get_by_role("button", name="Close").click()
    keys.press("b")
    assert page.tab.get_by_role("button", name="Brush", exact=True).get_attribute("aria-pressed") == "true"


def test_settings_that_do_not_fit_open_below_the_bar(opened: tuple[studio_scenes.Live, Page]) -> None:
    """At 1100 and 1400 pixels nothing scrolls sideways; what does not fit is under More, and keys get there."""
    _, page = opened
    bar = page.tab.locator(".options")
    row = bar.locator(".options-row")
    more, spread = bar.get_by_role("button", name="More"), bar.get_by_role("button", name="Spread")
    widths = "(name) => { const box = document.querySelector(name); return [box.scrollWidth, box.clientWidth]; }"

    def is_open() -> bool:
        return "open" in row.get_attribute("class").split()

    def is_in_sight(control: Any) -> bool:
        rows = row.bounding_box()
        return control.bounding_box()["y"] + 10 < rows["y"] + rows["height"]

    for width in (1100, 1400):
        page.tab.set_viewport_size({"width": width, "height": 520})
        page.wait("More", more.count)
        for name in (".header", ".options", ".options-row"):
            scrolled, there = page.ask(widths, name)
            assert scrolled == there, (width, name)
    assert not is_open() and not is_in_sight(spread)
    more.click()
    assert is_open() and is_in_sight(spread)
    bar.get_by_role("button", name="Limits").click()
    page.wait("its settings", lambda: is_in_sight(bar.get_by_label("Angle limit", exact=True)))
    page.tab.keyboard.press("Escape")
    page.wait("it to be closed", lambda: not is_open())
    more.focus()
    page.tab.keyboard.press("Enter")
    page.wait("it again", is_open)
    page.tab.keyboard.press("Escape")
    page.wait("it to be closed", lambda: not is_open())
    assert page.ask("document.activeElement.textContent") == "More"
    bar.get_by_label("Flow", exact=True).focus()
    for _ in range(12):
        page.tab.keyboard.press("Tab")
        if is_open():
            break
    assert is_open(), "the focus went to what was below"
    bottom = "document.querySelector('.options').getBoundingClientRect().bottom"
    assert page.ask(bottom) <= page.tab.locator("#stage").bounding_box()["y"], "it covers nothing of the view"
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the stroke", lambda: page.names() == ["Paint"])
    assert is_open(), "painting does not move the view under the pen"
    page.fold()
    assert row.evaluate("(row) => row.scrollTop") == 0
    page.tab.set_viewport_size({"width": 1100, "height": 520})
    page.tab.keyboard.press("m")
    page.wait("a tool whose settings fit", lambda: more.count() == 0)
