"""Layers of paint: sizes, places and turns of what is drawn, against areas and positions worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from splatpainter.pictures import drawing
from splatpainter.pictures.drawing import Brush

RED = (0.8, 0.1, 0.1)
SHAPE = (100, 160)


def middle_of(coverage: np.ndarray) -> tuple[float, float]:
    y, x = np.mgrid[: coverage.shape[0], : coverage.shape[1]] + 0.5
    return float((x * coverage).sum() / coverage.sum()), float((y * coverage).sum() / coverage.sum())


def test_layers_stack_as_they_would_one_after_the_other() -> None:
    rng = np.random.default_rng(0)
    image, below, above = rng.random((9, 9, 3)), rng.random((9, 9, 4)), rng.random((9, 9, 4))
    both = drawing.over(image, drawing.stack_layers(below, above))
    np.testing.assert_allclose(both, drawing.over(drawing.over(image, below), above), atol=1e-6)


def test_a_spline_goes_through_its_points_and_is_straight_where_they_are() -> None:
    points = np.array([[0.0, 0], [2, 4], [4, 8], [6, 12]])
    path = drawing.catmull_rom(points, 13)
    np.testing.assert_allclose(path[::4], points, atol=1e-12)
    np.testing.assert_allclose(path[:, 1], 2 * path[:, 0], atol=1e-12)
    corner = drawing.catmull_rom(np.array([[0.0, 0], [1, 1], [2, 0]]), 5)
    np.testing.assert_allclose(corner[[0, 2, 4]], [[0, 0], [1, 1], [2, 0]], atol=1e-12)
    assert corner[1, 1] > 0.5  # rounder than a polyline


def test_a_stroke_is_as_wide_as_brush_times_pressure() -> None:
    points = np.array([[20.0, 50], [140, 50]])
    wide = drawing.draw_stroke(SHAPE, points, np.array([1.0, 1]), Brush(20, hardness=1), RED)
    assert wide.dtype == np.float32 and wide.shape == (*SHAPE, 4)
    assert (wide[..., :3] == np.asarray(RED, np.float32)).all()
    assert abs(wide[:, 80, 3].sum() - 20) < 1.5
    half = drawing.draw_stroke(SHAPE, points, np.array([1.0, 0.5]), Brush(20, hardness=1), RED)
    assert abs(half[:, 138, 3].sum() - 10) < 1.5 and abs(half[:, 22, 3].sum() - 20) < 1.5
    area = 120 * 20 + math.pi * 100
    assert abs(wide[..., 3].sum() - area) < 0.06 * area
    thin = drawing.draw_stroke(SHAPE, points, np.array([1.0, 1]), Brush(20, flow=0.5), RED)
    assert np.isclose(thin[50, 80, 3], 0.5, atol=0.01)


def test_bristles_leave_streaks_and_run_dry() -> None:
    points = np.array([[20.0, 50], [140, 50]])
    layer = drawing.draw_stroke(SHAPE, points, np.array([1.0, 1]), Brush(24, bristles=12), RED, seed=3)[..., 3]
    assert layer[44:56, 60].std() > 0.03
    assert layer[40:60, 135].mean() < 0.85 * layer[40:60, 40].mean()
    again = drawing.draw_stroke(SHAPE, points, np.array([1.0, 1]), Brush(24, bristles=12), RED, seed=3)[..., 3]
    assert (layer == again).all()


def test_a_stroke_beside_the_picture_is_nothing() -> None:
    points = np.array([[-80.0, -60], [-50, -60]])
    assert drawing.draw_stroke(SHAPE, points, np.array([1.0, 1]), Brush(10), RED)[..., 3].max() == 0


@pytest.mark.parametrize("edge", [30, 97, 400])
def test_a_sticker_has_its_size_place_and_colours(edge: int) -> None:
    stamp = np.zeros((edge, edge, 4), np.float32)
    stamp[..., 3] = 1
    stamp[: edge // 2, :, 0], stamp[edge // 2 :, :, 2] = 1, 1  # red above blue
    layer = drawing.draw_sticker(SHAPE, stamp, (70.3, 41.8), 40)
    assert abs(layer[..., 3].sum() - 1600) < 60
    assert np.allclose(middle_of(layer[..., 3]), (70.3, 41.8), atol=0.35)
    assert layer[30, 70, 0] > 0.99 and layer[54, 70, 2] > 0.99


def test_a_sticker_turns_counter_clockwise() -> None:
    stamp = np.zeros((60, 60, 4), np.float32)
    stamp[:30, :, :] = 1  # its upper half only
    x, y = middle_of(drawing.draw_sticker(SHAPE, stamp, (80, 50), 40, angle=90)[..., 3])
    assert abs(x - 70) < 0.6 and abs(y - 50) < 0.6  # up has become left


def test_a_translucent_rim_keeps_its_colour() -> None:
    stamp = np.zeros((40, 40, 4), np.float32)
    stamp[10:30, 10:30] = (1, 0, 0, 1)  # black under nothing must not darken the rim
    layer = drawing.draw_sticker(SHAPE, stamp, (80, 50), 60, angle=20)
    rim = (layer[..., 3] > 0.2) & (layer[..., 3] < 0.8)
    assert rim.sum() > 20 and layer[rim][:, 0].min() > 0.95


def test_lettering_has_its_height_its_colours_and_its_turn() -> None:
    layer = drawing.draw_text(SHAPE, "HIT", (80, 50), 40, RED)
    inked = layer[..., 3] > 0.5
    assert abs(np.flatnonzero(inked.any(1)).size - 40) <= 2
    assert np.allclose(layer[inked][:, :3], RED, atol=0.02)
    turned = drawing.draw_text(SHAPE, "HIT", (80, 50), 40, RED, angle=90)[..., 3] > 0.5
    assert abs(np.flatnonzero(turned.any(0)).size - 40) <= 2
    rimmed = drawing.draw_text(SHAPE, "HIT", (80, 50), 40, RED, outline=(0.0, 0.0, 1.0))
    blue = (rimmed[..., 2] > 0.9) & (rimmed[..., 3] > 0.9)
    assert blue.sum() > 100 and (rimmed[..., 3] > 0.5).sum() > inked.sum() + 100
    with pytest.raises(ValueError, match="missing.ttf: expected a TrueType"):
        drawing.draw_text(SHAPE, "A", (80, 50), 40, RED, Path("missing.ttf"))


def test_noise_has_mean_zero_and_spread_one() -> None:
    values = drawing.value_noise((256, 256), 12, np.random.default_rng(0))
    assert abs(values.mean()) < 0.1 and 0.7 < values.std() < 1.3
    near = np.corrcoef(values[:, :-1].ravel(), values[:, 1:].ravel())[0, 1]
    far = np.corrcoef(values[:, :-40].ravel(), values[:, 40:].ravel())[0, 1]
    assert near > 0.7 and abs(far) < 0.2


def test_blur_is_the_gaussian() -> None:
    image = np.zeros((41, 41, 1))
    image[20, 20] = 1
    out = drawing.gaussian_blur(image, 2.0)[..., 0]
    offset = np.arange(41) - 20
    kernel = np.exp(-(offset**2) / 8.0) * (np.abs(offset) <= 6)
    np.testing.assert_allclose(out, np.outer(kernel, kernel) / kernel.sum() ** 2, atol=1e-6)
    np.testing.assert_allclose(drawing.gaussian_blur(np.full((9, 9, 3), 0.4), 3), 0.4, atol=1e-6)


def test_a_blob_has_about_its_area() -> None:
    for seed in range(4):
        cover = drawing.round_spot(SHAPE, (80, 50), 30, 0.1, np.random.default_rng(seed))
        assert 0.7 < cover.sum() / (math.pi * 900) < 1.3 and cover.max() == 1 and cover[0, 0] == 0
