"""Filling in the studio: over HTTP, and by keys, buttons and a source in a real browser."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.server.uploads.image_registration import png_bytes
from tests.holes.test_body import SPACING, flat, sphere
from tests.support import studio_scenes
from tests.support.studio_pages import opened_page
from tests.support.studio_scenes import Live, view, wire

TOOL = """
import pathlib, sys, time
mark = pathlib.Path(sys.argv[3])
if not mark.exists():  # this call hangs until it is cancelled
    mark.touch()
    time.sleep(600)
from PIL import Image
image = Image.open(sys.argv[1]).convert("RGB")
w, h = image.size
image.paste((40, 170, 60), (w * 7 // 16, h * 7 // 16, w * 9 // 16, h * 9 // 16))
image.save(sys.argv[2])
"""


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture source that paints the middle of a view green; it hangs where there is no file `mark`."""
    (tmp_path / "tool.py").write_text(TOOL, encoding="utf-8")
    (tmp_path / "mark").touch()
    run = f"{sys.executable} {tmp_path / 'tool.py'} {{image}} {{out}} {tmp_path / 'mark'}"
    monkeypatch.setenv("SPLATPAINTER_COMMAND_RUN", run)
    monkeypatch.setenv("SPLATPAINTER_COMMAND_STRICTNESS", "loose")


@pytest.fixture
def studio(tool: None, tmp_path: Path) -> Iterator[Live]:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        yield live


def circle(live: Live, radius: float) -> int:
    """Select a disc in the middle of the view; how many Gaussians that is."""
    y, x = np.mgrid[:96, :96] - 47.5
    mask = live.send(png_bytes(np.hypot(x, y) < radius), "mask.png")
    return live.post("selection.area", camera=wire(view()), mask=mask)["gaussians"]


def refused(live: Live, name: str, **fields: object) -> str:
    answer = live.http.post(f"/api/do/{name}", json=fields)
    assert answer.status_code == 400
    return answer.json()["error"]["message"]


def test_what_is_selected_is_removed_and_filled_and_coloured_by_a_source(studio: Live) -> None:
    session = studio.studio.session
    before = session.splats
    assert "nothing is selected" in refused(studio, "fill.selection")
    assert circle(studio, 14) > 10
    assert "there is no hole" in refused(studio, "fill.selection")
    made = studio.post("fill.selection", remove=True)
    layer, part = made["layer"], "only what was selected was removed: it is a part of something larger; "
    assert made["note"] == part + layer["note"], "a disc in the middle of one thing"
    assert layer["kind"] == "fill" and layer["gaussians_appended"] > 10 and "filled" in layer["note"]
    assert [one.kind for one in session.layers] == ["hide", "fill"] and not studio.studio.selection
    plain = session.splats
    fields = {"layer": layer["id"], "source": "command", "camera": wire(view())}
    made = studio.post("fill.source", **fields, prompt="")["layer"]
    assert len(made["views"]) == 1 and made["parameters"]["source"]["name"] == "command"
    green = session.splats
    count = len(before)
    assert np.array_equal(green.means, plain.means) and np.array_equal(green.sh[:count], before.sh)
    assert (green.sh[count:, 0, 1] - green.sh[count:, 0, 0]).max() > 1
    hidden = session.layers[0].id
    assert "expected a visible layer" in refused(studio, "fill.source", **{**fields, "layer": hidden})
    assert "expected a layer that fills" in refused(studio, "fill.surroundings", layer=hidden)
    assert studio.post("fill.surroundings", layer=layer["id"])["layer"]["views"] == []
    assert np.array_equal(session.splats.sh, plain.sh)


def test_the_page_removes_fills_asks_and_takes_it_back(browser: Any, tool: None, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, still=True) as (live, page):
        session = live.studio.session
        filled_picture = page.pixels()
        page.tab.keyboard.press("l")
        page.drag(*disc(0.12))
        page.wait("a selection", lambda: page.state()["selection"]["gaussians"])
        page.tab.get_by_role("tab", name="Select").click()
        page.tab.get_by_role("button", name="Fill hole").click()
        page.wait("a reason", lambda: "there is no hole; the surface" in page.tab.locator(".refusal").inner_text())
        page.tab.keyboard.press("Shift+F5")
        page.wait("both layers", lambda: page.names() == ["Fill: removed", "Fill"])
        page.settled()
        page.wait("nothing selected", lambda: page.state()["selection"]["gaussians"] == 0)
        height, width, _ = filled_picture.shape
        middle = np.s_[height // 2 - 8 : height // 2 + 9, width // 2 - 8 : width // 2 + 9]
        filled = page.pixels()
        assert np.abs(filled - filled_picture)[middle].mean() < 0.1, "closed in the colours around"
        page.tab.get_by_text("Filled from its surroundings").click()
        ask = page.tab.get_by_role("button", name="Ask", exact=True)
        page.wait("the sources", ask.is_enabled)
        (tmp_path / "mark").unlink()
        ask.click()
        page.wait("the program", (tmp_path / "mark").exists)
        page.tab.locator(".jobs").get_by_role("button", name="Cancel").click()
        page.settled()
        page.wait("the end of the job", lambda: page.tab.locator(".jobs .job").count() == 0)
        assert not page.state()["layers"][1]["views"] and np.array_equal(page.pixels(), filled), "cancelled: as it was"
        ask.click()
        page.wait("its colours", lambda: page.state()["layers"][1]["views"])
        page.settled()
        page.wait("green", lambda: (page.pixels()[middle][..., 1] - page.pixels()[middle][..., 0]).mean() > 0.2)
        page.tab.get_by_role("button", name="Surroundings", exact=True).click()
        page.wait("the former colours", lambda: not page.state()["layers"][1]["views"])
        page.settled()
        page.wait("as it was", lambda: np.abs(page.pixels() - filled).max() < 0.02)
        for _ in range(3):
            page.tab.keyboard.press("Control+z")
        page.wait("the beginning", lambda: page.names() == [])
        page.settled()
        assert np.array_equal(session.splats.means, session.original.means)
        page.wait("the asset", lambda: np.abs(page.pixels() - filled_picture)[middle].max() < 0.05)


def test_what_goes_is_tinted_before_and_can_be_changed(browser: Any, tmp_path: Path) -> None:
    """The whole ball, its back too; what is taken from it stays."""
    x, z = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-1, 1, SPACING)]))
    board = flat(np.stack([x, 0 * x, z], 1), np.tile([0.0, -1, 0], (len(x), 1)), (0.6, 0.6, 0.6))
    normals = (upright := sphere(0.5, (0.9, 0.2, 0.1)).means - (0, 0.5, 0)) / np.linalg.norm(upright, axis=1)[:, None]
    ball = flat(0.5 * normals - (0, 0.5, 0), normals, (0.9, 0.2, 0.1))
    things = board.append(ball)
    with opened_page(browser, tmp_path, splats=things, still=True) as (live, page):

        def count() -> int:
            return page.state()["selection"]["gaussians"]

        page.tab.keyboard.press("l")
        page.drag(*disc(0.19))
        page.wait("a selection", count)
        front = count()
        page.tab.get_by_role("tab", name="Select").click()
        page.tab.get_by_role("button", name="Whole thing").click()
        page.wait("the ball, its back too", lambda: count() > 2 * front)
        weights = live.studio.selection.weights()
        assert weights is not None
        body = weights > 0.5
        assert body[len(board) :].mean() > 0.95 and body[: len(board)].mean() < 0.02
        panel = page.tab.locator(".selection-panel")
        assert "What is tinted goes" in panel.inner_text() and "not only what is selected" not in panel.inner_text()
        page.tab.keyboard.down("Alt")
        page.drag(*disc(0.1))
        page.tab.keyboard.up("Alt")
        page.wait("less", lambda: 0 < count() < body.sum())
        weights = live.studio.selection.weights()
        assert weights is not None
        page.tab.get_by_role("button", name="Remove and fill").click()
        page.wait("both layers", lambda: page.names() == ["Fill: removed", "Fill"])
        hidden = live.studio.session.splats.opacities[: len(things)] == 0
        assert hidden.any() and not hidden[weights < 0.5].any(), "what was tinted, and no more"
        assert (live.studio.session.splats.opacities[: len(things)] > 0.9)[body & (weights == 0)].sum() > 5
        page.drag(*disc(0.05))
        page.wait("another selection", count)
        assert "not only what is selected" in panel.inner_text(), "of another thing it is asked anew"


def disc(radius: float) -> list[tuple[float, float]]:
    """Points of a closed curve around the middle of the page's view, shares of its width and height."""
    angle = np.linspace(0, 2 * np.pi, 13)
    return [(0.5 + 0.55 * radius * np.cos(a), 0.5 + radius * np.sin(a)) for a in angle]
