"""Assets at world coordinates that float32 cannot hold, several in one file: where they are, byte for byte."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter import io
from splatpainter.scene.merge import merge, parts_of, verify_merge
from splatpainter.scene.placement import Placement, scene_offset
from tests.support.cli_scenes import ball, run, saved
from tests.support.far_assets import UTM, doubles_of, far_ply, moved_camera

EAST = (UTM[0] + 3.0, UTM[1], UTM[2])
COUNT = 400


@pytest.fixture
def tiles(tmp_path: Path) -> tuple[Path, Path, np.ndarray]:
    """Two neighbouring tiles of a survey, and the [2 * COUNT, 3] positions in their files."""
    west, east = tmp_path / "west.ply", tmp_path / "east.ply"
    first = far_ply(west, ball(COUNT, degree=0))
    second = far_ply(east, ball(COUNT, degree=0), EAST)
    return west, east, np.concatenate([first, second])


def test_tiles_of_a_survey_keep_every_byte(tiles: tuple[Path, Path, np.ndarray], tmp_path: Path) -> None:
    west, east, positions = tiles
    receipt = merge([west, east], tmp_path / "both.ply")
    assert (doubles_of(tmp_path / "both.ply", 2 * COUNT).ravel() == positions.ravel()).all()
    assert receipt.merge is not None
    assert [(one["how"], one["exact_rows"]) for one in receipt.merge["sources"]] == [("bytes", COUNT)] * 2
    assert receipt.touched.size == 0 and receipt.untouched_sha256_before == receipt.untouched_sha256_after
    assert verify_merge(tmp_path / "both.ply", [east, west], receipt).ok
    changed = bytearray((tmp_path / "both.ply").read_bytes())
    changed[-60 * 3] ^= 1  # a low bit of a double that float32 would not show
    (tmp_path / "both.ply").write_bytes(changed)
    assert not verify_merge(tmp_path / "both.ply", [east, west], receipt).ok


def test_it_looks_as_the_same_assets_near_zero(tiles: tuple[Path, Path, np.ndarray], tmp_path: Path) -> None:
    west, east, _ = tiles
    placements = [None, Placement.of((0.0, 0.5, 0.0))]
    merge([west, east], tmp_path / "far.ply", transforms=placements)
    near = [Placement(), Placement.of((3.0, 0.5, 0.0))]
    merge([tmp_path / "near_west.ply", tmp_path / "near_east.ply"], tmp_path / "near.ply", transforms=near)
    camera = sp.look_at((1.5, -0.8, -6.0), (1.5, 0.0, 0.0), (0.0, -1.0, 0.0), width=96, height=64)
    expected = sp.render(sp.read(tmp_path / "near.ply"), camera).colors[0]
    picture = sp.render(sp.read(tmp_path / "far.ply"), moved_camera(camera, UTM)).colors[0]
    assert expected.std() > 0.05 and abs(picture - expected).max() < 2 / 255


@pytest.mark.parametrize(("suffix", "exact"), [("glb", True), ("ply", True), ("spz", False), ("sog", False)])
def test_what_a_format_cannot_hold_of_them_is_said(
    suffix: str, exact: bool, tiles: tuple[Path, Path, np.ndarray], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    west, east, positions = tiles
    target = tmp_path / f"both.{suffix}"
    note = run(capfd, "merge", west, east, "--out", target, "--json").json["receipt"]["note"]
    error = abs(io.read(target).world_means - positions).max()
    assert error < 1e-6 if exact else (error > 0.02 and "sizes of a Gaussian" in note)
    assert run(capfd, "verify", target, "--against", west, east).code == 0


def test_a_small_asset_stands_where_its_transform_says(
    tiles: tuple[Path, Path, np.ndarray], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """At a place that float32 cannot hold, scaled and turned about its own origin."""
    west, _, positions = tiles
    tree = saved(tmp_path / "tree.ply", ball(200, radius=0.2, degree=1))
    move = f"move={UTM[0] + 0.25},{UTM[1] + 1.5},{UTM[2] + 0.125}:turn=0,30,0:scale=0.5"
    assert run(capfd, "merge", west, tree, "--transform", "none", move, "--out", tmp_path / "site.ply").code == 0
    stored = doubles_of(tmp_path / "site.ply", COUNT + 200)
    near = Placement.of((0.25, 1.5, 0.125), (0.0, 30.0, 0.0), 0.5).apply(io.read(tree)).means
    assert (stored[:COUNT] == positions[:COUNT]).all()
    assert abs(stored[COUNT:] - np.array(UTM) - near).max() < 1e-6
    assert run(capfd, "verify", tmp_path / "site.ply", "--against", west, tree).code == 0
    assert "tree.ply: lies (" in run(capfd, "merge", west, tree, "--out", tmp_path / "no.ply").error
    assert not (tmp_path / "no.ply").exists()


def test_from_another_place_of_the_world_it_is_set_beside(
    tiles: tuple[Path, Path, np.ndarray], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    west, *_ = tiles
    tree = saved(tmp_path / "tree.ply", ball(200, degree=0))
    for first, second in ((west, tree), (tree, west)):
        assert (
            run(capfd, "merge", first, second, "--side-by-side", "--out", tmp_path / "b.ply", "--overwrite").code == 0
        )
        joined, lead = io.read(tmp_path / "b.ply").world_means, io.read(first).world_means
        assert (joined[: len(lead)] == lead).all()
        apart = np.median(joined[len(lead) :], 0) - np.median(lead, 0)
        assert 1.8 < apart[0] < 3 and abs(apart[1:]).max() < 0.5


def test_colours_are_matched_at_their_seam(tmp_path: Path) -> None:
    one, two = ball(COUNT, degree=0), ball(COUNT, degree=0)
    far_ply(tmp_path / "a.ply", one)
    far_ply(
        tmp_path / "b.ply",
        replace(two, means=two.means - np.array([38.6, 0, 0], np.float32)),
        (UTM[0] + 40.0, *UTM[1:]),
    )
    far = parts_of([io.read(tmp_path / "a.ply"), io.read(tmp_path / "b.ply")], seam=True, seam_falloff=0.5)
    near = [io.read(tmp_path / "near_a.ply"), io.read(tmp_path / "near_b.ply")]
    near[1] = replace(near[1], means=two.means + np.array([1.4, 0, 0], np.float32))
    assert far[0].splats.offset != far[1].splats.offset
    expected = parts_of(near, seam=True, seam_falloff=0.5)[1].seam
    assert far[1].seam is not None and expected is not None
    np.testing.assert_allclose(far[1].seam.gain, expected.gain, rtol=1e-3)
    assert abs(far[1].seam.pairs - expected.pairs) <= 2


def test_floats_before_doubles_become_doubles(tiles: tuple[Path, Path, np.ndarray], tmp_path: Path) -> None:
    """A tile whose floats are rounded already, then one of doubles."""
    west, east, positions = tiles
    columns = np.fromfile(tmp_path / "near_west.ply", np.uint8)
    head, body = columns.tobytes().split(b"end_header\n", 1)
    rows = np.frombuffer(body, "<f4").reshape(COUNT, -1).copy()
    rows[:, :3] = positions[:COUNT]
    (tmp_path / "floats.ply").write_bytes(head + b"end_header\n" + rows.tobytes())
    receipt = merge([tmp_path / "floats.ply", east], tmp_path / "both.ply")
    stored = doubles_of(tmp_path / "both.ply", 2 * COUNT)
    assert (stored[:COUNT] == rows[:, :3]).all() and (stored[COUNT:] == positions[COUNT:]).all()
    assert verify_merge(tmp_path / "both.ply", [tmp_path / "floats.ply", east], receipt).ok


def test_an_offset_for_all_is_chosen_only_where_one_is_needed(tmp_path: Path) -> None:
    near = ball(COUNT)
    assert scene_offset([(near, Placement()), (near, Placement.of((50.0, 0.0, 0.0)))]) == (0, 0, 0)
    offset = scene_offset([(near, Placement.of((4e6, 5e5, 4.9e6))), (near, Placement.of((4e6 + 3, 5e5, 4.9e6)))])
    assert np.linalg.norm(np.array(offset) - (4e6, 5e5, 4.9e6)) < 8


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (20.0, -40.0, 75.0)])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_placement_is_of_world_coordinates(turn: tuple[float, float, float], scale: float, tmp_path: Path) -> None:
    """Between offsets, and a camera's way back: against plain float64 arithmetic."""
    far_ply(tmp_path / "a.ply", ball(COUNT, degree=0))
    splats = io.read(tmp_path / "a.ply")
    placement = Placement.of((10.0, -20.0, 5.0), turn, scale)
    world = scale * splats.world_means @ placement.matrix.T + np.array(placement.move)
    scene = tuple(np.round(world[0]).tolist())
    placed = placement.apply(splats, scene)
    assert placed.offset == scene and abs(placed.world_means - world).max() < 1e-6
    back = placement.between(splats.offset, scene).in_world(splats.offset, scene)
    np.testing.assert_allclose(back.move, placement.move, atol=1e-8)
    center = np.median(placed.world_means, 0)
    camera = sp.look_at(
        tuple(center + (0, 0, -5 * scale)), tuple(center), (0.0, -1.0, 0.0), width=64, height=64
    ).relative_to(scene)
    inside = placement.camera(camera, splats.offset)
    assert inside.offset == splats.offset
    pixels, depth = camera.project(placed.means)
    inside_pixels, inside_depth = inside.project(splats.means)
    np.testing.assert_allclose(inside_pixels, pixels, atol=1e-3)
    np.testing.assert_allclose(inside_depth * scale, depth, rtol=1e-5)
