"""The panel of new light in a real browser: each gesture is a step, and undo gives the captured light back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.lights.skies import sky
from splatpainter.lights.sky_maps import write_sky
from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page, on which nothing glides."""
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


def test_a_light_is_a_layer_whose_gestures_are_steps(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    first, before = page.pixels(), live.studio.session.splats
    page.tab.get_by_role("tab", name="Light").click()
    page.wait("thumbnails", lambda: page.tab.locator(".skies img").count() == 8)
    assert page.ask("[...document.querySelectorAll('.skies img')].every((one) => one.decode())")
    page.tab.get_by_role("radio", name="Sunset").click()
    page.wait("the layer", lambda: page.names() == ["Light"])
    page.wait("its look", lambda: np.abs(page.pixels() - first).mean() > 0.001)
    lit, count = page.pixels(), len(page.state()["history"])

    def options() -> dict[str, Any]:
        return page.state()["layers"][0]["parameters"]

    page.tab.get_by_role("button", name="Sun", exact=True).click()
    page.wait("the sun", lambda: len(options().get("sun", ())) == 1)
    start = options()["sun"]
    page.tab.locator(".sun-ball").scroll_into_view_if_needed()
    ball = page.tab.locator(".sun-ball").bounding_box()
    x, y = ball["x"] + ball["width"] / 2, ball["y"] + ball["height"] / 2
    page.tab.mouse.move(x, y)
    page.tab.mouse.down()
    still = page.pixels()
    page.tab.mouse.move(x - 40, y, steps=8)
    page.wait("the light that follows", lambda: np.abs(page.pixels() - still).mean() > 0.001)
    assert options()["sun"] == start and len(page.state()["history"]) == count + 1, "nothing is a step yet"
    page.tab.mouse.up()
    page.wait("the sun from the left", lambda: float(options()["sun"][0].split(",")[0]) < -30)
    page.wait("an idle panel", lambda: page.tab.locator(".layer .spinner").count() == 0)
    assert len(page.state()["history"]) == count + 2, "adding it and dragging it are two steps"

    slider = page.tab.get_by_role("textbox", name="New light, number")
    slider.fill("50")
    slider.press("Enter")
    page.wait("half of it", lambda: page.state()["layers"][0]["opacity"] == 0.5)
    page.tab.get_by_role("button", name="Before: hide this light").click()
    page.wait("a step of it", lambda: len(page.state()["history"]) == count + 4)
    page.wait("the captured light", lambda: np.array_equal(page.pixels(), first))
    for _ in range(3):
        page.tab.keyboard.press("Control+z")
    page.wait("the sun where it was", lambda: options()["sun"] == start)
    page.tab.keyboard.press("Control+z")
    page.wait("the sky alone", lambda: "sun" not in options() and np.array_equal(page.pixels(), lit))
    assert page.tab.get_by_role("radio", name="Sunset").get_attribute("aria-checked") == "true"
    assert page.tab.locator(".sun-ball").count() == 0
    page.tab.get_by_role("radio", name="None").click()
    page.wait("no layer without light", lambda: page.names() == [])
    assert page.serious() == []
    page.tab.keyboard.press("Control+z")
    page.wait("it again", lambda: page.names() == ["Light"])
    page.tab.keyboard.press("Control+z")
    page.wait("the captured light", lambda: page.names() == [] and np.array_equal(page.pixels(), first))
    assert (live.studio.session.splats.sh == before.sh).all()


def test_skies_rigs_and_hours_are_taken_from_files_and_lists(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path
) -> None:
    live, page = opened
    write_sky(tmp_path / "my sky.hdr", sky("noon"))
    page.tab.get_by_role("tab", name="Light").click()
    page.wait("thumbnails", lambda: page.tab.locator(".skies img").count() == 8)
    page.tab.locator('input[type=file][accept^=".hdr"]').set_input_files(tmp_path / "my sky.hdr")
    page.wait("the layer", lambda: page.names() == ["Light"])
    parameters = page.state()["layers"][0]["parameters"]
    assert parameters["hdri"] == "my sky.hdr" and [*parameters["held"]] == ["hdri"]
    radio = page.tab.get_by_role("radio", name="my sky.hdr")
    page.wait("its thumbnail", lambda: radio.get_attribute("aria-checked") == "true")
    assert page.tab.locator(".skies img").count() == 9
    lit = live.studio.session.splats.sh.copy()
    page.tab.get_by_role("radio", name="Dawn").click()
    page.wait("another sky", lambda: page.state()["layers"][0]["parameters"] == {"hdri": "dawn"})
    radio.click()
    page.wait("the sky again", lambda: page.state()["layers"][0]["parameters"] == parameters)
    assert (live.studio.session.splats.sh == lit).all()
    # A broken one is a line, and changes nothing.
    (tmp_path / "broken.hdr").write_bytes((tmp_path / "my sky.hdr").read_bytes()[:700])
    page.tab.locator('input[type=file][accept^=".hdr"]').set_input_files(tmp_path / "broken.hdr")
    page.wait("a line", lambda: "broken.hdr: " in page.tab.locator(".toasts").inner_text())
    assert page.state()["layers"][0]["parameters"] == parameters

    page.tab.get_by_label("Lights of a rig").select_option("three-point")
    page.wait("its lights", lambda: len(page.state()["layers"][0]["parameters"].get("sun", ())) == 3)
    assert page.state()["layers"][0]["parameters"]["fill"] == 0.12
    page.wait("balls", lambda: page.tab.locator(".sun-ball").count() == 3)
    by_hour = page.tab.locator(".sun-at").first
    by_hour.locator("summary").click()
    by_hour.locator("input[type=datetime-local]").fill("2026-06-21T12:00")
    for label, value in (("UTC +", "0"), ("Latitude", "51.5"), ("Longitude", "0")):
        field = by_hour.get_by_role("textbox", name=label)
        field.fill(value)
        field.press("Enter")
    by_hour.get_by_role("button").click()
    first = lambda: page.state()["layers"][0]["parameters"]["sun"][0].split(",")  # noqa: E731
    page.wait("midsummer", lambda: abs(float(first()[1]) - 61.9) < 0.2)
    assert abs(float(first()[0])) < 2
    assert page.serious() == []
    count = len(page.state()["history"])
    page.tab.keyboard.press("Control+z")
    page.wait("the rig's", lambda: first()[:2] == ["40", "35"])
    assert len(page.state()["history"]) == count


def test_a_choice_is_a_step_although_its_list_took_the_pointer(opened: tuple[studio_scenes.Live, Page]) -> None:
    _, page = opened
    page.tab.get_by_role("tab", name="Light").click()
    page.tab.get_by_role("button", name="Sun", exact=True).click()
    page.wait("the sun", lambda: page.names() == ["Light"])
    page.wait("an idle panel", lambda: page.tab.locator(".layer .spinner").count() == 0)
    choice = page.tab.get_by_label("Colour of Sun", exact=True)
    choice.scroll_into_view_if_needed()
    # Where a list opens in a window of its own, the page hears of the press and of the choice alone.
    choice.dispatch_event("pointerdown", {"bubbles": True})
    choice.select_option("kelvin")
    page.wait("it in the project", lambda: "K" in page.state()["layers"][0]["parameters"]["sun"][0])


def test_lamps_are_dragged_in_the_view(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    page.tab.get_by_role("tab", name="Light").click()
    page.tab.get_by_role("button", name="Spot", exact=True).click()
    page.wait("the layer", lambda: page.names() == ["Light"])
    page.tab.get_by_role("button", name="Sphere", exact=True).click()

    def numbers(kind: str) -> list[float]:
        words = page.state()["layers"][0]["parameters"].get(kind, ("",))[0].split(",")
        return [float(word) for word in words[: {"spot": 7, "sphere": 4}[kind]] if word]

    page.wait("both lamps", lambda: numbers("spot") and numbers("sphere"))
    page.wait("their handles", lambda: page.tab.locator(".lamp-handles .lamp").count() == 2)
    assert page.tab.locator(".lamp-handles .lamp.chosen text").inner_html() == "Sphere 2", "the one that was added"
    assert page.tab.locator(".lamp-handles .outside").count() == 2, "above what is seen, and shown at its edge"
    near = page.camera()
    page.tab.locator("#stage").hover()
    page.tab.mouse.wheel(0, 900)
    page.wait(
        "both in the view", lambda: page.camera() != near and not page.tab.locator(".lamp-handles .outside").count()
    )
    before, count = numbers("sphere"), len(page.state()["history"])
    camera = Camera.from_record({**page.camera(), "offset": None}, "view")

    def at(point: list[float]) -> np.ndarray:
        x, y, z = camera.world_to_camera[:3] @ np.array([*point[:3], 1])
        return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z])

    def drag(handle: Any, dx: float, dy: float, modifier: str = "") -> None:
        box = handle.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.tab.mouse.move(x, y)
        if modifier:
            page.tab.keyboard.down(modifier)
        page.tab.mouse.down()
        page.tab.mouse.move(x + dx, y + dy, steps=6)
        page.tab.mouse.up()
        if modifier:
            page.tab.keyboard.up(modifier)

    shrink = page.ask("document.getElementById('stage').clientWidth") / camera.width
    stage = page.tab.locator("#stage").bounding_box()
    sphere = page.tab.locator(".lamp-handles").get_by_role("button", name="Sphere 2: drag it")
    box = sphere.bounding_box()
    expected = at(before)[:2] * shrink + (stage["x"], stage["y"])
    assert np.allclose(expected, (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), atol=1.5), (
        "it is where it is"
    )
    drag(sphere, 60, 45)
    page.wait("another place", lambda: numbers("sphere") != before)
    moved = numbers("sphere")
    assert np.allclose((at(moved) - at(before)) * (shrink, shrink, 1), (60, 45, 0), atol=1.5)
    page.wait("one step", lambda: len(page.state()["history"]) == count + 1)
    drag(sphere, 0, -60, "Shift")
    page.wait("farther away", lambda: at(numbers("sphere"))[2] > 1.2 * at(moved)[2])
    assert np.allclose(at(numbers("sphere"))[:2], at(moved)[:2], atol=1)
    assert len(page.state()["history"]) == count + 2
    # The other lamp is chosen by its handle; what it looks to has one, too.
    spot = numbers("spot")
    page.tab.locator(".lamp-handles").get_by_role("button", name="Spot 1: drag it").click()
    page.wait("the spot", lambda: page.tab.locator(".lamp-handles .lamp.chosen text").inner_html() == "Spot 1")
    assert page.tab.locator(".light.chosen").get_attribute("aria-label") == "Spot 1"
    assert numbers("spot") == spot and len(page.state()["history"]) == count + 2, "a click moves nothing"
    aim = page.tab.locator(".lamp-handles").get_by_role("button", name="Where it looks to")
    drag(aim, -40, 0)
    page.wait("another target", lambda: numbers("spot")[3:6] != spot[3:6])
    assert numbers("spot")[:3] == spot[:3]
    aim.press("ArrowLeft")
    page.wait("a nudge", lambda: len(page.state()["history"]) == count + 4)
    assert page.serious() == []
    page.tab.locator("#stage").focus()
    for _ in range(4):
        page.tab.keyboard.press("Control+z")
    page.wait("where they were", lambda: (numbers("spot"), numbers("sphere")) == (spot, before))
    page.tab.get_by_role("tab", name="History").click()
    assert page.tab.locator(".lamp-handles").count() == 0


def test_what_is_selected_is_pixelated(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    before = live.studio.session.splats
    page.tab.get_by_role("tab", name="Select").click()
    page.tab.locator("summary", has_text="Pixelate").click()
    button = page.tab.locator(".selection-panel").get_by_role("button", name="Pixelate", exact=True)
    assert button.is_disabled(), "nothing is selected"
    page.tab.keyboard.press("Control+a")
    page.wait("all of it", lambda: page.state()["selection"]["gaussians"] == len(before))
    size = page.tab.get_by_role("textbox", name="Cell, number")
    size.fill("20")
    size.press("Enter")
    page.tab.get_by_label("Style").select_option("blur")
    button.click()
    page.wait("the layer", lambda: page.names() == ["Pixelate"])
    options = page.state()["layers"][0]["parameters"]
    assert (options["size"], options["style"]) == ("20%", "blur")
    assert (live.studio.session.splats.sh[:, 1:] == 0).all()
    page.tab.keyboard.press("Control+z")
    page.wait("no layer", lambda: page.names() == [])
    assert (live.studio.session.splats.sh == before.sh).all()
