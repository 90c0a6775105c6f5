"""Mode spread in the studio: strokes and pictures over HTTP, the threshold, the confidence; and once in the page."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from splatbench.studio_client import encoded, wire

from splatpainter.image_files import encode_png, to_uint8
from splatpainter.lift.edit_views import EditView
from splatpainter.session.document.layer_factory import decode_cover, decode_mask
from splatpainter.splats import ColorSpace
from splatpainter.spread import spread
from tests.support.lift_scenes import differing
from tests.support.spread_scenes import CAMERA, SIDE, board, left_half, painted_picture
from tests.support.studio_pages import opened_page
from tests.support.studio_scenes import Live, live, make_studio

BACK = np.arange(2 * SIDE**2) >= SIDE**2


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live(make_studio(tmp_path, board())) as made:
        yield made


def behind(studio: Live) -> int:
    """How many Gaussians of the back changed."""
    return int(differing(board(), studio.studio.session.splats)[BACK].sum())


def stroke(studio: Live, **fields: Any):
    """All of the left half painted as one stroke."""
    name = studio.post("paint.begin", camera=wire(CAMERA))["stroke"]
    rgba = np.dstack([to_uint8(painted_picture(board())), np.where(left_half(), 255, 0).astype(np.uint8)])
    studio.post("paint.dab", stroke=name, x=0, y=0, width=72, height=72, rgba=encoded(rgba))
    return studio.http.post("/api/do/paint.end", json={"stroke": name, **fields})


def test_a_stroke_that_spreads_is_a_layer_with_a_threshold(studio: Live) -> None:
    made = stroke(studio, spread=0.5, name="Brush").json()["layer"]
    assert made["mode"] == "spread" and made["parameters"]["spread_threshold"] == 0.5 and made["strokes"] is None
    count = behind(studio)
    assert count > 250
    blob = studio.post("spread.show", camera=wire(CAMERA), layer=made["id"])["picture"]
    picture = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{blob}").content)))
    assert picture.shape == (72, 72, 4) and picture[36, 20, 3] > 150 > 60 > picture[36, 60, 3]
    parameters = {**made["parameters"], "spread_threshold": 1.0}
    studio.post("layer.set", layer=made["id"], parameters=parameters)
    assert behind(studio) == 0
    studio.post("undo")
    assert behind(studio) == count and studio.post("verify")["proved"]


def test_a_soft_brush_is_kept_as_thick_as_it_was(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """What spreads asks how far each pixel was covered, also when the layer is computed anew; of a glaze, over its
    thickest."""
    covers_of_views = []
    paint_alone = spread.paint_alone

    def spied(view: EditView, space: ColorSpace) -> EditView:
        covers_of_views.append(view.cover)
        return paint_alone(view, space)

    monkeypatch.setattr(spread, "paint_alone", spied)
    alpha = np.where(left_half(), 120, 0)
    alpha[:, :20] = np.where(left_half(), 30, 0)[:, :20]
    for thickness in (1, 2):
        name = studio.post("paint.begin", camera=wire(CAMERA))["stroke"]
        rgba = np.dstack([to_uint8(painted_picture(board())), thickness * alpha]).astype(np.uint8)
        studio.post("paint.dab", stroke=name, x=0, y=0, width=72, height=72, rgba=encoded(rgba))
        layer = studio.post("paint.end", stroke=name, spread=0.5)["layer"]["id"]
        session = studio.studio.session
        (view,) = session.layers.by_id(layer).views
        data = session._core.project.blob(view.mask or "")
        np.testing.assert_array_equal(decode_mask(data, view.camera, "mask"), left_half())
        covers = [decode_cover(data, view.camera, "mask"), covers_of_views[-1]]
        for cover in covers:
            np.testing.assert_allclose(cover[left_half()], alpha[left_half()] / 120, atol=0.005)
        assert behind(studio) > 250
        studio.post("undo")
    # What stays where it is painted has a mask as ever.
    name = studio.post("paint.begin", camera=wire(CAMERA))["stroke"]
    studio.post("paint.dab", stroke=name, x=0, y=0, width=72, height=72, rgba=encoded(rgba))
    layer = studio.post("paint.end", stroke=name)["layer"]["id"]
    (view,) = session.layers.by_id(layer).views
    assert decode_cover(session._core.project.blob(view.mask or ""), view.camera, "mask") is None


def test_a_picture_is_spread(studio: Live) -> None:
    rgba = np.dstack([to_uint8(painted_picture(board())), np.where(left_half(), 255, 0).astype(np.uint8)])
    blob = studio.send(encode_png(rgba))
    view = {"camera": wire(CAMERA), "picture": blob}
    studio.post("edit", views=[view], mode="spread", spread=0.4)
    assert behind(studio) > 250
    answer = studio.http.post("/api/do/spread.show", json={"camera": wire(CAMERA), "layer": "9"})
    assert answer.status_code == 400 and "expected one of 1" in answer.json()["error"]["message"]


def test_a_selection_limits_how_far_a_stroke_reaches(studio: Live) -> None:
    studio.post("selection.box", low=[-2, 0, -2], high=[2, 2, 2])
    made = stroke(studio, spread=0.3).json()["layer"]
    changed, y = differing(board(), studio.studio.session.splats), board().means[:, 1]
    assert made["parameters"]["selection"] and not changed[y < 0].any()
    assert changed[BACK & (y > 0.1) & (board().means[:, 0] < -0.1)].mean() > 0.9


def test_a_stroke_that_spreads_goes_into_no_other_layer(studio: Live) -> None:
    layer = studio.post("layer.new")["layer"]["id"]
    answer = stroke(studio, spread=0.5, layer=layer)
    assert answer.status_code == 400 and "a new layer of its own" in answer.json()["error"]["message"]
    answer = studio.http.post("/api/do/spread.show", json={"camera": wire(CAMERA), "layer": layer})
    assert answer.status_code == 400 and "expected a visible layer of mode spread" in answer.json()["error"]["message"]


def test_the_page_spreads_a_stroke_and_shows_how_sure_it_is(browser: Any, tmp_path: Path) -> None:
    with opened_page(browser, tmp_path, splats=board()) as (studio, page):
        page.tab.get_by_role("button", name="Spread").click()
        page.drag((0.42, 0.4), (0.44, 0.6))
        page.wait("the layer", lambda: [layer["mode"] for layer in page.state()["layers"]] == ["spread"])
        page.settled()
        assert page.names() == ["Paint"], "as the layer of other strokes"
        panel = page.tab.get_by_role("region", name="Layers")
        panel.get_by_label("Show confidence").check()
        page.wait("the overlay", lambda: page.tab.locator("[data-still=confidence]").count())
        panel.get_by_role("textbox", name="Threshold, number").fill("100")
        panel.get_by_role("textbox", name="Threshold, number").press("Enter")
        page.wait("the slider", lambda: page.state()["layers"][0]["parameters"]["spread_threshold"] == 1)
        assert behind(studio) == 0
