"""The parts of mode spread against brute force, numpy's solver, and colours known by hand."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from splatpainter.color import LUMA, linear_to_srgb, luminance, srgb_to_linear
from splatpainter.spread.classifier import FEATURES, Projections, density_ratio, two_class
from splatpainter.spread.color_change import ColorChange
from splatpainter.spread.descriptors import Descriptors
from splatpainter.spread.nearest_neighbours import SEARCH, neighbours, smoothed, weighted_means
from splatpainter.spread.overlay import behind, confidence_overlay, confidence_picture
from tests.support.spread_scenes import CAMERA, board

SEED = 11
RNG = np.random.default_rng(SEED)


@pytest.fixture(autouse=True)
def fresh_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test draws the same numbers whatever ran before it: which tests a process gets differs from run to run."""
    monkeypatch.setattr(sys.modules[__name__], "RNG", np.random.default_rng(SEED))


def test_neighbours_are_the_nearest_points() -> None:
    points = RNG.normal(0, 1, (400, 3)).astype(np.float32) * [1, 1, 0.05]
    near = neighbours(points.astype(np.float32))
    square = ((points[:, None] - points) ** 2).sum(2)
    expected = np.sort(square, axis=1)[:, : SEARCH.neighbours]
    result = np.take_along_axis(square, near.astype(np.int64), 1)
    np.testing.assert_array_equal(near[:, 0], np.arange(400))
    assert (np.abs(result - expected) < 1e-6).mean() > 0.97  # strays see only MAX_RINGS cubes far
    assert (np.diff(result[:, 1:], axis=1) >= 0)[(near[:, 1:] != near[:, :1]).all(1)].all()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_neighbours_of_few_points_and_of_a_heap(count: int) -> None:
    near = neighbours(np.zeros((count, 3), np.float32))
    assert near.shape == (count, SEARCH.neighbours) and ((near >= 0) & (near < max(count, 1))).all()
    heap = neighbours(np.zeros((6000, 3), np.float32))
    assert (heap[:, 1:] != heap[:, :1]).all()


def test_means_and_deviations_over_neighbours() -> None:
    values, weights = RNG.random((50, 2)).astype(np.float32), RNG.random(50).astype(np.float32)
    near = RNG.integers(0, 50, (50, 4)).astype(np.int32)
    mean, deviation = weighted_means(values, weights, near)
    share = weights[near] / weights[near].sum(1, keepdims=True)
    expected = np.einsum("nk,nkc->nc", share, values[near])
    np.testing.assert_allclose(mean, expected, atol=1e-6)
    second = np.einsum("nk,nkc->nc", share, values[near] ** 2)
    np.testing.assert_allclose(deviation, np.sqrt(np.maximum(second - expected**2, 0)), atol=2e-3)


def test_smoothing_ends_at_the_solution_of_its_linear_system() -> None:
    near = RNG.integers(0, 30, (30, 5)).astype(np.int32)
    links, hold, target = np.full((30, 5), 0.2, np.float32), np.full(30, 0.3, np.float32), RNG.random(30)
    matrix = np.zeros((30, 30))
    np.add.at(matrix, (np.arange(30)[:, None], near), links)
    expected = np.linalg.solve(np.eye(30) - 0.7 * matrix, 0.3 * target)
    result = smoothed(np.zeros(30), target, hold, links, near, 80)
    np.testing.assert_allclose(result, expected, atol=1e-5)


def test_features_are_cosines_whose_products_are_a_gaussian_kernel() -> None:
    points = RNG.normal(0, 1, (40, 3)).astype(np.float32)
    features = Projections.of(3).features(points)
    directions, phases = Projections.of(3).directions, Projections.of(3).phases
    np.testing.assert_allclose(features, np.cos(2 * np.pi * (points @ directions + phases)), atol=2e-5)
    square = ((points[:, None] - points) ** 2).sum(2)
    assert np.abs(features @ features.T * 2 / FEATURES - np.exp(-square / 2)).mean() < 0.06


@pytest.mark.parametrize("question", [two_class, density_ratio])
def test_answers_solve_the_normal_equations(question) -> None:
    features = RNG.normal(0, 1, (300, FEATURES)).astype(np.float32)
    positive, weights = RNG.random(300) < 0.3, RNG.random(300) + 0.1
    theta = question(features, positive, weights, 0.2)
    inside, everything = np.where(positive, weights, 0), weights / weights.sum()
    w = everything
    if question is two_class:
        w = inside / inside.sum() + (weights - inside) / (weights - inside).sum()
    right = w * positive if question is two_class else inside / inside.sum()
    full = features.astype(np.float64)
    expected = np.linalg.solve(full.T @ (w[:, None] * full) + 0.2 * np.eye(FEATURES), full.T @ right)
    np.testing.assert_allclose(theta, expected, rtol=1e-6, atol=1e-9)
    points = RNG.normal(0, 1, (20, 5)).astype(np.float32)
    projections = Projections.of(5)
    np.testing.assert_allclose(
        projections.predict(points, theta), projections.features(points) @ theta.astype(np.float32), atol=1e-4
    )


def test_a_density_ratio_is_flat_on_what_the_examples_are_a_random_part_of() -> None:
    material = RNG.normal(0, 0.3, (600, 2)).astype(np.float32)
    rest = RNG.normal(3, 0.3, (600, 2)).astype(np.float32)
    points, positive = np.concatenate([material, rest]), np.arange(1200) < 150
    projections = Projections.of(2)
    ratio = projections.predict(points, density_ratio(projections.features(points), positive, np.ones(1200), 0.01))
    inside = ratio[:600] / np.median(ratio[positive])
    assert np.abs(inside - 1).mean() < 0.2 and np.abs(ratio[600:]).max() < 0.2 * np.median(ratio[positive])


def test_light_and_shade_stay_where_the_examples_do_not_say_otherwise() -> None:
    old = np.full((50, 3), 0.5, np.float32)
    change = ColorChange.fit(old, np.tile([0.8, 0.2, 0.2], (50, 1)), np.ones(50))
    np.testing.assert_allclose(change(old[0]), [0.8, 0.2, 0.2], atol=5e-3)
    dark = change(np.full(3, 0.3, np.float32))
    ratio = srgb_to_linear(np.array(0.3)) / srgb_to_linear(np.array(0.5))
    expected = linear_to_srgb(srgb_to_linear(np.array([0.8, 0.2, 0.2])) * ratio)
    np.testing.assert_allclose(dark, expected, atol=0.05)


def test_flat_paint_over_shade_stays_flat_and_a_tint_keeps_hues_apart() -> None:
    light = np.linspace(0.1, 1, 200)[:, None]
    old = linear_to_srgb(light * [0.6, 0.5, 0.4])
    flat = ColorChange.fit(old, np.tile([0.2, 0.6, 0.3], (200, 1)), np.ones(200))
    assert np.abs(flat(old[20:]) - [0.2, 0.6, 0.3]).max() < 0.12  # the shade ranges over 0.5
    colors = RNG.random((300, 3)) * 0.8 + 0.1
    tinted = linear_to_srgb(srgb_to_linear(colors) * [0.9, 0.5, 0.3])
    tint = ColorChange.fit(colors, tinted, np.ones(300))
    assert np.abs(tint(colors) - tinted).max() < 0.1
    assert luminance(tint(np.zeros(3))) < 0.1 and sum(LUMA) == pytest.approx(1)


def test_descriptors_tell_hue_and_hardly_see_light() -> None:
    splats = board()
    values = Descriptors.of(splats).values
    left, back = splats.means[:, 0] < -0.2, splats.means[:, 2] < -0.1
    right = splats.means[:, 0] > 0.2
    between = np.linalg.norm(values[left & ~back].mean(0) - values[right & ~back].mean(0))
    shade = np.linalg.norm(values[left & ~back].mean(0) - values[left & back].mean(0))
    assert between > 3 * shade


def test_the_overlay_is_green_where_sure_and_clear_where_not() -> None:
    splats = board()
    confidence = (splats.means[:, 0] < 0).astype(np.float32)
    picture = confidence_overlay(splats, confidence, 0.55, CAMERA)
    red, green, _, alpha = picture[36, 20]
    assert alpha > 150 and green > 180 > red and picture[36, 60, 3] == 0
    both = confidence_picture(splats, confidence, 0.55, CAMERA)
    assert both.shape == (72, 144, 3)
    turned = behind(CAMERA, np.zeros(3))
    np.testing.assert_allclose(turned.position, -CAMERA.position, atol=1e-9)
    assert both[36, 72 + 52, 1] > both[36, 72 + 20, 1]  # from behind, left is right
