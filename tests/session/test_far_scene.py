"""Several assets in one session at world coordinates that float32 cannot hold: seen, painted, moved and exported as
the same assets near zero are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.io import read, write
from splatpainter.rendering import render
from splatpainter.scene.merge import verify_merge
from splatpainter.scene.placement import Placement
from splatpainter.session import Session
from tests.session.test_scene import WIDE, has_color, wide
from tests.support.far_assets import UTM, doubles_of, far_ply, moved_camera
from tests.support.session_scenes import GREEN, RED, asset, flat

EAST = (UTM[0] + 1.5, UTM[1], UTM[2])


def scenes(folder: Path) -> tuple[Session, Session]:
    """Two tiles of a survey in one session, and the same two near zero in another."""
    far_ply(folder / "west.ply", asset(10, degree=0))
    far_ply(folder / "east.ply", asset(8, degree=0), EAST)
    far, near = flat(folder / "west.ply", folder / "far.splatproj"), flat(folder / "near_west.ply")
    far.scene.add(folder / "east.ply", placement=Placement())
    near.scene.add(folder / "near_east.ply", placement=Placement.of((1.5, 0.0, 0.0)))
    return far, near


def test_tiles_are_seen_and_painted_where_they_are(tmp_path: Path) -> None:
    far, near = scenes(tmp_path)
    with far, near:
        for x, color in ((32, RED), (20, GREEN), (46, GREEN)):
            edit = wide(color, x)
            near.layers.add("paint", [edit])
            far.layers.add("paint", [replace(edit, camera=moved_camera(edit.camera, UTM))])
        assert [layer.asset for layer in far.layers] == [layer.asset for layer in near.layers]
        assert {layer.asset for layer in far.layers} == {one.id for one in far.scene.assets}
        seen = render(far.splats, moved_camera(WIDE, UTM)).colors[0]
        assert abs(seen - render(near.splats, WIDE).colors[0]).max() < 2 / 255
        for color in (RED, GREEN):
            assert (has_color(far.splats, color) == has_color(near.splats, color)).all()
            assert has_color(far.splats, color).any()
        made = far.scene.set(far.scene.assets[1].id, placement=Placement.of((0.5, 0.0, 0.0)))
        assert abs(far.splats.world_means[100:164] - read(tmp_path / "east.ply").world_means - (0.5, 0, 0)).max() < 1e-6
        with pytest.raises(ValueError, match="east.ply: lies"):
            far.scene.set(made.id, placement=Placement.of((4e6, 0.0, 0.0)))


def test_one_tile_alone_is_painted_where_it_is(tmp_path: Path) -> None:
    far_ply(tmp_path / "west.ply", asset(10, degree=0))
    with flat(tmp_path / "west.ply") as far, flat(tmp_path / "near_west.ply") as near:
        edit = wide(RED, 32)
        near.layers.add("paint", [edit])
        far.layers.add("paint", [replace(edit, camera=moved_camera(edit.camera, UTM))])
        painted = has_color(near.splats, RED)
        assert painted.any() and (has_color(far.splats, RED) == painted).all()


def test_exports_keep_the_doubles_of_every_tile(tmp_path: Path) -> None:
    far, near = scenes(tmp_path)
    with far, near:
        far.layers.add("paint", [replace(wide(RED), camera=moved_camera(WIDE, UTM))])
        receipt, _ = far.files.export(tmp_path / "scene.ply")
        lost = far.files.export(tmp_path / "scene.spz")[1].lost
    assert "sizes of a Gaussian" in lost
    stored = doubles_of(tmp_path / "scene.ply", 164)
    files = np.concatenate(
        [doubles_of(tmp_path / name, count) for name, count in (("west.ply", 100), ("east.ply", 64))]
    )
    same = (stored == files).all(1)
    assert same.sum() > 150
    assert verify_merge(tmp_path / "scene.ply", [tmp_path / "west.ply", tmp_path / "east.ply"], receipt).ok


def test_a_project_of_them_opens_as_it_was(tmp_path: Path) -> None:
    far, near = scenes(tmp_path)
    with far, near:
        before, offset = far.splats, far.scene.original_of(far.scene.assets[1].id).offset
        assert any(offset)
    with flat(tmp_path / "far.splatproj") as again:
        assert again.splats.offset == before.offset and (again.splats.means == before.means).all()
        assert again.scene.original_of(again.scene.assets[1].id).offset == offset


@pytest.mark.parametrize("far_first", [True, False])
def test_an_asset_of_another_place_comes_beside(far_first: bool, tmp_path: Path) -> None:
    far_ply(tmp_path / "far.ply", asset(10, degree=0))
    write(tmp_path / "near.ply", asset(8, degree=0))
    first, second = ("far.ply", "near.ply") if far_first else ("near.ply", "far.ply")
    with flat(tmp_path / first) as session:
        added = session.scene.add(tmp_path / second)
        means, count = session.splats.means, len(session.opened)
        assert session.splats.offset == session.opened.offset
        assert means[count:, 0].min() > means[:count, 0].max() and abs(means).max() < 10
        session.scene.remove(added.id)
        with pytest.raises(ValueError, match=f"{second}: lies"):
            session.scene.add(tmp_path / second, placement=Placement())
        assert len(session.scene.assets) == 1
