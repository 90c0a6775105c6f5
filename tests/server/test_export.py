"""Views out of the studio and the session: any size, transparent, more bits, AOVs with coverage; and back again."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter import image_files
from splatpainter.image_files import find_alpha, find_camera, read_deep
from splatpainter.io import read
from splatpainter.painter import Edit
from splatpainter.rendering import render
from splatpainter.server.commands import picture_check, viewing
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.server.uploads.watched_folder import saved_picture
from splatpainter.session import Session
from tests.support.studio_scenes import Live, ball, live_with_folder, view, wire

deep = pytest.mark.skipif(not image_files.can_do_deep(), reason="OpenImageIO is not installed (extra pictures)")


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live_with_folder(tmp_path) as one:
        yield one


def paint(studio: Live) -> np.ndarray:
    """A layer on the middle of the view; returns its mask."""
    image, mask = np.clip(render(ball(), view()).colors[0], 0, 1), np.zeros((96, 96), bool)
    mask[38:58, 38:58] = True
    image[mask] = (0.1, 0.9, 0.1)
    picture, area = studio.send(png_bytes(image)), studio.send(png_bytes(mask))
    studio.post("edit", views=[{"camera": wire(view()), "picture": picture, "mask": area}])
    return mask


@deep
def test_a_large_transparent_view_with_its_passes_is_one_zip(studio: Live, tmp_path: Path) -> None:
    mask = paint(studio)
    aovs = ["alpha", "depth", "normal", "gaussian-ids", "coverage"]
    fields = {"size": 200, "bits": 16, "transparent": "straight", "aovs": aovs, "name": "big"}
    made = studio.post("view.export", camera=wire(view()), **fields)
    assert made["name"] == "big.zip"
    assert made["python"] == (
        "session.files.export_view('big.png', camera, bits=16, transparent='straight', "
        "aovs=['alpha', 'depth', 'normal', 'gaussian-ids', 'coverage'])"
    )
    bundle = zipfile.ZipFile(io.BytesIO(studio.http.get(made["url"]).content))
    assert bundle.namelist() == ["big.png", *(f"big.{name}.png" for name in aovs), "big.json"]
    bundle.extractall(tmp_path / "zip")
    picture = tmp_path / "zip" / "big.png"
    camera = find_camera(picture)
    assert (camera.width, camera.height) == (200, 200) and find_alpha(picture) == "straight"
    stored = read_deep(picture, 10**6).values
    drawn = render(studio.studio.session.splats, camera)
    assert np.abs(stored[..., 3:] - drawn.alphas[0]).max() < 1e-4
    with Image.open(tmp_path / "zip" / "big.coverage.png") as image:
        coverage = np.asarray(image.resize((96, 96))).astype(int)
    assert coverage[..., 1][45:50, 45:50].min() > 150, "seen where it was painted"
    assert coverage[..., 1][~mask][::7].mean() < 60 and coverage[..., 0].max() < 30
    ids = np.asarray(Image.open(tmp_path / "zip" / "big.gaussian-ids.png")).astype(int) @ [1, 256, 65536]
    assert ids[100, 100] > 0 and ids[0, 0] == 0 and ids.max() <= len(studio.studio.session.splats)


@deep
def test_exr_and_the_look_of_another_viewer(studio: Live, tmp_path: Path) -> None:
    fields = {"format": "exr", "bits": 32, "profile": "playcanvas", "name": "light"}
    made = studio.post("view.export", camera=wire(view()), **fields)
    assert made["name"] == "light.exr" and made["url"].endswith("/light.exr")
    path = tmp_path / "light.exr"
    path.write_bytes(studio.http.get(made["url"]).content)
    theirs = render(ball(), view(), profile="playcanvas").colors[0]
    light = np.where(theirs <= 0.04045, theirs / 12.92, ((theirs + 0.055) / 1.055) ** 2.4)
    assert np.abs(read_deep(path, 10**6).values - light).max() < 1e-5
    preview = studio.post("view.render", camera=wire(view()), profile="playcanvas")
    pixels = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{preview['picture']}").content))) / 255
    assert np.abs(pixels - np.clip(theirs, 0, 1)).max() <= 0.51 / 255
    assert np.abs(pixels - np.clip(render(ball(), view()).colors[0], 0, 1)).max() > 1 / 255


def test_a_plain_view_is_what_it_was(studio: Live) -> None:
    made = studio.post("view.export", camera=wire(view()))
    data = studio.http.get(made["url"]).content
    assert data == studio.http.get(f"/api/blobs/{made['picture']}").content and made["name"] == "view.png"
    pixels = np.asarray(Image.open(io.BytesIO(data)))
    assert np.abs(pixels / 255 - np.clip(render(ball(), view()).colors[0], 0, 1)).max() <= 0.51 / 255
    assert made["python"] == "session.files.export_view('view.png', camera)"


@deep
@pytest.mark.parametrize("transparent", [None, "straight", "premultiplied"])
def test_an_export_into_the_folder_comes_back_unchanged(studio: Live, transparent: str | None, tmp_path: Path) -> None:
    fields = {"to": "folder", "name": "out", "size": 192, "transparent": transparent, "aovs": ["depth"]}
    made = studio.post("view.export", camera=wire(view()), **fields)
    names = sorted(path.name for path in (tmp_path / "shared").iterdir())
    assert names == ["out.depth.png", "out.json", "out.png"] and made["file"] == "out.png"
    for name in names:
        assert saved_picture(studio.studio, name) is None, "the studio's own files are no edits"
    with Image.open(tmp_path / "shared" / "out.png") as image:
        levels = np.asarray(image).copy()
    bare = io.BytesIO()
    Image.fromarray(levels).save(bare, "PNG")  # text chunks are gone, the sidecar is there
    checked = studio.post("picture.check", picture=studio.send(bare.getvalue()), name="out.png")
    assert checked["camera_source"] == "sidecar" and checked["share"] < 0.001, "an untouched edge is no edit"
    levels[80:110, 80:110, :3] = (230, 20, 20)
    edited = io.BytesIO()
    Image.fromarray(levels).save(edited, "PNG")
    checked = studio.post("picture.check", picture=studio.send(edited.getvalue()), name="out.png")
    assert 0.015 < checked["share"] < 0.04


def test_a_view_larger_than_what_is_painted_comes_back_smaller(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (viewing, picture_check):
        assert module.MAX_VIEW_PIXELS == 4_000_000
        monkeypatch.setattr(module, "MAX_VIEW_PIXELS", 360_000)
    made = studio.post("view.export", camera=wire(view()), size=630, name="huge")
    data = studio.http.get(made["url"]).content
    checked = studio.post("picture.check", picture=studio.send(data))
    camera = checked["camera"]
    assert camera["width"] * camera["height"] <= 360_000 and camera["width"] > 590
    assert checked["share"] < 0.001 and any("resampled from 630x630" in note for note in checked["notes"])


def test_what_is_refused(studio: Live) -> None:
    tall = wire(view()) | {"width": 90}
    for fields, reason in (
        ({"size": 8000}, "at most 16.8 megapixels"),
        ({"bits": 32}, "8 or 16 bits of PNG"),
        ({"format": "exr", "transparent": "straight"}, "multiplied by alpha"),
        ({"to": "folder", "name": "..", "aovs": ["depth", "depth"]}, "every AOV once"),
    ):
        answer = studio.http.post("/api/do/view.export", json={"camera": tall, **fields})
        assert answer.status_code == 400 and reason in answer.json()["error"]["message"], answer.text
    for fields in ({"size": 9000}, {"bits": 12}, {"aovs": ["beauty"]}, {"profile": "unreal"}):
        assert studio.http.post("/api/do/view.export", json={"camera": tall, **fields}).status_code in (400, 422)


def test_a_session_exports_its_view(tmp_path: Path) -> None:
    with Session(ball()) as session:
        mask = np.zeros((96, 96), bool)
        mask[40:56, 40:56] = True
        image = np.where(mask[..., None], (0.9, 0.1, 0.1), render(ball(), view()).colors[0]).astype(np.float32)
        session.layers.add("paint", [Edit(image, view(), mask)])
        made = session.files.export_view(tmp_path / "v.png", view(), aovs=("depth", "coverage"), transparent="straight")
        assert [path.name for path in made] == ["v.png", "v.depth.png", "v.coverage.png", "v.json"]
        with Image.open(made[2]) as picture:
            assert np.asarray(picture)[46:50, 46:50, 1].min() > 150
        assert json.loads(made[3].read_text())["aov"]["coverage"]["file"] == "v.coverage.png"
        with pytest.raises(ValueError, match="v.png: already exists"):
            session.files.export_view(tmp_path / "v.png", view())
        with pytest.raises(ValueError, match="ending in .png or .exr"):
            session.files.export_view(tmp_path / "v.jpg", view())
        session.files.export_view(tmp_path / "v.png", view(), overwrite=True)


@pytest.mark.parametrize("ending", [".ply", ".splat", ".spz"])
def test_an_asset_is_written_in_the_axes_that_are_asked_for(studio: Live, tmp_path: Path, ending: str) -> None:
    made = {axes: studio.post("export", file=f"{axes}{ending}", axes=axes) for axes in ("auto", "rub")}
    assert "axes=" not in made["auto"]["python"] and "axes='rub'" in made["rub"]["python"]
    means = {}
    for axes, answer in made.items():
        path = tmp_path / answer["file"]
        path.write_bytes(studio.http.get(answer["url"]).content)
        means[axes] = read(path, axes="rdf").means  # the file's numbers as they are, whatever they mean
    assert np.abs(means["auto"]).max(axis=0).min() > 0.1
    np.testing.assert_allclose(means["rub"] * (1, -1, -1), means["auto"], atol=1e-6)
    assert studio.http.get(made["rub"]["receipt_url"]).status_code == 200, "proved as it was written"
