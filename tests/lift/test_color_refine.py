"""Colour rounds after the network, against the dense float64 compositor; and what a draft says of a row's drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpainter.lift.colors import lift_colors, refine_colors_global, refine_colors_local
from splatpainter.models.gaussian_groups import drift_features
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from tests.support.lift_scenes import back, base_colors, dense_weights, differing, disk, front, sheet

CAMERAS = [front(40), back(40)]
SHEET = sheet(14, opacity=0.97)


def pictures(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(0.2, 0.8, (40, 40, 3)).astype(np.float32) for _ in CAMERAS]


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_local_round_is_the_written_out_formula(rounds: int) -> None:
    target_picture, rows = pictures()[0], np.arange(len(SHEET)) % 3 > 0
    weights, left = dense_weights(SHEET, CAMERAS[0])
    colors, target = base_colors(SHEET), target_picture.reshape(-1, 3).astype(np.float64)
    for _ in range(rounds):
        error = target - (weights.T @ colors + left[:, None] * 0.5)
        step = weights @ error / np.maximum(weights.sum(1), 1e-6)[:, None]
        colors = np.clip(np.where(rows[:, None], colors + step, colors), 0, 1.3)
    result = refine_colors_local(SHEET, [(CAMERAS[0], target_picture)], rows, rounds)
    np.testing.assert_allclose(base_colors(result), colors, atol=2e-3)
    assert not differing(SHEET, result)[~rows].any() and result.means is SHEET.means
    assert refine_colors_local(SHEET, [(CAMERAS[0], target_picture)], np.zeros(len(SHEET), bool)) is SHEET


def test_faint_gaussians_before_a_bright_picture_stop_at_the_bound() -> None:
    """A third of a pixel is theirs, so that white asks for more than they may have."""
    faint = sheet(14, opacity=0.33)
    white, rows = np.ones((40, 40, 3), np.float32), np.ones(len(faint), bool)
    bright = base_colors(refine_colors_local(faint, [(CAMERAS[0], white)], rows, 12))
    np.testing.assert_allclose(bright.max(0), 1.3, atol=2e-3)
    assert (bright > 1.29).mean() > 0.2


def test_of_two_local_pictures_the_latest_wins() -> None:
    rows = np.ones(len(SHEET), bool)
    red, blue = (np.broadcast_to(np.array(c, np.float32), (40, 40, 3)) for c in ((0.9, 0.1, 0.1), (0.1, 0.1, 0.9)))
    last = refine_colors_local(SHEET, [(CAMERAS[0], red), (CAMERAS[0], blue)], rows)
    first = refine_colors_local(SHEET, [(CAMERAS[0], blue), (CAMERAS[0], red)], rows)
    assert base_colors(last)[:, 2].mean() > 0.8 and base_colors(first)[:, 0].mean() > 0.8


def test_global_rounds_are_the_written_out_formula_over_all_views() -> None:
    targets, mask = pictures(1), disk(CAMERAS[0], 20, 20, 12)
    views = [(camera, target, mask) for camera, target in zip(CAMERAS, targets, strict=True)]
    seen = [dense_weights(SHEET, camera) for camera in CAMERAS]
    use = [(mask.ravel() & (left < 0.1)).astype(float) for _, left in seen]
    total = sum(w @ m for (w, _), m in zip(seen, use, strict=True))
    change = np.zeros((len(SHEET), 3))
    for _ in range(2):
        gain = np.zeros_like(change)
        for (w, left), m, target in zip(seen, use, targets, strict=True):
            picture = w.T @ np.clip(base_colors(SHEET) + change, 0, 1.3) + left[:, None] * 0.5
            gain += w @ (m[:, None] * (target.reshape(-1, 3) - picture))
        change += gain / np.maximum(total, 1e-6)[:, None]
    result = refine_colors_global(SHEET, views)
    moved = (total > 0.06) & (np.abs(change).max(1) > 2e-3)
    assert 20 < moved.sum() < 0.9 * len(SHEET)
    np.testing.assert_allclose((base_colors(result) - base_colors(SHEET))[moved], change[moved], atol=3e-3)
    assert not differing(SHEET, result)[total < 0.04].any()


def test_drift_is_zero_for_the_same_rows_and_bounded_for_any() -> None:
    rows = SHEET.torch()
    assert not drift_features(rows, rows, 0.1).any()
    other = replace(
        rows, means=rows.means + torch.tensor([0.1, 0, -9.0]), scales=rows.scales * 0.5, opacities=rows.opacities - 0.2
    )
    expected = torch.tensor([0.5, 0, -4, *[np.log(0.5) / 4] * 3, -0.2]).float()
    torch.testing.assert_close(drift_features(other, rows, 0.2), expected.expand(len(rows), 7))


@pytest.mark.parametrize("rounds", [2, 5])
def test_a_hold_pulls_back_to_the_old_colour(rounds: int) -> None:
    """Damped least squares, written out; and where it ends, far from both the old colour and the picture."""
    view, camera = project(SHEET, CAMERAS[0]), CAMERAS[0]
    target, ids = pictures()[0], view.gaussian_ids
    weights, left = dense_weights(SHEET, camera)
    hold = np.random.default_rng(0).uniform(0.5, 6, len(SHEET))
    everywhere = np.ones(target.shape[:2], np.float32)
    old = base_colors(SHEET).astype(np.float64)
    colors = old.copy()
    for _ in range(rounds):
        error = target.reshape(-1, 3) - (weights.T @ colors + left[:, None] * 0.5)
        gain = weights @ error - hold[:, None] * (colors - old)
        colors = np.clip(colors + gain / (weights.sum(1) + hold)[:, None], 0, 1.3)
    editable = np.ones(len(ids), bool)
    result = lift_colors(view, target, everywhere, editable, rounds, hold[ids].astype(np.float32))
    np.testing.assert_allclose(result, colors[ids], atol=2e-3)
    free = lift_colors(view, target, everywhere, editable, rounds)
    before = view.colors
    assert np.abs(result - before).mean() < 0.8 * np.abs(free - before).mean()


@pytest.mark.parametrize(("steps", "moves"), [(0.5, False), (3.0, True)])
def test_colours_that_hardly_move_keep_their_bits(steps: float, moves: bool) -> None:
    """Steps of an 8-bit picture's quarter, 1 / 1024: half of one is no edit, three are."""
    rows = np.ones(len(SHEET), bool)
    target = render(replace(SHEET, sh=SHEET.sh + steps / 1024 / 0.28209479), [CAMERAS[0]]).colors[0]
    result = refine_colors_local(SHEET, [(CAMERAS[0], np.asarray(target, np.float32))], rows, 8)
    assert (result is not SHEET) == moves
    if moves:
        assert differing(SHEET, result).mean() > 0.9
    everywhere = np.ones(target.shape[:2], bool)
    assert (refine_colors_global(SHEET, [(CAMERAS[0], target, everywhere)]) is not SHEET) == moves
