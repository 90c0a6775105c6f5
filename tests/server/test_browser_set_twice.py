"""What is set in the page while the server is at work on something set before: the newest stands, nothing is lost, and
nothing moves under the pointer. In a real browser."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.io import write
from splatpainter.rendering import render
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session.commands.session_bookmarks import SessionBookmarks
from splatpainter.session.commands.session_layers import SessionLayers
from splatpainter.session.commands.session_scene import SessionScene
from splatpainter.session.commands.session_surface import SessionSurface
from tests.support import studio_scenes
from tests.support.lift_scenes import sheet
from tests.support.studio_pages import PATIENCE, Page, opened_page
from tests.support.studio_scenes import view, wire


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[tuple[studio_scenes.Live, Page]]:
    """A studio with the ball, and its page."""
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


class Gate:
    """A method that goes on when it is let through, call by call."""

    def __init__(self, patch: pytest.MonkeyPatch, owner: type, name: str) -> None:
        method = getattr(owner, name)
        self.passes, self.waiting = threading.Semaphore(0), 0

        def gated(*args: Any, **kwargs: Any) -> Any:
            self.waiting += 1
            assert self.passes.acquire(timeout=PATIENCE)
            self.waiting -= 1
            return method(*args, **kwargs)

        patch.setattr(owner, name, gated)


def test_two_numbers_of_an_asset_both_count(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, page = opened
    write(tmp_path / "rug.ply", sheet(12, degree=1, half=0.6))
    live.post("scene.add", blob=live.send((tmp_path / "rug.ply").read_bytes(), "rug.ply"))
    page.wait("two assets", lambda: len(page.state()["assets"]) == 2)
    page.tab.locator(".asset-list .layer-name").last.click()
    start = page.state()["assets"][1]["move"]
    gate = Gate(monkeypatch, SessionScene, "set")
    fields = [page.tab.get_by_label(f"Move {axis}, number") for axis in "XY"]
    for field, text in zip(fields, ("0.25", "0.5"), strict=True):
        field.fill(text)
        field.press("Enter")
    page.wait("the first", lambda: gate.waiting)
    assert [field.input_value() for field in fields] == ["0.250", "0.500"]
    gate.passes.release()
    page.wait("it moved along X", lambda: page.state()["assets"][1]["move"] == [0.25, *start[1:]])
    page.wait("the second", lambda: gate.waiting)
    assert [field.input_value() for field in fields] == ["0.250", "0.500"]
    gate.passes.release()
    page.wait("it moved along both", lambda: page.state()["assets"][1]["move"] == [0.25, 0.5, start[2]])
    assert [field.input_value() for field in fields] == ["0.250", "0.500"]


def test_the_policy_of_a_conflict_is_the_one_that_was_chosen_last(
    opened: tuple[studio_scenes.Live, Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, page = opened
    for angle, color in ((0, (0.9, 0.1, 0.1)), (25, (0.1, 0.1, 0.9))):
        camera = view(96, angle)
        image = np.clip(render(live.studio.session.splats, camera).colors[0], 0, 1)
        image[36:60, 36:60] = color
        live.post("edit", views=[{"camera": wire(camera), "picture": live.send(png_bytes(image))}])
    page.wait("the conflict", lambda: page.state()["conflicts"])
    page.tab.get_by_role("tab", name="Views").click()
    choice = page.tab.get_by_label("Show", exact=True)
    gate = Gate(monkeypatch, SessionLayers, "resolve_conflict")
    choice.select_option("first")
    choice.select_option("blend")
    gate.passes.release()
    page.wait("the first answer", lambda: page.state()["conflicts"][0]["policy"] == "first")
    page.tab.wait_for_timeout(100)
    assert choice.input_value() == "blend"
    gate.passes.release()
    page.wait("both answers", lambda: page.state()["conflicts"][0]["policy"] == "blend")
    assert choice.input_value() == "blend"
    low, high = (one["name"] for one in page.state()["layers"])
    live.post("layer.merge", layers=[one["id"] for one in page.state()["layers"]], name="both")
    page.wait("one layer", lambda: page.names() == ["both"])
    words = page.tab.locator(".conflict").inner_text()
    assert f"{high} (merged into both) overwrites" in words and f"of {low} (merged into both)" in words


def test_names_are_not_taken_back_while_they_are_written(
    opened: tuple[studio_scenes.Live, Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, page = opened
    keys = page.tab.keyboard
    for name in ("one", "two"):
        live.post("layer.new", name=name)
    page.wait("two layers", lambda: page.names() == ["one", "two"])
    rows = page.tab.locator(".layer-name")
    rows.last.dblclick()
    field = page.tab.get_by_label("Layer name")
    field.fill("half a na")
    one, two = (layer["id"] for layer in page.state()["layers"])
    live.post("layer.set", layer=two, opacity=0.5)
    live.post("layer.set", layer=one, opacity=0.5)
    page.wait("what another window did", lambda: page.state()["layers"][0]["opacity"] == 0.5)
    page.tab.wait_for_timeout(100)
    assert field.input_value() == "half a na"
    keys.press("Escape")
    assert page.tab.get_by_label("Layer name").count() == 0 and page.names() == ["one", "two"]

    # Rows that change their places between the two clicks of a double click.
    box = rows.last.bounding_box()
    at = (box["x"] + 20, box["y"] + box["height"] / 2)
    page.tab.mouse.click(*at)
    live.post("layer.move", layer=one, to=1)
    page.wait("the other row there", lambda: rows.last.inner_text().startswith("two"))
    page.tab.mouse.down(click_count=2)
    page.tab.mouse.up(click_count=2)
    assert field.input_value() == "one"
    keys.press("Escape")

    page.tab.get_by_role("tab", name="Views").click()
    gate = Gate(monkeypatch, SessionBookmarks, "add")
    field = page.tab.get_by_label("Name of the bookmark")
    field.fill("left")
    field.press("Enter")
    page.wait("the first", lambda: gate.waiting)
    field.fill("ri")
    gate.passes.release()
    page.wait("the bookmark", lambda: [one["name"] for one in page.state()["bookmarks"]] == ["left"])
    page.tab.wait_for_timeout(100)
    assert field.input_value() == "ri"


def test_choosing_a_layer_moves_no_row_and_a_new_one_is_in_sight(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    for k in range(12):
        live.post("layer.new", name=f"layer {k}")
    page.wait("the layers", lambda: len(page.names()) == 12)
    rows = page.tab.locator(".layer-name")
    first, second = rows.nth(0), rows.nth(1)
    first.click()
    page.tab.get_by_role("button", name="Mask of the layer").click()
    panel = page.tab.get_by_role("group", name="Mask of layer 11")
    panel.get_by_label("Rule").select_option("height")  # with its sliders, which other layers have not
    page.wait("the rule", lambda: page.state()["layers"][11]["mask"])
    panel.get_by_role("textbox", name="Soft, number").wait_for()
    before = [row.bounding_box()["y"] for row in (first, second)]
    second.click()
    page.tab.get_by_role("group", name="Mask of layer 10").wait_for()
    assert [row.bounding_box()["y"] for row in (first, second)] == before
    page.tab.get_by_label("Rule").select_option("slope")
    page.wait("another rule", lambda: page.state()["layers"][10]["mask"])
    first.click()
    panel.get_by_role("textbox", name="Soft, number").wait_for()
    assert panel.get_by_label("Rule").input_value() == "height", "of each layer its own"
    page.tab.keyboard.press("Control+z")
    page.tab.keyboard.press("Control+z")
    page.wait("no mask", lambda: page.state()["layers"][11]["mask"] is None)
    page.wait("no rule", lambda: panel.get_by_label("Rule").input_value() == "")
    page.tab.get_by_role("button", name="Mask of the layer").click()

    rows.last.click()
    page.tab.get_by_role("tab", name="Adjust").click()
    exposure = page.tab.get_by_role("textbox", name="Exposure, number")
    exposure.fill("-1")
    exposure.press("Enter")
    page.tab.get_by_role("button", name="Apply as layer").click()
    page.wait("the adjustment", lambda: page.names()[-1] == "Adjustment")
    page.wait("its row", lambda: rows.first.get_attribute("aria-pressed") == "true")
    row, box = (one.bounding_box() for one in (rows.first, page.tab.locator(".layer-list")))
    assert box["y"] <= row["y"] and row["y"] + row["height"] <= box["y"] + box["height"]


def test_the_sliders_are_those_of_the_chosen_adjustment(
    opened: tuple[studio_scenes.Live, Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, page = opened
    live.post("layer.new", name="below")
    page.wait("a layer", lambda: page.names() == ["below"])
    page.tab.get_by_role("tab", name="Adjust").click()
    numbers = [page.tab.get_by_role("textbox", name=f"{name}, number") for name in ("Exposure", "Tint")]

    def write_number(number: Any, text: str) -> None:
        number.fill(text)
        number.press("Enter")

    def values() -> list[str]:
        return [number.input_value() for number in numbers]

    plain = page.pixels().mean()
    write_number(numbers[0], "-1")
    write_number(numbers[1], "0.5")
    page.tab.keyboard.press("Control+z")
    assert values() == ["-1.00", "0.00"], "what is not applied yet goes before what is"
    page.tab.keyboard.press("Control+z")
    page.tab.keyboard.press("Control+Shift+z")
    assert values() == ["-1.00", "0.00"] and page.state()["cursor"] == 1
    thumb = page.tab.get_by_role("slider", name="Exposure").bounding_box()
    page.tab.mouse.move(thumb["x"] + thumb["width"] / 5, thumb["y"] + thumb["height"] / 2)
    page.tab.mouse.down()
    held = values()
    page.tab.keyboard.press("Control+z")
    assert values() == held and held[0] != "-1.00", "a slider that is held"
    page.tab.mouse.up()
    live.post("layer.new", name="above")
    page.wait("another layer", lambda: page.names() == ["below", "above"])
    page.tab.keyboard.press("Control+z")
    page.wait("what was done after it to go first", lambda: page.names() == ["below"])
    assert values() == held
    write_number(numbers[0], "-1.5")
    page.tab.get_by_role("button", name="Apply as layer").click()
    page.wait("its layer", lambda: page.names() == ["below", "Adjustment"])
    page.wait("its sliders", lambda: page.tab.get_by_role("button", name="Another adjustment").count())
    assert values() == ["-1.50", "0.00"]
    page.wait("a darker ball", lambda: page.pixels().mean() < 0.9 * plain)

    gate = Gate(monkeypatch, SessionLayers, "set")
    write_number(numbers[0], "0.50")
    write_number(numbers[1], "0.25")
    gate.passes.release()
    page.wait("the first answer", lambda: page.state()["layers"][1]["parameters"]["exposure"] == 0.5)
    page.tab.wait_for_timeout(100)
    assert values() == ["0.50", "0.25"]
    gate.passes.release()
    page.wait("both", lambda: page.state()["layers"][1]["parameters"]["tint"] == 0.25)
    assert values() == ["0.50", "0.25"] and page.names() == ["below", "Adjustment"]
    assert page.state()["layers"][1]["parameters"]["exposure"] == 0.5

    page.tab.locator(".layer-name").last.click()
    page.wait("the sliders of a layer to come", lambda: values() == ["0.00", "0.00"])
    page.tab.locator(".layer-name").first.click()
    page.wait("its sliders", lambda: values() == ["0.50", "0.25"])
    gate.passes.release()
    page.tab.get_by_role("button", name="Reset", exact=True).click()
    page.wait("all at zero", lambda: page.state()["layers"][1]["parameters"]["exposure"] == 0)
    page.tab.get_by_role("button", name="Another adjustment").click()
    page.tab.get_by_role("button", name="Apply as layer").wait_for()


def test_a_sticker_is_laid_once_and_saved_when_it_is(
    opened: tuple[studio_scenes.Live, Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, page = opened
    picture = io.BytesIO()
    Image.new("RGB", (20, 20), (200, 40, 40)).save(picture, "png")

    def choose(name: str) -> None:
        with page.tab.expect_file_chooser() as chooser:
            page.tab.get_by_role("button", name="Choose a picture").click()
        chooser.value.set_files({"name": name, "mimeType": "image/png", "buffer": picture.getvalue()})

    page.tab.keyboard.press("p")
    choose("red.png")
    page.wait("it on the surface", lambda: page.ask("!!window.studio.placement.value?.anchor"))
    gate = Gate(monkeypatch, SessionSurface, "laid")
    stage = page.tab.locator("#stage")
    stage.press("Enter")
    assert page.tab.locator(".connection").inner_text().strip() == "Saving"
    stage.press("Enter")
    page.wait("the server", lambda: gate.waiting)
    choose("next.png")
    page.wait("the next one", lambda: page.ask("window.studio.placement.value?.name") == "next")
    gate.passes.release(2)
    page.wait("its layer", lambda: page.names() == ["red"])
    page.settled()
    assert page.names() == ["red"]
    assert page.ask("window.studio.placement.value?.name") == "next", "it waits to be placed"
    stage.press("Escape")
