"""Positions that float32 cannot hold: read, written, drawn, edited and proved relative to an offset in float64."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter import io
from splatpainter.io import positions
from splatpainter.operations.region import Region
from splatpainter.painter import Edit, Painter
from splatpainter.receipts import prove, verify
from splatpainter.session import Session
from tests.support import glb_files
from tests.support.cli_scenes import BOX, Capture, ball, paint, run
from tests.support.far_assets import ECEF, UTM, doubles_of, far_ball, far_ply, moved_camera
from tests.support.io_assets import random_splats

CAMERA = sp.look_at((0.0, -0.8, -3.5), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=96, height=96)


@pytest.mark.parametrize("site", [UTM, ECEF, (-3e7, 1e6, -2e9)])
@pytest.mark.parametrize("order", ["<", ">", "="])
def test_doubles_survive_reading_and_writing(site: tuple[float, float, float], order: str, tmp_path: Path) -> None:
    path = tmp_path / "far.ply"
    truth = far_ply(path, ball(300, degree=0), site, order)
    splats = io.read(path)
    assert max(abs(np.array(splats.offset) - site)) < 4, "amid the Gaussians"
    assert abs(splats.world_means - truth).max() < 1e-6 and splats.means.dtype == np.float32
    io.write(tmp_path / "again.ply", splats)
    assert (tmp_path / "again.ply").read_bytes() == path.read_bytes()


def test_what_float32_holds_stays_without_an_offset(tmp_path: Path) -> None:
    """Doubles near 0, and places that are only a little far: as ever, bit for bit."""
    for site in ((0.0, 0.0, 0.0), (100.0, -50.0, 3.0)):
        path = tmp_path / "near.ply"
        truth = far_ply(path, ball(300, degree=0), site)
        splats = io.read(path)
        assert splats.offset == (0, 0, 0)
        assert np.array_equal(splats.means, truth.astype(np.float32))


def test_a_changed_row_alone_gets_other_doubles(tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    means = splats.means.copy()
    means[7] += np.float32(0.25)
    io.write(tmp_path / "out.ply", replace(splats, means=means))
    stored = doubles_of(tmp_path / "out.ply", len(splats))
    assert np.array_equal(np.delete(stored, 7, 0), np.delete(truth, 7, 0))
    assert abs(stored[7] - truth[7] - 0.25).max() < 1e-6


@pytest.mark.parametrize("name", ["new.ply", "new.glb"])
def test_formats_that_hold_doubles_lose_nothing(name: str, tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    io.write(tmp_path / name, replace(splats, source=None, origin=None))
    again = io.read(tmp_path / name)
    assert again.offset == splats.offset and np.array_equal(again.means, splats.means)
    if name == "new.ply":
        assert abs(doubles_of(tmp_path / name, len(truth)) - truth).max() < 1e-6
    else:  # glTF is y up: half a turn about z
        doc, _ = glb_files.parts((tmp_path / name).read_bytes())
        x, y, z = splats.offset
        assert doc["nodes"][0]["translation"] == [-x, -y, z]


def test_a_node_far_away_is_an_offset_and_stays_as_it_is(tmp_path: Path) -> None:
    """The same rows under a node near 0 and under one far away have the same means; an edit keeps the node."""
    rows = replace(random_splats(50, 1), antialiased=False)
    attributes = glb_files.attributes_of(rows)
    move = [123456789.25, -98765432.5, 1e6]
    (tmp_path / "near.glb").write_bytes(glb_files.build(attributes, nodes=[{"mesh": 1}]))
    (tmp_path / "far.glb").write_bytes(glb_files.build(attributes, nodes=[{"mesh": 1, "translation": move}]))
    near, far = io.read(tmp_path / "near.glb"), io.read(tmp_path / "far.glb")
    assert far.offset == (-move[0], -move[1], move[2]) and np.array_equal(far.means, near.means)
    io.write(tmp_path / "again.glb", far)
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "far.glb").read_bytes()
    means = far.means.copy()
    means[3] += np.float32(0.5)
    io.write(tmp_path / "edited.glb", replace(far, means=means))
    edited = io.read(tmp_path / "edited.glb")
    assert edited.offset == far.offset and np.array_equal(edited.means, means)


def test_other_formats_round_to_float32_world_coordinates(tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    for ending in ("spz", "sog", "compressed.ply", "splat"):
        io.write(tmp_path / f"out.{ending}", splats)
        coarse = io.read(tmp_path / f"out.{ending}")
        assert coarse.offset == (0, 0, 0)
        assert abs(coarse.means.astype(np.float64) - truth).max() < 200, ending


def test_turned_axes_turn_the_offset(tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    turned = io.read(tmp_path / "far.ply", axes="rub")
    assert turned.offset == (splats.offset[0], -splats.offset[1], -splats.offset[2])
    assert abs(turned.world_means - truth * (1, -1, -1)).max() < 1e-6
    io.write(tmp_path / "again.ply", turned)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "far.ply").read_bytes()
    given = io.read(tmp_path / "far.ply", axes="rub", offset=(0.0, 1.0, 2.0))
    assert given.offset == (0, 1, 2) and abs(given.world_means - turned.world_means).max() < 0.6


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_world_camera_sees_the_same_picture(backend: sp.rendering.Backend, tmp_path: Path) -> None:
    splats, _ = far_ball(tmp_path / "far.ply")
    near = io.read(tmp_path / "near_far.ply")
    there = sp.render(splats, moved_camera(CAMERA, UTM), backend=backend).colors
    here = sp.render(near, CAMERA, backend=backend).colors
    assert abs(there - here).max() < 2e-4, "moved by 1e-9 a row, in float32"


def test_cameras_say_what_they_are_relative_to() -> None:
    world = moved_camera(CAMERA, ECEF)
    local = world.relative_to(ECEF)
    assert abs(local.world_to_camera - CAMERA.world_to_camera).max() < 1e-8
    assert sp.Camera.from_json(local.to_json()).offset == ECEF
    back = sp.Camera.from_json(local.to_json()).relative_to((0.0, 0.0, 0.0))
    assert abs(back.world_to_camera - world.world_to_camera).max() < 1e-8
    assert "offset" not in CAMERA.record()
    beside = replace(CAMERA, offset=None)  # the studio's page: wherever the asset is
    assert sp.Camera.from_json(beside.to_json()).offset is None
    assert np.array_equal(beside.relative_to(ECEF).world_to_camera, CAMERA.world_to_camera)
    for wrong in ([1, 2], [1, 2, math.inf], "abc", 7, [1, 2, "x"]):
        with pytest.raises(ValueError, match="camera"):
            sp.Camera.from_record({**CAMERA.record(), "offset": wrong})


def painted_edit(splats: sp.Splats, camera: sp.Camera) -> Edit:
    image = np.clip(sp.render(splats, camera).colors[0], 0, 1).copy()
    mask = np.zeros(image.shape[:2], bool)
    mask[40:56, 40:56] = True
    image[mask] = (0.1, 0.7, 0.2)
    return Edit(image, camera, mask)


def test_an_edit_is_that_of_the_asset_near_zero(tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    near = io.read(tmp_path / "near_far.ply")
    painter = Painter.load("lift")
    far = painter.apply(painter.encode(splats), [painted_edit(splats, moved_camera(CAMERA, UTM))])
    here = painter.apply(painter.encode(near), [painted_edit(near, CAMERA)])
    assert len(far.splats) == len(here.splats) and far.splats.offset == splats.offset
    assert far.receipt is not None and here.receipt is not None
    assert far.receipt.views[0].psnr_after == pytest.approx(here.receipt.views[0].psnr_after, abs=0.2)
    for name in ("out.ply", "out.glb"):
        io.write(tmp_path / name, far.splats)
        receipt, proof = prove(splats, tmp_path / name, far.receipt)
        assert proof.ok and verify(tmp_path / "far.ply", tmp_path / name, receipt).ok
    untouched = np.setdiff1d(np.arange(len(truth)), far.receipt.touched)
    assert np.array_equal(doubles_of(tmp_path / "out.ply", len(truth))[untouched], truth[untouched])


@pytest.mark.parametrize("from_file", [True, False])
def test_a_session_keeps_the_offset(from_file: bool, tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply")
    asset = splats if from_file else replace(splats, source=None, origin=None)
    with Session(asset, tmp_path / "a.splatproj", painter=Painter.load("lift")) as session:
        session.layers.add("paint", [painted_edit(splats, moved_camera(CAMERA, UTM))])
        edited = session.splats
    with Session.load(tmp_path / "a.splatproj", painter=Painter.load("lift")) as session:
        assert session.original.offset == splats.offset == session.splats.offset
        assert np.array_equal(session.splats.means, edited.means) and not session.verify(repaint=True)
        (layer,) = session.layers
        picture = sp.render(session.splats, layer.cameras[0]).colors[0]
        assert abs(picture[48, 48] - (0.1, 0.7, 0.2)).max() < 0.1
        receipt, proof = session.files.export(tmp_path / "out.ply")
        assert proof.ok
    untouched = np.setdiff1d(np.arange(len(truth)), receipt.touched)
    stored = doubles_of(tmp_path / "out.ply", len(truth))
    assert abs(stored[untouched] - truth[untouched]).max() < 1e-6
    assert not from_file or np.array_equal(stored[untouched], truth[untouched])


def test_commands_take_world_cameras(capfd: Capture, tmp_path: Path) -> None:
    """render with a camera in world coordinates, paint on its picture, edit: as near 0."""
    far_ball(tmp_path / "far.ply")
    (tmp_path / "cam.json").write_text(moved_camera(CAMERA, UTM).to_json())
    (tmp_path / "near.json").write_text(CAMERA.to_json())
    for asset, camera, out in (("far.ply", "cam.json", "far"), ("near_far.ply", "near.json", "near")):
        words = ("render", tmp_path / asset, "--camera", tmp_path / camera, "--out", tmp_path / out)
        assert run(capfd, *words).code == 0
    far, near = ((tmp_path / name / "view_000.png") for name in ("far", "near"))
    one, two = (_pixels(path).astype(float) for path in (far, near))
    assert abs(one - two).max() <= 2
    painted = paint(far, tmp_path / "painted.png", BOX)
    done = run(capfd, "edit", tmp_path / "far.ply", painted, "--out", tmp_path / "out.ply", "--json")
    assert done.code == 0 and done.json["verified"] is True
    # The picture lost its camera, and the one in world coordinates is given.
    done = run(capfd, "info", tmp_path / "out.ply", "--json")
    low, high = np.array(done.json["bounds"])
    assert (low > np.array(UTM) - 1.2).all() and (high < np.array(UTM) + 1.2).all()
    assert done.json["offset"] == list(io.read(tmp_path / "out.ply").offset)
    text = run(capfd, "info", tmp_path / "out.ply").out
    assert "5399999.0" in text and "sizes of a Gaussian" in text, text


def _pixels(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def test_steps_by_hand() -> None:
    """Neighbouring float32 numbers at 5.4e6 are 0.5 apart (2^22 to 2^23: 2^-1)."""
    means = np.tile(np.array([[5e5, 5.4e6, 300.0]]), (5, 1))
    scales = np.full((5, 3), 0.03)
    scales[:, 1] = 0.01
    assert positions.float32_step(means).tolist() == [0.5] * 5
    assert positions.steps_in_sizes(means, scales) == pytest.approx(0.5 / 0.03)
    means[0] = np.nan
    assert positions.steps_in_sizes(means, scales) == pytest.approx(0.5 / 0.03)
    assert positions.steps_in_sizes(means[:0], scales[:0]) == 0
    assert positions.offset_of(means[1:], scales[1:]) == (5e5, 5.4e6, 300.0)


def test_a_project_keeps_the_offset_that_it_was_made_with(tmp_path: Path) -> None:
    """Whatever the reader would choose: layers hold positions relative to it."""
    far_ball(tmp_path / "far.ply", count=50)
    for offset in ((0.0, 0.0, 0.0), (5e5, 5.4e6, 0.0)):
        splats = io.read(tmp_path / "far.ply", offset=offset)
        with Session(splats, tmp_path / "a.splatproj", overwrite=True):
            pass
        with Session.load(tmp_path / "a.splatproj") as session:
            assert session.original.offset == offset and np.array_equal(session.original.means, splats.means)


def test_regions_are_in_world_coordinates(tmp_path: Path) -> None:
    splats, truth = far_ball(tmp_path / "far.ply", count=500)
    x, y, z = UTM
    for words, inside in (
        (f"sphere={x},{y + 1},{z},0.5", np.linalg.norm(truth - (x, y + 1, z), axis=1) <= 0.5),
        (f"box={x},{y},{z},{x + 2},{y + 2},{z + 2}", (truth >= UTM).all(1)),
        (f"y={y}..", truth[:, 1] >= y),
    ):
        weights = Region.parse([words]).weights(splats)
        assert (weights > 0).sum() == inside.sum() > 10, words


def test_a_damaged_offset_of_a_project_is_refused(tmp_path: Path) -> None:
    splats, _ = far_ball(tmp_path / "far.ply", count=50)
    with Session(replace(splats, source=None, origin=None), tmp_path / "a.splatproj") as session:
        session._core.project.set_fact("offset", json.dumps([1, 2]))
    with pytest.raises(ValueError, match="offset of the original"):
        Session.load(tmp_path / "a.splatproj")
