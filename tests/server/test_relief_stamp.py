"""The clone stamp with relief, over HTTP and by the mouse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.support import studio_scenes
from tests.support.studio_pages import opened_page
from tests.support.studio_scenes import view, wire


def test_a_stamp_copies_gaussians_from_one_view_to_another(tmp_path: Path) -> None:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        session = live.studio.session
        before = session.splats
        source = {"source_camera": wire(view()), "source_x": 48, "source_y": 48}
        target = {"camera": wire(view(96, 120)), "x": 48, "y": 48, "radius": 18}
        layer = live.post("clone.relief", **source, **target)["layer"]
        assert (layer["kind"], layer["views"]) == ("relief", []) and layer["gaussians_appended"] > 5
        after = session.splats
        appended = after.means[len(before) :]
        assert np.allclose(np.linalg.norm(appended, axis=1), 1, atol=0.12), "on the ball"
        eye = np.array(view(96, 120).position)
        assert (appended @ eye > 0).all() and np.array_equal(after.means[:600], before.means)
        assert (after.opacities[:600] < before.opacities).sum() > 3, "what is there fades"
        for fields, words in (
            ({**source, **target, "x": 2, "y": 2}, "nothing of the asset at the target"),
            ({**source, **target, "source_x": 2, "source_y": 2}, "nothing of the asset at the source"),
            ({**source, **target, "x": -5}, "expected a pixel"),
        ):
            answer = live.http.post("/api/do/clone.relief", json=fields)
            assert answer.status_code == 400 and words in answer.json()["error"]["message"]
        live.post("layer.set", layer=layer["id"], visible=False)
        assert np.array_equal(session.splats.opacities, before.opacities) and len(session.layers) == 1


def test_the_clone_tool_stamps_with_relief(browser: Any, tmp_path: Path) -> None:
    """Alt-click chooses, the view may turn, a click stamps; without the tick it paints as before."""
    with opened_page(browser, tmp_path, still=True) as (_, page):
        page.tab.keyboard.press("s")
        page.tab.get_by_role("checkbox", name="With relief").check()
        size = page.tab.get_by_role("textbox", name="Size, number")
        size.fill("140")
        size.press("Enter")
        box = page.tab.locator("#stage").bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.tab.mouse.click(*middle)
        page.wait("what to do", lambda: page.tab.get_by_text("Choose where to copy from first.").count())
        page.tab.keyboard.down("Alt")
        page.tab.mouse.click(*middle)
        page.tab.keyboard.up("Alt")
        for _ in range(8):
            page.tab.locator("#stage").press("ArrowLeft")
        page.tab.mouse.click(*middle)
        page.wait("the stamp", lambda: page.names() == ["Clone with relief"])
        page.settled()
        assert page.state()["asset"]["gaussians"] > 600
        page.tab.keyboard.press("Control+z")
        page.wait("nothing", lambda: page.names() == [] and page.state()["asset"]["gaussians"] == 600)
