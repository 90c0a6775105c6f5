"""Layers whose paint is a sheet: painted again and again, undone, opened again, exported, and beside layers of older
projects, which have none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.painter import Edit, Painter
from splatpainter.session import Session
from splatpainter.splats import Splats
from tests.support.lift_scenes import disk, front, same_bits, sheet
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, SIZE, dab, print_of

"""A version 2 project, made before there were sheets."""
PX = 96


def scene() -> Splats:
    return sheet(24, degree=1, opacity=0.95)


def checks(k: int, camera: Camera) -> Edit:
    """Squares in the k-th pair of colours."""
    y, x = np.mgrid[:PX, :PX] // 5
    first, second = np.array([0.9 * (k % 2), 0.2 + 0.07 * k, 0.5]), np.array([0.9, 0.9, 0.1 * k])
    image = np.where(((x + y) % 2 > 0)[..., None], first, second).astype(np.float32)
    return Edit(image, camera, disk(camera, 48, 48, 16))


def around(k: int) -> Camera:
    a, b = 0.25 * math.sin(1.3 * k), 0.2 * math.cos(2.1 * k)
    eye = (3 * math.sin(a), 3 * math.sin(b), 3 * math.cos(a) * math.cos(b))
    return look_at(eye, (0, 0, 0), width=PX, height=PX, fov=42)


@pytest.mark.parametrize("views", ["the same view", "other views"])
def test_a_place_painted_ten_times_does_not_grow_ten_sheets(views) -> None:
    splats = scene()
    with Session(splats, painter=Painter.load("lift")) as session:
        appended, visible = [], []
        for k in range(10):
            session.layers.add("paint", [checks(k, front(PX) if views == "the same view" else around(k))])
            appended.append(len(session.splats) - len(splats))
            visible.append(int((session.splats.opacities > 0).sum()) - len(splats))
        assert appended[0] > 500
        limit = 1.3 if views == "the same view" else 1.8
        assert appended[-1] < limit * appended[0] and visible[-1] < 1.5 * visible[0]
        top = sp.render(session.splats, checks(9, around(9)).camera).colors[0]
        assert np.isfinite(top).all()


def layered(session: Session) -> None:
    first = session.layers.add("paint", [dab(RED, 14, radius=6)])
    session.layers.add("paint", [dab(BLUE, 19, radius=6)], opacity=0.5)
    session.layers.add("erase", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, disk(CAMERA, 12, 16, 5))])
    session.layers.add("paint", [dab(GREEN, 17, 21, radius=4)], blend="luminosity")
    session.layers.set(first.id, opacity=0.7)


def test_any_number_of_threads_gives_equal_bits(monkeypatch) -> None:
    prints = set()
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        with Session(scene(), painter=Painter.load("lift")) as session:
            layered(session)
            prints.add(print_of(session))
    assert len(prints) == 1


def test_undo_redo_and_opening_again_restore_the_bits(tmp_path) -> None:
    with Session(scene(), tmp_path / "a.splatproj", painter=Painter.load("lift")) as session:
        prints = [print_of(session)]
        layered(session)
        for _ in range(5):
            session.undo()
            prints.insert(1, print_of(session))
        assert prints[1] == prints[0] and same_bits(session.splats, session.original)
    with Session.load(tmp_path / "a.splatproj", painter=Painter.load("lift")) as session:
        for expected in prints[2:]:
            assert session.redo() and print_of(session) == expected
        assert session.redo() and not session.redo()
        assert session.verify() == [] and session.verify(repaint=True) == []


@pytest.mark.parametrize("ending", ["ply", "splat", "spz", "sog", "compressed.ply", "glb"])
def test_every_format_holds_emptied_rows_as_invisible(ending, tmp_path) -> None:
    splats = replace(scene(), sh=scene().sh[:, :1])
    start = tmp_path / f"start.{ending}"
    sp.write(start, splats)
    with Session(start, painter=Painter.load("lift")) as session:
        session.layers.add(
            "paint", [Edit(np.full((PX, PX, 3), 0.8, np.float32), front(PX), disk(front(PX), 48, 48, 26))]
        )
        emptied = np.flatnonzero((session.splats.opacities == 0)[: len(session.original)])
        assert len(emptied) > 5
        receipt, verification = session.files.export(tmp_path / f"out.{ending}")
        assert verification.ok, verification.problems
        np.testing.assert_array_equal(receipt.removed, emptied)
        assert len(receipt.replaced) > 5 and not np.isin(receipt.replaced, emptied).any()
        assert np.isin(receipt.replaced, receipt.touched).all()
        camera, drawn = front(PX), sp.render(session.splats, front(PX)).colors[0]
    written = sp.read(tmp_path / f"out.{ending}")
    assert (written.opacities[emptied] < 1 / 255).all()  # what every renderer leaves out
    stored = sp.Receipt.from_json((tmp_path / f"out.{ending}.receipt.json").read_text())
    assert sp.verify(start, tmp_path / f"out.{ending}", stored).ok
    np.testing.assert_array_equal(stored.removed, emptied)
    assert np.abs(sp.render(written, camera).colors[0] - drawn).mean() < 0.02
