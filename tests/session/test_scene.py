"""Several assets in one session: each in its own space with its own layers, one history, one project file, and exports
that are verified against each asset's own file."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.color import base_color
from splatpainter.io import read, write
from splatpainter.painter import Edit
from splatpainter.receipts import Receipt, verify
from splatpainter.rendering import render
from splatpainter.scene.merge import verify_merge
from splatpainter.scene.placement import Placement
from splatpainter.session import Session
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, SceneAsset, parse_assets
from splatpainter.splats import Splats
from tests.support.lift_scenes import disk, same_bits
from tests.support.session_scenes import BLUE, GREEN, RED, asset, dab, flat, load, print_of

RIGHT = Placement.of(move=(1.4, 0, 0), turn=(0, 0, 90), scale=0.5)
WIDE = look_at((0.7, 0, -4.5), (0.7, 0, 0), (0, -1, 0), width=64, height=64, fov=45)
"""A view of both."""


def has_color(splats: Splats, color: tuple[float, float, float]) -> np.ndarray:
    """[N] bool."""
    return np.all(np.abs(base_color(splats.sh) - np.array(color)) < 0.004, axis=1)


@pytest.fixture
def paths(tmp_path: Path) -> tuple[Path, Path]:
    """Two sheets, of SH degree 1 and 2."""
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    write(one, asset(10))
    write(two, asset(8, degree=2))
    return one, two


@pytest.fixture
def session(paths: tuple[Path, Path], tmp_path: Path) -> Iterator[Session]:
    with flat(paths[0], tmp_path / "scene.splatproj") as session:
        yield session


def both(session: Session, two: Path) -> SceneAsset:
    """The second asset beside the first, moved half into the view."""
    made = session.scene.add(two, placement=RIGHT)
    assert len(session.splats) == 164
    return made


def wide(color=RED, x: float = 32, y: float = 32, radius: float = 5) -> Edit:
    return dab(color, x, y, radius, WIDE)


def column(session: Session, asset: str) -> float:
    """Where the middle of an asset is in the wide view."""
    placed = session.scene.asset(asset).placement.points(session.scene.splats_of(asset).means)
    return float(WIDE.project(placed)[0][:, 0].mean())


def test_an_asset_stands_beside_what_is_there_and_undo_takes_it_away(session: Session, paths) -> None:
    before, added = print_of(session), session.scene.add(paths[1])
    assert [one.name for one in session.scene.assets] == ["one.ply", "two.ply"] and session.scene.assets[
        0
    ].id == MAIN_ASSET_ID
    rows = session.splats
    assert rows.means[100:, 0].min() > rows.means[:100, 0].max()
    assert rows.sh.shape == (164, 9, 3) and not rows.sh[:100, 4:].any()
    assert same_bits(replace(rows.take(np.arange(100)), sh=rows.sh[:100, :4]), read(paths[0]))
    assert same_bits(session.original, rows) and same_bits(session.opened, read(paths[0]))
    assert session.history[-1].label == "add asset two.ply"
    session.undo()
    assert print_of(session) == before and len(session.scene.assets) == 1
    session.redo()
    assert session.scene.asset(added.id) == added and same_bits(session.splats, rows)


def test_it_is_drawn_where_it_stands_and_moves(session: Session, paths) -> None:
    made = both(session, paths[1])
    alone = render(read(paths[1]), RIGHT.camera(WIDE)).alphas[0, ..., 0]
    apart = render(read(paths[0]), WIDE).alphas[0, ..., 0] < 1e-3
    assert (alone[apart] > 0.5).sum() > 50
    np.testing.assert_allclose(render(session.splats, WIDE).alphas[0, ..., 0][apart], alone[apart], atol=0.02)
    for k in range(3):  # one drag
        session.scene.set(made.id, placement=Placement.of(move=(1.4 + k, 0, 0)), gesture="drag")
    assert [step.label for step in session.history[1:]] == ["add asset two.ply", "move asset two.ply"]
    assert session.splats.means[100:, 0].min() > 2
    session.scene.set(made.id, visible=False)
    assert len(session.splats) == 100 and len(session.scene.assets) == 2
    session.scene.set(made.id, visible=True, name="Two")
    session.scene.set(MAIN_ASSET_ID, placement=Placement.of(move=(0, 5, 0)))
    assert session.splats.means[:100, 1].min() > 3
    session.scene.remove(made.id)
    assert len(session.scene.assets) == 1 and session.scene.assets[0].placement.move == (0, 5, 0)
    session.history.jump(0)
    assert len(session.splats) == 100 and len(session.layers) == 0


def test_paint_belongs_to_the_asset_under_it_and_goes_with_it(session: Session, paths) -> None:
    made = both(session, paths[1])
    x = column(session, made.id)
    layer = session.strokes.paint_new("Paint", [wide(RED, x, radius=3)])
    assert layer.asset == made.id and len(session.layers) == 1
    red = np.flatnonzero(has_color(session.splats, RED))
    assert len(red) and (red >= 100).all()
    before = session.scene.splats_of(made.id)
    session.scene.set(made.id, placement=Placement.of(move=(-1, 2, 3)))
    assert same_bits(session.scene.splats_of(made.id), before)
    np.testing.assert_array_equal(has_color(session.splats, RED).nonzero()[0], red)
    session.strokes.paint(layer.id, [replace_camera(session, made.id, GREEN)])
    assert len(session.layers.by_id(layer.id).strokes) == 2


def replace_camera(session: Session, asset: str, color) -> Edit:
    """A dab on the middle of an asset, seen from the front, wherever it stands."""
    means = session.scene.asset(asset).placement.points(session.scene.splats_of(asset).means)
    view = np.array(WIDE.world_to_camera)
    view[:3, 3] -= view[:3, :3] @ means.mean(0)
    return dab(color, 32, 32, 4, replace(WIDE, world_to_camera=view))


def test_a_stroke_over_both_goes_into_a_layer_of_each_in_one_step(session: Session, paths) -> None:
    made = both(session, paths[1])
    middle = (32 + column(session, made.id)) / 2
    layer = session.strokes.paint_new("Paint", [wide(RED, middle, radius=16)])
    assert sorted(one.asset for one in session.layers) == [MAIN_ASSET_ID, made.id]
    assert [len(one.strokes) for one in session.layers] == [1, 1] and len(session.history) == 3
    session.strokes.paint(layer.id, [wide(BLUE, middle, radius=10)])  # finds the other one again
    assert [len(one.strokes) for one in session.layers] == [2, 2]
    blue = has_color(session.splats, BLUE)
    count = len(session.original)
    assert blue[:100].any() and blue[100:count].any()
    session.undo()
    session.undo()
    assert not session.layers
    layer = session.layers.add("paint", [wide(GREEN, middle, radius=16)], name="Green")
    assert [one.name for one in session.layers] == ["Green", "Green"]
    assert session.layers.add("paint", [wide(RED, middle, radius=16)], asset=made.id).asset == made.id
    with pytest.raises(ValueError, match="no asset is under"):
        session.layers.add("paint", [wide(RED, 2, 2, 1)])
    session.layers.delete(layer.id)
    session.verify()


def test_selections_looks_and_hiding_reach_every_asset(session: Session, paths) -> None:
    made = both(session, paths[1])
    before = session.splats
    weights = (before.means[:, 1] > 0).astype(np.float32)
    session.layers.hide_selected(weights)
    assert [layer.asset for layer in session.layers] == [MAIN_ASSET_ID, made.id]
    np.testing.assert_array_equal(session.splats.opacities == 0, weights == 1)
    session.undo()
    session.layers.add("look", look="gain", settings={"gain": [0.5, 0.5, 0.5]}, asset=made.id)
    assert same_bits(session.splats.take(np.arange(100)), before.take(np.arange(100)))
    assert np.abs(session.splats.sh[100:] - before.sh[100:]).max() > 0.1
    session.selections.save("upper", weights)
    np.testing.assert_array_equal(session.selections.load("upper"), weights)
    stored = session._core.project.fact("selection upper")
    assert stored is not None
    assert len(session.layers.coverage()) == len(session.splats)
    assert session.layers.conflicts() == []


def test_a_look_within_a_selection_is_split(session: Session, paths) -> None:
    from splatpainter.io import files
    from splatpainter.session.selection.selection import Selection

    both(session, paths[1])
    before = session.splats
    weights = (before.means[:, 1] > 0.2).astype(np.float32)
    data = Selection.of(weights, before, session.original).to_png()
    look = {"look": "gain", "settings": {"gain": [0.5, 0.5, 0.5]}, "selection": files.sha256(data)}
    session.layers.add("look", **look, attached=[data])
    changed = (session.splats.sh != before.sh).any((1, 2))
    np.testing.assert_array_equal(changed, weights > 0)
    assert len(session.layers) == 2 and session.verify() == []


def test_the_project_keeps_everything(session: Session, paths, tmp_path: Path) -> None:
    made = both(session, paths[1])
    session.strokes.paint_new("Paint", [wide(RED, column(session, made.id), radius=3)])
    session.layers.add("paint", [dab(BLUE)])
    expected, layers = print_of(session), tuple(session.layers)
    session.close()
    paths[1].unlink()  # the project has its bytes
    with load(tmp_path / "scene.splatproj") as again:
        assert print_of(again) == expected and tuple(again.layers) == layers
        assert again.painter.calls == [] and again.verify() == []  # type: ignore[attr-defined]
        again.history.jump(0)
        assert len(again.splats) == 100
        again.history.jump(3)
        assert print_of(again) == expected
        again.history.jump(0)
        again.layers.add("paint", [dab(GREEN)])  # nothing has the second asset any more
        (count,) = again._core.project.rows("SELECT count(*) FROM original WHERE file LIKE '%/%'")[0]
        assert count == 0
        again.files.save_as(tmp_path / "copy.splatproj")
    with load(tmp_path / "copy.splatproj") as copy:
        assert len(copy.splats) == 101


def test_exports_are_verified_against_every_file(session: Session, paths, tmp_path: Path) -> None:
    made = both(session, paths[1])
    session.strokes.paint_new("Paint", [wide(RED, column(session, made.id), radius=3)])
    session.layers.add("paint", [dab(BLUE)])
    for suffix in (".ply", ".splat", ".glb"):
        out = tmp_path / f"scene{suffix}"
        _, verification = session.files.export(out)
        assert verification.ok and verification.appended == 2
        text = out.with_name(out.name + ".receipt.json").read_text(encoding="utf-8")
        outcome = verify_merge(out, paths, Receipt.from_json(text))
        assert outcome.ok and all(0 < one.changed < one.rows / 2 for one in outcome.ranges), outcome
        assert outcome.ranges[0].how == ("bytes" if suffix == ".ply" else "values")
    scene = read(tmp_path / "scene.ply")
    assert len(scene) == 166 and np.abs(scene.means - session.splats.means).max() < 1e-6
    for key, path in ((MAIN_ASSET_ID, paths[0]), (made.id, paths[1])):
        out = tmp_path / f"alone{key}.ply"
        _, verification = session.files.export(out, asset=key)
        receipt = Receipt.from_json(out.with_name(out.name + ".receipt.json").read_text(encoding="utf-8"))
        assert verification.ok and verify(path, out, receipt).ok and receipt.appended_rows == 1
    with pytest.raises(ValueError, match="one asset at a time"):
        session.files.export(tmp_path / "less.ply", remove_hidden=True)
    with pytest.raises(ValueError, match="asset: expected one of"):
        session.files.export(tmp_path / "less.ply", asset="77")


def test_an_asset_of_no_file_takes_others_too(paths, tmp_path: Path) -> None:
    with flat(asset(6), tmp_path / "rows.splatproj") as session:
        session.scene.add(paths[1], placement=RIGHT)
        receipt, verification = session.files.export(tmp_path / "scene.ply")
        assert verification.ok and receipt.merge is not None
        assert [one["format"] for one in receipt.merge["sources"]] == ["rows", "ply"]
        expected = print_of(session)
    with load(tmp_path / "rows.splatproj") as again:
        assert print_of(again) == expected and again.verify() == []


def test_colours_are_matched_at_the_seam_by_a_layer(tmp_path: Path) -> None:
    left, right = asset(24), asset(24)
    for name, splats in (("left", left), ("right", replace(right, sh=right.sh * np.float32(0.7) - np.float32(0.4)))):
        write(tmp_path / f"{name}.ply", splats)
    with flat(tmp_path / "left.ply") as session:
        made = session.scene.add(tmp_path / "right.ply", placement=Placement.of(move=(0.05, 0, 0.02)))
        before = session.splats
        layer = session.scene.match_seam(made.id)
        assert layer.name == "Match seam" and layer.asset == made.id
        error = [np.abs(rows.sh[576:, 0] - left.sh[:, 0]).mean() for rows in (before, session.splats)]
        assert error[1] < 0.4 * error[0]
        session.layers.set(layer.id, visible=False)
        assert same_bits(session.splats, before)
        session.scene.set(made.id, placement=Placement.of(move=(1.9, 0, 0.02)))
        faded = session.scene.match_seam(made.id, to=MAIN_ASSET_ID, falloff=0.3)
        far = session.splats.means[:, 0] > 1.6
        assert far.any() and same_bits(session.splats.take(far), replace(before, means=session.splats.means).take(far))
        assert faded.operation.blobs() and session.verify() == []
        session.scene.set(made.id, placement=Placement.of(move=(90, 0, 0)))
        with pytest.raises(ValueError, match="not near to each other"):
            session.scene.match_seam(made.id)


def test_bad_input_is_refused_with_nothing_changed(session: Session, paths, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected it and another one visible"):
        session.scene.match_seam(MAIN_ASSET_ID)
    with pytest.raises(ValueError, match="is the only one that is visible"):
        session.scene.set(MAIN_ASSET_ID, visible=False)
    with pytest.raises(ValueError, match="is the one that was opened"):
        session.scene.remove(MAIN_ASSET_ID)
    made = both(session, paths[1])
    steps = len(session.history)
    nowhere = tmp_path / "nan.ply"
    write(nowhere, replace(asset(4), means=np.full((16, 3), np.nan, np.float32)))
    write(tmp_path / "linear.ply", replace(asset(4), color_space="linear"))
    write(tmp_path / "far.ply", replace(asset(4), means=asset(4).means * np.float32(5e14)))
    for path, reason in (
        (nowhere, "can be drawn"),
        (tmp_path / "linear.ply", "convert it first"),
        (tmp_path / "missing.ply", "no such file"),
        (asset(4), "read from a file"),
    ):
        with pytest.raises(ValueError, match=reason):
            session.scene.add(path)
    with pytest.raises(ValueError, match="out of what can be drawn"):
        session.scene.add(tmp_path / "far.ply", placement=Placement.of(scale=1000))
    for values in ({}, {"file": "x"}, {"name": ""}, {"name": "a\nb"}):
        with pytest.raises(ValueError, match="asset"):
            session.scene.set(made.id, **values)
    with pytest.raises(ValueError, match="asset: expected one of"):
        session.scene.set("9", name="Nine")
    assert len(session.history) == steps and session.verify() == []


@pytest.mark.parametrize("change", [{"id": 5}, {"sha256": "../x"}, {"placement": {}}, {"visible": 1}, {"frame": "xyz"}])
def test_damaged_assets_of_a_project_are_refused(session: Session, paths, tmp_path: Path, change: dict) -> None:
    both(session, paths[1])
    records = [one.record() for one in session.scene.assets]
    assert parse_assets(records) == session.scene.assets
    session.close()
    records[1].update(change)
    database = sqlite3.connect(tmp_path / "scene.splatproj")
    database.execute("UPDATE steps SET assets = ? WHERE assets IS NOT NULL", (json.dumps(records),))
    database.commit()
    database.close()
    with pytest.raises(ValueError, match=r"damaged project file \(.*asset"):
        load(tmp_path / "scene.splatproj")


def test_masks_of_a_layer_are_in_its_own_space(session: Session, paths) -> None:
    made = both(session, paths[1])
    x, before = column(session, made.id), base_color(session.scene.splats_of(made.id).sh)

    def painted() -> int:
        now = base_color(session.scene.splats_of(made.id).sh)[: len(before)]
        return int((np.abs(now - before).max(1) > 0.05).sum())

    layer = session.layers.add("paint", [wide(RED, x, radius=7)], asset=made.id)
    everything = painted()
    session.masks.set_area(layer.id, WIDE, disk(WIDE, x, 32, 4).astype(np.float32))
    session.scene.set(made.id, placement=Placement.of(move=(0, 0, 5)))
    assert 0 < painted() < everything
