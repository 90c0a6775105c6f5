"""Layers above a change are moved where they read nothing of it, and painted anew where they did: both bit for bit what
a session makes that paints everything."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import Camera, look_at
from splatpainter.painter import Edit, Painter
from splatpainter.session import Session
from splatpainter.session.replay.delta import Delta
from splatpainter.session.replay.read_set import ReadSet, read_set_of, renumber
from splatpainter.splats import Splats
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import disk, same_bits, sheet
from tests.support.session_scenes import BLUE, GREEN, RED

SIZE = 160
CAMERA = look_at((0, 0, 2.6), (0, 0, 0), width=SIZE, height=SIZE, fov=42)


def dab(color: tuple[float, float, float], x: float, y: float, radius: float = 9, camera: Camera = CAMERA) -> Edit:
    image = np.broadcast_to(np.array(color, np.float32), (camera.height, camera.width, 3)).copy()
    return Edit(image, camera, disk(camera, x, y, radius))


def ground() -> Splats:
    """Rows so fine that no dab's rows reach into another one's tiles."""
    return sheet(40, degree=1, opacity=0.95)


def counted(session: Session) -> list[str]:
    """Names of the layers that are painted from now on."""
    names: list[str] = []
    compute = session._core.replay.main._result

    def noted(below, layer, *rest):
        names.append(layer.name)
        return compute(below, layer, *rest)

    session._core.replay.main._result = noted  # type: ignore[method-assign]
    return names


def painted_anew(session: Session) -> Splats:
    """What another session, which has no results, makes of the same original and layers."""
    with Session(session.original, painter=Painter.load("lift")) as other:
        for layer in session.layers:
            replay = session._core.replay.main
            edits = [replace(replay.edit_of(view, layer), mask=replay.mask(view)) for view in layer.views]
            made = other.layers.add(layer.operation, edits)
            other.layers.set(made.id, opacity=layer.opacity, blend=layer.blend)
            other.layers.set(made.id, visible=layer.visible)
        names = [layer.id for layer in other.layers]
        assert len(names) == len(session.layers)
        return other.splats


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A project of `four`, to be copied."""
    path = tmp_path_factory.mktemp("four") / "four.splatproj"
    session, ids = four()
    with session:
        session.files.save_as(path)
    return path, ids


def four() -> tuple[Session, dict[str, str]]:
    """Three dabs far from each other, and one over the first."""
    session = Session(ground(), painter=Painter.load("lift"))
    positions = {"a": (30, 30, RED), "b": (130, 32, BLUE), "c": (126, 128, GREEN), "over a": (34, 34, BLUE)}
    ids = {
        name: session.layers.add("paint", [dab(color, x, y)], name=name).id for name, (x, y, color) in positions.items()
    }
    assert len(session.splats) > len(session.original) + 20
    return session, ids


@pytest.mark.parametrize(
    ("change", "again"),
    [
        (lambda s, i: s.layers.set(i["a"], visible=False), ["over a"]),
        (lambda s, i: s.layers.set(i["a"], opacity=0.4), ["over a"]),
        (lambda s, i: s.layers.set(i["a"], blend="color"), ["over a"]),
        (lambda s, i: s.layers.set(i["b"], visible=False), []),
        (lambda s, i: s.layers.move(i["b"], 3), []),
        (lambda s, i: s.layers.move(i["b"], 2), []),
        (lambda s, i: s.layers.move(i["a"], 3), ["over a", "a"]),
        (lambda s, i: s.layers.delete(i["c"]), []),
        (lambda s, i: s.layers.merge([i["b"], i["c"]]), []),
    ],
    ids=["hide", "opacity", "blend", "hide aside", "top", "within", "over", "delete", "merge"],
)
def test_only_what_read_something_else_is_painted_again(change, again, project, tmp_path) -> None:
    path, ids = project
    shutil.copy(path, tmp_path)
    with Session.load(tmp_path / path.name, painter=Painter.load("lift"), readonly=False) as session:
        names = counted(session)
        change(session, ids)
        assert names == again
        if not any(layer.layers for layer in session.layers):
            assert same_bits(session.splats, painted_anew(session))
        assert session.verify(repaint=True) == []


def test_again_and_again_after_the_project_was_closed(tmp_path) -> None:
    session, ids = four()
    with session:
        session.files.save_as(tmp_path / "own.splatproj")
    with Session.load(tmp_path / "own.splatproj", painter=Painter.load("lift")) as session:
        names = counted(session)
        all_layers = session.splats
        session.layers.set(ids["b"], visible=False)
        session.layers.set(ids["c"], visible=False)
        session.layers.set(ids["b"], visible=True)
        assert names == [] and same_bits(session.splats, painted_anew(session))
        session.layers.set(ids["c"], visible=True)
        assert same_bits(session.splats, all_layers) and session.verify(repaint=True) == []


def test_conflicts_name_the_rows_where_they_are_now() -> None:
    side = look_at((1.2, 0, 2.3), (0, 0, 0), width=SIZE, height=SIZE, fov=42)
    with Session(ground(), painter=Painter.load("lift")) as session:
        low = session.layers.add("paint", [dab(RED, 30, 30)])
        session.layers.add("paint", [dab(BLUE, 110, 116)])
        session.layers.add("paint", [dab(GREEN, 108, 116, camera=side)])
        names = counted(session)
        before, composed = session.layers.conflicts(), session.splats
        session.layers.set(low.id, visible=False)
        assert names == [] and len(before) == 1
        (now,) = session.layers.conflicts()
        assert now.share == before[0].share and len(now.gaussian_ids) == len(before[0].gaussian_ids) > 0
        assert session.verify(repaint=True) == []
        assert same_bits(session.splats.take(now.gaussian_ids), composed.take(before[0].gaussian_ids))
        assert (now.gaussian_ids != before[0].gaussian_ids).any()


def test_what_a_lift_reads_holds_all_that_it_writes() -> None:
    splats = ground()
    edit = dab(RED, 30, 40)
    assert edit.mask is not None
    read = read_set_of(splats, lambda: voxelize(splats), CAMERA, edit.mask, len(splats))
    assert read is not None and 0 < len(read.gaussian_ids) < len(splats) / 2
    painter = Painter.load("lift")
    done = painter.apply(painter.encode(splats), [edit])
    assert done.receipt is not None and np.isin(done.receipt.touched, read.gaussian_ids).all()
    elsewhere = replace(splats, sh=splats.sh.copy())
    elsewhere.sh[np.setdiff1d(np.arange(len(splats)), read.gaussian_ids)] += 0.3
    again = painter.apply(painter.encode(elsewhere), [edit])
    changed = np.append(done.receipt.touched, np.arange(len(splats), len(done.splats)))
    assert same_bits(done.splats.take(changed), again.splats.take(changed))
    here = replace(splats, sh=splats.sh.copy())
    here.sh[read.gaussian_ids[0]] += 1e-3
    other = read_set_of(here, lambda: voxelize(here), CAMERA, edit.mask, len(here))
    assert other is not None and other.digest != read.digest
    fewer = read_set_of(splats, lambda: voxelize(splats), CAMERA, edit.mask, int(read.gaussian_ids[-1]))
    assert fewer is not None and fewer.digest != read.digest  # the last one's index is free for any sheet Gaussian
    nowhere = np.zeros((SIZE, SIZE), bool)
    nowhere[0, 0] = True
    aside = look_at((0, 0, 2.6), (1.6, 0, 0), width=SIZE, height=SIZE, fov=42)
    beside = read_set_of(splats, lambda: voxelize(splats), aside, nowhere[:, ::-1], len(splats))
    assert beside is None  # the sheet


def test_a_lift_whose_paint_is_half_sheet_and_half_split_reads_no_more() -> None:
    """Beside the sheet's smooth half lies a cloud without a surface."""
    rng = np.random.default_rng(5)
    splats = ground()
    cloud = np.flatnonzero((splats.means[:, 0] > -0.35) & (splats.means[:, 0] < 0.2))
    means, scales = splats.means.copy(), splats.scales.copy()
    means[cloud, 2] += rng.uniform(-0.4, 0.4, len(cloud)).astype(np.float32)
    scales[cloud] = 0.06
    splats = replace(splats, means=means, scales=scales)
    edit = dab(RED, 50, 80, 14)
    assert edit.mask is not None
    painter = Painter.load("lift")
    done = painter.apply(painter.encode(splats), [edit])
    assert done.receipt is not None
    assert 0 < len(done.receipt.replaced) < len(done.receipt.touched)
    read = read_set_of(splats, lambda: voxelize(splats), CAMERA, edit.mask, len(splats))
    assert read is not None and np.isin(done.receipt.touched, read.gaussian_ids).all()
    elsewhere = replace(splats, sh=splats.sh.copy())
    elsewhere.sh[np.setdiff1d(np.arange(len(splats)), read.gaussian_ids)] += 0.3
    start = replace(painter.encode(elsewhere), original=splats)  # the surface stays the original's
    again = painter.apply(start, [edit])
    changed = np.append(done.receipt.touched, np.arange(len(splats), len(done.splats)))
    assert same_bits(done.splats.take(changed), again.splats.take(changed))


def test_a_delta_moves_only_where_all_its_rows_do() -> None:
    rows, none = ground().take(np.arange(2)), ground().take(np.zeros(0, np.int64))
    delta = Delta(9, np.array([2, 5]), rows, rows, np.array([5, -1]))
    old, new = ReadSet(np.array([2, 3, 5], np.int32), "x"), ReadSet(np.array([0, 4, 7], np.int32), "x")
    result = renumber(delta, old, new, 8)
    assert result is not None and result.count == 8
    assert result.gaussian_ids.tolist() == [0, 7] and result.parent_ids.tolist() == [7, -1]
    assert renumber(replace(delta, gaussian_ids=np.array([2, 4])), old, new, 8) is None
    assert renumber(replace(delta, gaussian_ids=np.array([2, 9])), old, new, 8) is None
    assert renumber(Delta(9, np.zeros(0, np.int64), none, none, np.zeros(0, np.int64)), old, new, 8) is not None
