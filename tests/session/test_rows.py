"""What layers do to rows: the eraser, looks, conflicts between layers, and coverage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import look_at
from splatpainter.painter import Edit
from splatpainter.session import Session
from splatpainter.session.replay.conflicts import MIN_COVERED_SHARE, MIN_STALE_SHARE
from tests.support.lift_scenes import db, differing, disk, same_bits, sheet
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, SIZE, dab, flat

SIDE = look_at((1.5, 0, 2.6), (0, 0, 0), width=SIZE, height=SIZE, fov=42)


# The eraser


@pytest.mark.parametrize("side", [10, 24])
def test_erasing_all_of_it_brings_the_original_back(side):
    with Session(sheet(side, degree=1, opacity=0.95)) as session:
        session.layers.add("paint", [dab(RED, radius=6)])
        session.layers.add("paint", [dab(BLUE, 18, radius=4)])
        rows = len(session.splats)
        assert rows > side * side
        session.layers.add("erase", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, disk(CAMERA, 16, 16, 14))])
        assert len(session.splats) == rows
        assert not differing(session.original, session.splats).any()
        assert (session.splats.opacities[side * side :] == 0).all()
        assert not session.layers.coverage().any()
        np.testing.assert_array_equal(
            sp.render(session.splats, CAMERA).colors, sp.render(session.original, CAMERA).colors
        )


def test_erasing_a_part_leaves_the_rest_and_no_holes():
    camera = CAMERA.resized(64, 64)
    with Session(sheet(12, degree=1, opacity=0.95)) as session:
        session.layers.add("paint", [dab(RED, 32, 32, 16, camera)])
        before = sp.render(session.splats, camera)
        painted, alpha = before.colors[0], before.alphas[0]
        left = disk(camera, 32, 32, 20)
        left[:, 32:] = False
        session.layers.add("erase", [Edit(np.zeros((64, 64, 3)), camera, left)])
        after = sp.render(session.splats, camera)
        original = sp.render(session.original, camera).colors[0]
        assert (after.alphas[0] > alpha - 0.1).all()
        inside, outside = disk(camera, 24, 32, 6), disk(camera, 42, 32, 6)
        gone = np.abs(after.colors[0] - original)[inside].mean() / np.abs(painted - original)[inside].mean()
        ratio = np.abs(after.colors[0] - painted)[outside].mean() / np.abs(painted - original)[outside].mean()
        assert gone < 0.1 and ratio < 0.1


def test_what_is_left_of_erased_paint_is_sharp_and_the_originals_stay_behind_it():
    """Fine paint on coarse Gaussians; half of it erased, then the other half."""
    camera = CAMERA.resized(128, 128)
    splats = sheet(30, degree=1, opacity=0.95)
    mask = np.zeros((128, 128), bool)
    mask[44:84, 30:98] = True
    y, x = np.mgrid[:128, :128] // 6
    picture = np.where(((x + y) % 2 > 0)[..., None], RED, (0.95, 0.9, 0.2)).astype(np.float32)
    left, right = disk(camera, 44, 64, 26), disk(camera, 84, 64, 50)
    with Session(splats) as session:
        session.layers.add("paint", [Edit(picture, camera, mask)])
        painted = session.splats
        session.layers.add("erase", [Edit(np.zeros((128, 128, 3)), camera, left)])
        half = session.splats
        original, paint, now = (sp.render(each, camera) for each in (splats, painted, half))
        assert (now.alphas > paint.alphas - 0.1).all()
        inner = left & disk(camera, 44, 64, 24)
        assert db(now.colors[0], original.colors[0], inner) > 34 and db(paint.colors[0], original.colors[0], inner) < 15
        rest = mask & ~disk(camera, 44, 64, 28)
        assert db(now.colors[0], paint.colors[0], rest) > 34
        side = look_at((1.3, 0.3, 2.5), (0, 0, 0), width=128, height=128, fov=42)
        assert (sp.render(half, side).alphas > sp.render(painted, side).alphas - 0.15).all()
        lost = [int(differing(splats, each)[: len(splats)].sum()) for each in (painted, half)]
        assert lost[1] < 0.8 * lost[0]
        session.layers.add("erase", [Edit(np.zeros((128, 128, 3)), camera, left | right)])
        assert same_bits(session.splats.take(np.arange(len(splats))), splats)
        assert (session.splats.opacities[len(splats) :] == 0).all()
        assert session.verify(repaint=True) == []


def test_erasing_can_be_partial_and_needs_a_mask():
    with Session(sheet(24, degree=1, opacity=0.95)) as session:
        session.layers.add("paint", [dab(RED, radius=6)])
        painted = session.splats
        layer = session.layers.add(
            "erase", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, disk(CAMERA, 16, 16, 14))], opacity=0.5
        )
        original, now = session.original, session.splats
        for name in ("means", "quats", "scales", "opacities"):
            assert getattr(now, name) is getattr(painted, name)  # nothing moves
        pictures = [sp.render(splats, CAMERA).colors[0] for splats in (original, painted, now)]
        inside = disk(CAMERA, 16, 16, 12)
        assert db(pictures[0], pictures[1], inside) < 20
        assert db(pictures[2], (pictures[0] + pictures[1]) / 2, inside) > 38
        rows = np.flatnonzero(differing(original, painted)[: len(original)])
        same_place = rows[(painted.scales[rows] == original.scales[rows]).all(1) & (painted.opacities[rows] > 0)]
        middle = (original.sh[same_place].astype(np.float64) + painted.sh[same_place]) / 2
        recolored = differing(painted, now)[same_place]
        np.testing.assert_allclose(now.sh[same_place][recolored], middle[recolored], atol=1e-6)
        session.layers.set(layer.id, opacity=1.0)
        assert same_bits(session.splats.take(np.arange(24 * 24)), original)
        session.layers.set(layer.id, visible=False)
        assert same_bits(session.splats, painted)
        with pytest.raises(ValueError, match="expected a mask for a view of kind erase"):
            session.layers.add("erase", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA)])
        with pytest.raises(ValueError, match="the mask is empty"):
            session.layers.add("erase", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, np.zeros((SIZE, SIZE), bool))])


# Looks, conflicts, coverage


def test_looks_are_functions_of_each_row():
    y0 = 0.28209479177387814
    with flat(adjustments={"grey": lambda sh, parameters: sh.mean(2, keepdims=True).repeat(3, 2)}) as session:
        old = session.splats
        layer = session.layers.add("look", look="gain", settings={"gain": [2, 1, 0.5], "offset": [0, 0.1, 0]})
        expected_colors = (0.5 + y0 * old.sh[:, 0].astype(np.float64)) * [2, 1, 0.5] + [0, 0.1, 0]
        np.testing.assert_allclose(0.5 + y0 * session.splats.sh[:, 0], expected_colors, atol=1e-6)
        np.testing.assert_allclose(session.splats.sh[:, 1:], old.sh[:, 1:] * [2, 1, 0.5], atol=1e-6)
        session.layers.set(layer.id, look="grey", settings={})
        np.testing.assert_allclose(session.splats.sh.std(2), 0, atol=1e-6)
        assert session._core.project.rows("SELECT count(*) FROM results") == [(0,)]
        for wrong in ({"look": "sepia"}, {"look": "gain", "settings": {"gain": [1, 2]}}):
            with pytest.raises(ValueError, match="^look: expected "):
                session.layers.add("look", **wrong)  # pyright: ignore[reportArgumentType]
        half = disk(CAMERA, 16, 16, 40)
        half[:, :16] = False
        session.layers.delete(layer.id)
        session.layers.add("look", [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, half)], look="grey")
        changed = differing(old, session.splats)
        assert changed[old.means[:, 0] > 0.2].all() and not changed[old.means[:, 0] < -0.2].any()


def test_regraded_pictures_can_stay_within_masks():
    half = disk(CAMERA, 16, 16, 40)
    half[:, :16] = False
    redder = Edit(np.broadcast_to(np.array(RED, np.float32), (SIZE, SIZE, 3)), CAMERA, half)
    with Session(sheet(16, degree=1, opacity=0.95)) as session:
        old = session.splats
        look = session.layers.add("look", [redder])
        everywhere = session.splats
        assert differing(old, everywhere).mean() > 0.9
        session.layers.set(look.id, visible=False)
        within = session.layers.add("look", [redder], within=True)
        changed = differing(old, session.splats)
        assert changed[old.means[:, 0] > 0.2].all() and not changed[old.means[:, 0] < -0.2].any()
        assert same_bits(session.splats.take(np.flatnonzero(changed)), everywhere.take(np.flatnonzero(changed)))
        assert within.operation.needs_masks is False and session.layers.coverage()[~changed].max() == 0
        assert session.verify(repaint=True) == []
        with pytest.raises(ValueError, match="expected a mask in one of its views to stay within"):
            session.layers.add("look", [replace(redder, mask=None)], within=True)


def conflicting(policy: Any) -> tuple[Session, str, str]:
    session = flat()
    a = session.layers.add("paint", [dab(RED)])
    b = session.layers.add("paint", [dab(BLUE, 20, camera=SIDE)])
    if policy:
        session.layers.resolve_conflict(a.id, b.id, policy)
    return session, a.id, b.id


def test_conflicts_are_reported():
    session, a, b = conflicting(None)
    with session:
        (conflict,) = session.layers.conflicts()
        below = session._core.replay.compose(replace(session.snapshot.document, layers=session.layers[:1])).splats
        first = np.flatnonzero(differing(session.original, below))
        second = np.flatnonzero(differing(below, session.splats))
        expected = np.intersect1d(np.append(first, 100), second)
        assert (conflict.lower, conflict.upper, conflict.policy, conflict.winner) == (a, b, "latest", b)
        np.testing.assert_array_equal(conflict.gaussian_ids, expected)
        assert conflict.share == pytest.approx(len(expected) / (len(first) + 1))
        session.layers.add("paint", [dab(GREEN, 17)])  # from where the first one was painted, not the second
        assert {(conflict.lower, conflict.upper) for conflict in session.layers.conflicts()} == {(a, b), (b, "3")}
        session.layers.add("look", look="gain")
        assert len(session.layers.conflicts()) == 2


def test_policies_decide_conflicts():
    latest, a, b = conflicting("latest")
    first, *_ = conflicting("first")
    blend, *_ = conflicting("blend")
    with latest, first, blend:
        (conflict,) = latest.layers.conflicts()
        rows = conflict.gaussian_ids[conflict.gaussian_ids < 100]
        assert len(rows)
        red = latest._core.replay.compose(replace(latest.snapshot.document, layers=latest.layers[:1])).splats
        for name in ("means", "scales", "sh"):
            np.testing.assert_array_equal(getattr(first.splats, name)[rows], getattr(red, name)[rows])
        middle = (red.sh[rows].astype(np.float64) + latest.splats.sh[rows]) / 2
        np.testing.assert_allclose(blend.splats.sh[rows], middle, atol=1e-6)
        remaining = np.setdiff1d(np.flatnonzero(differing(red, latest.splats)), conflict.gaussian_ids)
        assert len(remaining)
        np.testing.assert_array_equal(first.splats.sh[remaining], latest.splats.sh[remaining])
        assert first.layers.conflicts()[0].winner == a and blend.layers.conflicts()[0].winner is None
        assert first.undo() and same_bits(first.splats, latest.splats)
        with pytest.raises(ValueError, match="^conflict: expected "):
            latest.layers.resolve_conflict(a, "77", "first")
        with pytest.raises(ValueError, match="^conflict: expected latest, first or blend"):
            latest.layers.resolve_conflict(a, b, "loudest")  # type: ignore[arg-type]


def test_only_conflicts_that_matter_have_a_reason():
    """Paint on a larger layer, from another view, and strokes that touch are no news; a layer that is replaced is, and
    one whose pictures show what was painted over since."""
    with Session(sheet(24, degree=1, opacity=0.95)) as session:
        decal = session.strokes.paint_new("decal", [dab(RED, radius=9)])
        above = session.strokes.paint_new("above", [dab(BLUE, radius=3, camera=SIDE)])
        (conflict,) = session.layers.conflicts()
        assert conflict.reason == "" and 0.3 < conflict.share_of_smaller < MIN_COVERED_SHARE
        session.strokes.paint(above.id, [dab(BLUE, radius=8, camera=SIDE)])
        (conflict,) = session.layers.conflicts()
        assert conflict.reason == "covered" and conflict.share_of_smaller > MIN_COVERED_SHARE
        session.undo()
        session.strokes.paint(decal.id, [dab(GREEN, radius=2)])
        assert [(one.upper, one.reason) for one in session.layers.conflicts()] == [(above.id, "stale")]
        session.undo()
        assert [one.reason for one in session.layers.conflicts()] == [""]
    with Session(sheet(24, degree=1, opacity=0.95)) as session:
        lower = session.strokes.paint_new("lower", [dab(RED, 10, radius=6)])
        session.strokes.paint_new("upper", [dab(BLUE, 24, radius=6, camera=SIDE)])
        session.strokes.paint(lower.id, [dab(GREEN, 6, radius=2)])
        (conflict,) = session.layers.conflicts()
        assert conflict.is_stale and conflict.reason == "" and conflict.share_of_smaller < MIN_STALE_SHARE


def test_coverage_says_what_was_seen():
    with flat() as session:
        regraded = session.layers.add("look", [Edit(np.full((SIZE, SIZE, 3), 0.9, np.float32), CAMERA)])
        x = session.original.means[:, 0]
        np.testing.assert_array_equal(session.layers.coverage(), np.where(x > 0, 1, 2))
        session.layers.set(regraded.id, visible=False)
        assert not session.layers.coverage().any()
        session.layers.add("paint", [dab()])
        touched = np.flatnonzero(differing(session.original, session.splats))
        assert np.flatnonzero(session.layers.coverage()).tolist() == [*touched, 100]
