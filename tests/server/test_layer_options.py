"""The panel of a layer whose kind the page does not know: made from the fields of its operation."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pytest

from splatpainter.server.commands import layer_options
from splatpainter.session.document import layer_operation
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork
from splatpainter.session.replay.delta import between
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system.ranges import ranged
from tests.support.studio_pages import opened_page
from tests.support.studio_scenes import Live, live, make_studio


@dataclass(frozen=True)
class TintLayer(LayerOperation):
    """A kind of another package: base colours move by some amount."""

    kind: ClassVar[str] = "tint"

    amount: float = ranged(0.0, ge=-1, le=1)
    """How far they move."""
    channel: Literal["red", "all"] = "all"
    backwards: bool = False
    picture: str = field(default="", metadata={"blob": True})
    limit: float | None = ranged(None, ge=0, le=1)
    names: tuple[str, ...] = ()

    def result(self, work: LayerWork) -> LayerResult:
        sh = work.splats.sh.copy()
        sh[:, 0, : 1 if self.channel == "red" else 3] += np.float32(-self.amount if self.backwards else self.amount)
        return LayerResult(between(work.splats, replace(work.splats, sh=sh)))


@pytest.fixture
def tint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(layer_operation.KINDS, "tint", f"{__name__}:TintLayer")


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live(make_studio(tmp_path)) as made:
        yield made


def test_options_are_those_of_the_dataclass(tint: None, studio: Live) -> None:
    """Without pictures."""
    layer = studio.studio.session.layers.add("tint", amount=0.25)
    amount, channel, backwards, limit, names = studio.post("layer.options", layer=layer.id)["options"]
    assert amount == {
        "name": "amount",
        "label": "Amount",
        "help": "How far they move.",
        "kind": "number",
        "value": 0.25,
        "default": 0.0,
        "choices": [],
        "optional": False,
        "low": -1,
        "high": 1,
    }
    assert (channel["kind"], channel["choices"], channel["value"]) == ("choice", ["red", "all"], "all")
    assert (backwards["kind"], backwards["value"]) == ("flag", False)
    assert (limit["kind"], limit["value"], limit["optional"]) == ("number", None, True)
    assert (names["kind"], names["value"], names["optional"]) == ("lines", [], False)
    studio.post("layer.set", layer=layer.id, parameters={"limit": 0.5, "names": ["a", "b"]})
    operation = studio.studio.session.layers.by_id(layer.id).operation
    assert isinstance(operation, TintLayer) and (operation.limit, operation.names) == (0.5, ("a", "b"))
    studio.post("layer.set", layer=layer.id, parameters={"limit": None})
    assert "limit" not in studio.studio.session.layers.by_id(layer.id).operation.changes()


def test_options_of_an_operation_are_set_back_to_where_they_were(studio: Live) -> None:
    layer = studio.post("layer.add", operation={"kind": "delight"})["layer"]["id"]
    options = {one["name"]: one for one in studio.post("layer.options", layer=layer)["options"]}
    assert options["shadows"]["value"] is True and options["mix"]["default"] == options["mix"]["value"]
    assert "where" not in options and "source_light" not in options
    lit = studio.studio.session.splats
    studio.post("layer.set", layer=layer, parameters={"mix": 0.5})
    assert not np.array_equal(studio.studio.session.splats.sh, lit.sh)
    studio.post("layer.set", layer=layer, parameters={"mix": options["mix"]["default"]})
    assert np.array_equal(studio.studio.session.splats.sh, lit.sh)
    assert studio.studio.session.layers.by_id(layer).operation.changes() == {}


def test_the_page_has_controls_for_a_kind_of_another_package(tint: None, browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True) as (studio, page):
        before = studio.studio.session.splats.sh
        studio.post("layer.duplicate", layer=studio.studio.session.layers.add("tint").id)
        page.wait("the layers", lambda: page.names() == ["Tint", "Tint copy"])
        page.tab.locator(".layer").first.click()
        panel = page.tab.locator("details", has_text="Options of tint")
        amount = panel.get_by_role("textbox", name="Amount, number")
        amount.fill("7")
        amount.press("Enter")
        page.wait("the end of its range", lambda: page.state()["layers"][1]["parameters"] == {"amount": 1})
        panel.get_by_label("Channel").select_option("red")
        page.wait("red alone", lambda: page.state()["layers"][1]["parameters"].get("channel") == "red")
        change = studio.studio.session.splats.sh[:, 0] - before[:, 0]
        np.testing.assert_allclose(change, [[1, 0, 0]] * len(change), atol=1e-6)
        panel.get_by_label("Backwards").check()
        page.wait("the other way", lambda: studio.studio.session.splats.sh[0, 0, 0] < before[0, 0, 0])
        panel.get_by_label("Set limit").click()
        page.wait("a limit", lambda: page.state()["layers"][1]["parameters"].get("limit") == 0)
        panel.get_by_label("Set limit").click()
        page.wait("none", lambda: "limit" not in page.state()["layers"][1]["parameters"])
        panel.get_by_label("Names, one in a line").fill("one\n two \n")
        panel.get_by_label("Names, one in a line").blur()
        page.wait("names", lambda: page.state()["layers"][1]["parameters"].get("names") == ["one", "two"])
        assert page.serious() == []


def test_a_control_stays_where_it_was_set_while_the_layer_is_made_anew(
    tint: None, browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    free.set()
    result = TintLayer.result

    def when_free(layer: TintLayer, work: LayerWork) -> LayerResult:
        assert free.wait(60)
        return result(layer, work)

    monkeypatch.setattr(TintLayer, "result", when_free)
    listed = threading.Event()
    listed.set()
    types = layer_options.field_types
    monkeypatch.setattr(layer_options, "field_types", lambda kind: listed.wait(60) and types(kind))
    with opened_page(browser, tmp_path, still=True) as (studio, page):
        studio.post("layer.duplicate", layer=studio.studio.session.layers.add("tint").id)
        page.wait("the layers", lambda: page.names() == ["Tint", "Tint copy"])
        page.tab.locator(".layer").first.click()
        panel = page.tab.locator("details", has_text="Options of tint")
        panel.wait_for()
        listed.clear()
        try:
            panel.get_by_label("Channel").select_option("red")
            page.wait("red alone", lambda: page.state()["layers"][1]["parameters"] == {"channel": "red"})
            free.clear()
            panel.get_by_label("Backwards").check()
            panel.get_by_label("Set limit").check()
            listed.set()
            page.tab.wait_for_timeout(300)  # The options of before both come in meanwhile.
            assert panel.get_by_label("Channel").input_value() == "red"
            assert panel.get_by_label("Backwards").is_checked()
            assert "backwards" not in page.state()["layers"][1]["parameters"]
        finally:
            free.set()
            listed.set()
        expected = {"channel": "red", "backwards": True, "limit": 0}
        page.wait("all three", lambda: page.state()["layers"][1]["parameters"] == expected)
        # What the layer became is what they say afterwards, however it came about.
        studio.post("undo")
        page.wait("no limit", lambda: not panel.get_by_label("Set limit").is_checked())
        assert panel.get_by_label("Backwards").is_checked()
