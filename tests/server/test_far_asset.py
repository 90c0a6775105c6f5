"""An asset at world coordinates that float32 cannot hold, in the studio: the page works near 0, files say where."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter import io as splat_io
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.splats import Splats
from tests.support.far_assets import UTM, doubles_of, far_ply, moved_camera
from tests.support.studio_scenes import Live, ball, live, make_studio, view, wire


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    far_ply(tmp_path / "far.ply", ball())
    (tmp_path / "shared").mkdir()
    with live(make_studio(tmp_path, splat_io.read(tmp_path / "far.ply"), shared=tmp_path / "shared")) as served:
        yield served


def picture(studio: Live, blob: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{blob}").content)).convert("RGB"))


def drawn(splats: Splats) -> np.ndarray:
    from splatpainter.rendering import render

    return np.rint(255 * np.clip(render(splats, view()).colors[0], 0, 1))


def test_the_page_sees_and_paints_it_near_zero(studio: Live, tmp_path: Path) -> None:
    shot = picture(studio, studio.post("view.render", camera=wire(view()))["picture"])
    assert abs(shot - drawn(splat_io.read(tmp_path / "near_far.ply"))).max() <= 2
    with studio.greeted() as browser:
        browser.stroke(view(), (40, 40), 16, (200, 30, 30, 255))
    after = picture(studio, studio.post("view.render", camera=wire(view()))["picture"])
    assert abs(after[44:52, 44:52] - np.array([200, 30, 30])).mean() < 12
    given = studio.post("export", file="out.ply")
    (tmp_path / "out.ply").write_bytes(studio.http.get(given["url"]).content)
    before, stored = doubles_of(tmp_path / "far.ply", 600), doubles_of(tmp_path / "out.ply", 600)
    same = (before == stored).all(1)
    assert same.sum() > 300 and given["lost"] == ""
    receipt = json.loads(studio.http.get(given["receipt_url"]).content)
    assert receipt["untouched_sha256_before"] == receipt["untouched_sha256_after"]


def test_pictures_carry_where_they_were_seen_from(studio: Live, tmp_path: Path) -> None:
    """Exported views name the offset; a picture of a camera in world coordinates finds its view."""
    studio.post("view.export", camera=wire(view()), name="seen", to="folder")
    record = json.loads((tmp_path / "shared" / "seen.json").read_text())
    assert tuple(record["offset"]) == UTM
    image = drawn(splat_io.read(tmp_path / "near_far.ply")) / 255
    image[40:56, 40:56] = (0.9, 0.8, 0.1)
    for camera in (moved_camera(view(), UTM), studio.studio.exports.items[-1].camera):
        checked = studio.post("picture.check", picture=studio.send(png_bytes(image, camera)))
        assert checked["camera_source"] == "chunk" and checked["share"] < 0.1
        there = np.array(checked["camera"]["world_to_camera"])
        assert abs(there - view().world_to_camera).max() < 1e-6


def test_lamps_stand_where_the_page_is_told_that_its_origin_is(studio: Live, tmp_path: Path) -> None:
    offset = studio.http.get("/api/state").json()["asset"]["offset"]
    assert tuple(offset) == studio.studio.session.original.offset != (0, 0, 0)
    x, y, z = (value + shift for value, shift in zip(offset, (0.5, -1.5, 1), strict=True))
    studio.post("layer.add", operation={"kind": "light", "point": [f"{x},{y},{z}"]})
    near = sp.light(splat_io.read(tmp_path / "near_far.ply"), sp.Lights(lamps=(sp.Lamp("point", (0.5, -1.5, 1)),)))
    assert abs(studio.studio.session.splats.sh - near.splats.sh).max() < 1e-3


def test_what_looks_wrong_is_said_when_it_is_opened(tmp_path: Path) -> None:
    far_ply(tmp_path / "far.ply", ball())
    splat_io.write(tmp_path / "far.spz", splat_io.read(tmp_path / "far.ply"))
    with live(make_studio(tmp_path, splat_io.read(tmp_path / "far.spz"))) as studio:
        (line,) = studio.studio.state.asset.doubts
    assert "rounded when the file was written" in line


def test_the_page_moves_a_second_tile_by_what_it_shows(studio: Live, tmp_path: Path) -> None:
    """Places that the page sees and sends are beside the offset of the asset that was opened; the project's, and
    Python's, are of the world."""
    site = (UTM[0] + 2.5, UTM[1], UTM[2])
    positions = far_ply(tmp_path / "east.ply", ball(), site)
    blob = studio.send((tmp_path / "east.ply").read_bytes(), "east.ply")
    with studio.greeted() as browser:
        added = browser.do("scene.add", blob=blob)["asset"]
        apart = np.array(studio.studio.session.scene.original_of(added).offset) - np.array(UTM)
        browser.do("scene.set", asset=added, move=apart.tolist(), turn=[0, 0, 0])
        surveyed = studio.http.get("/api/state").json()["assets"][1]
        np.testing.assert_allclose(surveyed["moved"], (0, 0, 0), atol=1e-6)
        browser.do("scene.set", asset=added, move=(apart + (0.5, 0, 0.25)).tolist(), turn=[0, 0, 0])
        info = studio.http.get("/api/state").json()["assets"][1]
    np.testing.assert_allclose(info["moved"], (0.5, 0, 0.25), atol=1e-6)
    np.testing.assert_allclose(info["move"], apart + (0.5, 0, 0.25), atol=1e-6)
    np.testing.assert_allclose(info["center"], np.median(positions, 0) - np.array(UTM) + (0.5, 0, 0.25), atol=1e-4)
    session = studio.studio.session
    np.testing.assert_allclose(session.scene.asset(added).placement.move, (0.5, 0, 0.25), atol=1e-6)
    rows = session.splats.world_means[len(session.opened) :]
    assert abs(rows - positions - (0.5, 0, 0.25)).max() < 1e-6
