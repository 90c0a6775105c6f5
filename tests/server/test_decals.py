"""Decals over HTTP: laid on the surface under a pixel as a layer, changed afterwards, kept to what is selected."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import look_at
from splatpainter.decals import decal_placement
from splatpainter.rendering import render
from splatpainter.server.protocol import CameraInfo
from splatpainter.splats import ATTRIBUTES
from tests.support import studio_scenes, surface_shapes
from tests.support.studio_scenes import Live, view

CAMERA = CameraInfo.of(view()).model_dump()
MIDDLE = (48.0, 48.0)


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    studio = studio_scenes.make_studio(tmp_path, surface_shapes.sphere(1500))
    with studio_scenes.live(studio) as one:
        yield one


def label(color: tuple[int, int, int]) -> bytes:
    file = io.BytesIO()
    Image.new("RGBA", (24, 12), (*color, 255)).save(file, "png")
    return file.getvalue()


def placed(text: str, **fields: Any) -> dict[str, Any]:
    written = {"text": text, "font": "serif", "size": 12, "bold": False, "italic": False, "color": "#ff0000"}
    pose = {"x": 48, "y": 48, "scale": 1, "angle": 0, "opacity": 1, "mode": "normal"}
    return {"kind": "text", **pose, **written, "image": None, "unit": 0.03, "wrap": 90, "view": CAMERA, **fields}


def test_a_decal_is_a_layer_that_can_be_changed(live: Live) -> None:
    session = live.studio.session
    before = render(session.splats, view()).colors[0]
    fields = {"camera": CAMERA, "x": MIDDLE[0], "y": MIDDLE[1], "width": 0.6, "name": "Word"}
    answer = live.post("decal.lay", picture=live.send(label((255, 0, 0))), placed=placed("one"), **fields)
    assert answer["coverage"] > 0.9 and 1 <= answer["views"] <= 6 and answer["note"] == ""
    assert answer["layer"]["placed"]["unit"] == 0.03 and answer["layer"]["placed"]["view"]["width"] == 96
    change = np.abs(render(session.splats, view()).colors[0] - before).max(-1)
    assert change[48, 48] > 0.2 and change[5:20, 5:20].max() < 0.02
    rows, columns = np.nonzero(change > 0.1)
    assert np.ptp(columns) > 1.5 * np.ptp(rows)  # it lies as the label does
    layer = answer["layer"]["id"]
    again = live.post(
        "decal.lay", picture=live.send(label((0, 0, 255))), placed=placed("two"), replaces=layer, angle=90.0, **fields
    )
    assert [one.id for one in session.layers] == [layer] == [again["layer"]["id"]]
    assert again["layer"]["placed"]["text"] == "two"
    turned = np.abs(render(session.splats, view()).colors[0] - before).max(-1)
    rows, columns = np.nonzero(turned > 0.1)
    assert np.ptp(rows) > 1.5 * np.ptp(columns)
    live.post("undo")
    assert session.layers.by_id(layer).operation.placed["text"] == "one"  # pyright: ignore[reportAttributeAccessIssue]


def test_a_decal_keeps_to_what_is_selected(live: Live) -> None:
    left = np.zeros((96, 96))
    left[:, :48] = 255
    file = io.BytesIO()
    Image.fromarray(left.astype(np.uint8)).convert("RGB").save(file, "png")
    live.post("selection.area", camera=CAMERA, mask=live.send(file.getvalue()), how="replace", through=False)
    before = render(live.studio.session.splats, view()).colors[0]
    picture = live.send(label((255, 0, 0)))
    live.post("decal.lay", camera=CAMERA, x=48, y=48, width=0.6, picture=picture)
    change = np.abs(render(live.studio.session.splats, view()).colors[0] - before).max(-1)
    assert change[48, 40] > 0.2 and change[48, 58] < 0.05
    with_nothing = live.http.post(
        "/api/do/decal.lay", json={"camera": CAMERA, "x": 70, "y": 48, "width": 0.1, "picture": picture}
    )
    assert with_nothing.status_code == 400 and "selected" in with_nothing.json()["error"]["message"]


def test_where_there_is_no_surface_it_says_so(live: Live) -> None:
    fields = {"camera": CAMERA, "x": 2, "y": 2, "width": 0.5, "picture": live.send(label((255, 0, 0)))}
    answer = live.http.post("/api/do/decal.lay", json=fields)
    assert answer.status_code == 400 and "no surface" in answer.json()["error"]["message"]
    assert not live.studio.session.layers


def test_what_is_shown_before_is_where_it_is_laid(live: Live) -> None:
    """The page's preview against the painted result, rendered from the same view: straight on and from the side."""
    session = live.studio.session
    fields = {"camera": CAMERA, "x": 56.0, "y": 44.0, "width": 0.7, "angle": 20.0}
    oblique = look_at((2.2, -0.9, -2.2), (0, 0, 0), (0, -1, 0), width=128, height=96, fov=40)
    areas = []
    for camera in (view(), oblique):
        answer = live.post("decal.show", **fields, columns=24, rows=12, view=CameraInfo.of(camera).model_dump())
        uv = np.frombuffer(base64.b64decode(answer["data"]), "<f4").reshape(answer["rows"], answer["columns"], 2)
        assert (answer["block"], uv.shape[:2]) == (1, (camera.height, camera.width))
        with np.errstate(invalid="ignore"):
            areas.append((np.abs(uv[..., 0]) < 0.35) & (np.abs(uv[..., 1]) < 0.175))
    assert not session.layers
    before = [render(session.splats, camera).colors[0] for camera in (view(), oblique)]
    live.post("decal.lay", picture=live.send(label((255, 0, 0))), **fields)
    for area, camera, bare in zip(areas, (view(), oblique), before, strict=True):
        changed = np.abs(render(session.splats, camera).colors[0] - bare).max(-1) > 0.15
        assert area.sum() > 100 and (area & changed).sum() > 0.85 * (area | changed).sum()
    nowhere = live.http.post("/api/do/decal.show", json={**fields, "x": 2, "columns": 4, "rows": 4, "view": CAMERA})
    assert nowhere.status_code == 400 and "no surface" in nowhere.json()["error"]["message"]


def test_what_was_shown_is_not_surveyed_again(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it lies is found out once for preview and laying, whatever the picture shows, and anew for another place,
    size of the picture or state of the asset."""
    surveys = []
    survey = decal_placement.survey
    monkeypatch.setattr(decal_placement, "survey", lambda *args: surveys.append(args) or survey(*args))
    at = {"camera": CAMERA, "x": 56.0, "y": 44.0, "width": 0.7, "angle": 20.0}
    request = {**at, "columns": 24, "rows": 12, "view": CAMERA}
    live.post("decal.show", **request)
    assert len(surveys) == 1
    live.post("decal.show", **request)
    live.post("decal.show", **request, replaces=None)
    layer = live.post("decal.lay", picture=live.send(label((255, 0, 0))), **at)["layer"]["id"]
    assert len(surveys) == 1
    # Changed afterwards it lies on what is below it, which is as it was.
    live.post("decal.show", **request, replaces=layer)
    live.post("decal.lay", picture=live.send(label((0, 0, 255))), replaces=layer, **at)
    assert len(surveys) == 1
    for other in ({"x": 57.0}, {"angle": 21.0}, {"columns": 36}, {"width": 0.69}):
        before = len(surveys)
        live.post("decal.show", **{**request, **other}, replaces=layer)
        assert len(surveys) == before + 1, other
    live.post("decal.show", **request)
    assert len(surveys) == 6, "on the decal that is there now"


def test_a_shared_survey_lays_the_same(live: Live) -> None:
    """Rows of the layer with and without a preview before it."""
    at = {"camera": CAMERA, "x": 56.0, "y": 44.0, "width": 0.7}
    states = []
    for preview in (False, True):
        if preview:
            live.post("decal.show", **at, columns=24, rows=12, view=CAMERA)
        live.post("decal.lay", picture=live.send(label((255, 0, 0))), **at)
        states.append(live.studio.session.splats)
        live.post("undo")
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(states[0], name), getattr(states[1], name))
