"""Layers of mode spread: the threshold is a parameter, replay is exact, what was painted and what was predicted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatpainter.painter import Edit, Painter
from splatpainter.session import Session
from splatpainter.session.replay.conflicts import ORIGINAL, PREDICTED, SEEN
from splatpainter.splats import rows_sha256
from tests.support.lift_scenes import differing
from tests.support.spread_scenes import CAMERA, SIDE, board, left_half, painted_picture

SPLATS = board()
BACK = np.arange(len(SPLATS)) >= SIDE**2
LEFT = SPLATS.means[:, 0] < -0.1


def edit() -> Edit:
    return Edit(painted_picture(SPLATS), CAMERA, left_half(), "green")


def changed_behind(session: Session) -> int:
    return int(differing(SPLATS, session.splats)[BACK].sum())


def test_another_threshold_solves_the_layer_again_and_undo_is_exact(tmp_path: Path) -> None:
    with Session(SPLATS, tmp_path / "one.splatproj", painter=Painter()) as session:
        layer = session.layers.add("paint", [edit()], mode="spread")
        assert layer.operation.spread_threshold == 0.5 and session.layers.facts(layer.id)["method"] == "lift"  # pyright: ignore[reportAttributeAccessIssue]
        counts, prints = [changed_behind(session)], [rows_sha256(session.splats)]
        assert counts[0] > 0.95 * (LEFT & BACK).sum()
        session.layers.set(layer.id, spread_threshold=1.0)
        assert changed_behind(session) == 0
        session.undo()
        assert rows_sha256(session.splats) == prints[0]
        session.redo()
        session.layers.set(layer.id, spread_threshold=0.02)
        assert changed_behind(session) > counts[0]
        session.layers.set(layer.id, visible=False)
        assert not differing(SPLATS, session.splats).any()
        assert session.verify(repaint=True) == []
    with Session.load(tmp_path / "one.splatproj", painter=Painter()) as session:
        assert session.layers.by_id(layer.id).operation.spread_threshold == 0.02 and session.verify(repaint=True) == []  # pyright: ignore[reportAttributeAccessIssue]


def test_coverage_tells_painted_from_predicted() -> None:
    with Session(SPLATS, painter=Painter()) as session:
        session.layers.add("picture", [edit()], mode="spread")
        kinds = session.layers.coverage()
        assert (kinds[: len(SPLATS)][LEFT & BACK] == PREDICTED).mean() > 0.95
        assert (kinds[len(SPLATS) :] == SEEN).all()
        assert (kinds[: len(SPLATS)][BACK & (SPLATS.means[:, 0] > 0.2)] == ORIGINAL).all()
        assert not session.layers.conflicts()


def test_opacity_mixes_all_of_it() -> None:
    with Session(SPLATS, painter=Painter()) as session:
        layer = session.layers.add("paint", [edit()], mode="spread")
        full = session.splats.sh[: len(SPLATS)][LEFT & BACK].astype(np.float64)
        session.layers.set(layer.id, opacity=0.5)
        half = session.splats.sh[: len(SPLATS)][LEFT & BACK]
        np.testing.assert_allclose(half, (full + SPLATS.sh[LEFT & BACK]) / 2, atol=1e-5)


def test_what_a_spread_layer_cannot_be() -> None:
    with Session(SPLATS, painter=Painter()) as session:
        with pytest.raises(ValueError, match="expected kind paint or picture with mode spread, got clone"):
            session.layers.add("clone", [edit()], mode="spread")
        for bad, reason in (
            ("x", "expected float as 'spread_threshold', got 'x'"),
            (2, "expected spread_threshold from 0 to 1"),
        ):
            with pytest.raises(ValueError, match=reason):
                session.layers.add("paint", [edit()], mode="spread", spread_threshold=bad)
        layer = session.layers.add("paint", [edit()], mode="spread", angle_limit=40)
        with pytest.raises(ValueError, match="expected spread_threshold from 0 to 1, got -1"):
            session.layers.set(layer.id, spread_threshold=-1)
        with pytest.raises(ValueError, match="takes no strokes"):
            session.strokes.paint(layer.id, [edit()])
