"""The exponential map of sampled surfaces, against the exact one of planes, cylinders, boxes and spheres."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.surface.unwrap import Unwrapped, smoothed, thinned, unwrap

SPACING = 0.03
UP = np.array([0.0, 1.0, 0.0])


def positions(count: int = 60_000, extent: float = 1.3) -> np.ndarray:
    """[count, 2] exact (u, v), the first one 0."""
    uv = np.random.default_rng(0).uniform(-extent, extent, (count, 2))
    uv[0] = 0
    return uv


def on_cylinder(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normals = np.stack([np.sin(uv[:, 0]), 0 * uv[:, 0], np.cos(uv[:, 0])], 1)
    return normals + uv[:, 1:] * UP, normals


def on_sphere(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away = np.linalg.norm(uv, axis=1, keepdims=True)
    points = np.concatenate([np.sin(away) * uv / np.maximum(away, 1e-12), np.cos(away)], 1)
    return points, points


def on_box(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Three faces of a box of width 1; u runs around its edges."""
    u = uv[:, 0]
    points = np.stack([np.clip(u, -0.5, 0.5), uv[:, 1], 0.5 - np.maximum(np.abs(u) - 0.5, 0)], 1)
    side = np.where(np.abs(u) <= 0.5, 0.0, np.sign(u))
    return points, np.stack([side, 0 * u, (side == 0).astype(float)], 1)


def errors(shape, noise: float = 0.0) -> tuple[np.ndarray, int]:
    """(distances from the exact places over the width of a square decal, samples under it that were not reached).
    noise: of heights in spacings and of normals in radians."""
    rng = np.random.default_rng(1)
    exact = positions()
    points, normals = shape(exact)
    points = points + noise * SPACING * rng.standard_normal(points.shape)
    normals = normals + noise * rng.standard_normal(normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ids = thinned(points, normals, SPACING)
    result = unwrap(points[ids], normals[ids], UP, SPACING, (1.0, 1.0))
    under = (np.abs(exact[ids]) < 1).all(1)
    away = np.linalg.norm(result.uv - exact[ids], axis=1)[under & result.reached]
    return away / 2, int((under & ~result.reached).sum())


@pytest.mark.parametrize(("shape", "bound"), [(on_cylinder, 1e-3), (on_box, 1e-3), (on_sphere, 8e-3)])
def test_exact_developments(shape, bound: float) -> None:
    away, missing = errors(shape)
    assert missing == 0
    assert len(away) > 3000
    assert away.max() < bound


@pytest.mark.parametrize("shape", [on_cylinder, on_box, on_sphere])
def test_noise_stays_below_two_per_cent(shape) -> None:
    """A tenth of a spacing and six degrees, independent from sample to sample."""
    away, missing = errors(shape, noise=0.1)
    assert missing < 10
    assert away.mean() < 0.01
    assert np.quantile(away, 0.95) < 0.02


def wall(gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a wall without rims."""
    side = np.stack(np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)), -1).reshape(-1, 2) * SPACING
    front = np.concatenate([side, np.zeros((len(side), 1))], 1)
    front = front[np.argsort((side**2).sum(1), kind="stable")]
    points = np.concatenate([front, front - (0, 0, gap)])
    normals = np.zeros_like(points)
    normals[: len(front), 2], normals[len(front) :, 2] = 1, -1
    return points, normals


@pytest.mark.parametrize("gap", [0.2 * SPACING, SPACING, 10 * SPACING])
def test_nothing_steps_through_a_wall(gap: float) -> None:
    points, normals = wall(gap)
    result = unwrap(points, normals, UP, SPACING, (1.0, 1.0))
    half = len(points) // 2
    assert result.reached[:half].all()
    assert not result.reached[half:].any()


def test_nothing_steps_over_a_gap_in_depth() -> None:
    """Two parallel layers that face the same way, the second behind the first."""
    points, normals = wall(1.2 * SPACING)
    normals[:] = (0, 0, 1)
    result = unwrap(points, normals, UP, SPACING, (1.0, 1.0))
    half = len(points) // 2
    assert result.reached[:half].all()
    assert not result.reached[half:].any()


def test_wrap_limit() -> None:
    points, normals = on_cylinder(positions())
    ids = thinned(points, normals, SPACING)
    result = unwrap(points[ids], normals[ids], UP, SPACING, (1.3, 1.0), np.radians(40))
    turned = np.degrees(np.arccos(np.clip(result.normals[result.reached, 2], -1, 1)))
    assert 39 < turned.max() < 40 + np.degrees(2.5 * SPACING)


def test_in_between_and_far_away() -> None:
    points, normals = on_sphere(positions())
    ids = thinned(points, normals, SPACING)
    result: Unwrapped = unwrap(points[ids], normals[ids], UP, SPACING, (1.0, 1.0))
    exact = positions()[100:3000] * 0.7
    uv, nearest = result.at(*on_sphere(exact))
    assert (nearest >= 0).all()
    assert np.linalg.norm(uv - exact, axis=1).max() < 0.016
    far, none = result.at(np.array([[0, 0, 3.0], [np.nan, 0, 0]]), np.array([[0, 0, 1.0], [0, 0, 1.0]]))
    assert (none == -1).all()
    assert np.isnan(far).all()


def test_same_result_every_time() -> None:
    points, normals = on_sphere(positions(8000))
    first, second = (unwrap(points, normals, UP, 0.06, (1.0, 1.0)) for _ in range(2))
    assert np.array_equal(first.uv, second.uv, equal_nan=True)


def test_bad_input() -> None:
    points, normals = wall(1.0)
    with pytest.raises(ValueError, match="up direction that is not along the normal"):
        unwrap(points, normals, np.array([0, 0, 1.0]), SPACING, (1, 1))
    with pytest.raises(ValueError, match="finite points and unit normals"):
        unwrap(points, 2 * normals, UP, SPACING, (1, 1))


def test_smoothing_brings_noise_back_to_the_plane_and_leaves_creases() -> None:
    rng = np.random.default_rng(1)
    plane = np.concatenate([rng.uniform(-1, 1, (8000, 2)), 0.02 * rng.standard_normal((8000, 1))], 1)
    normals = np.array([0, 0, 1.0]) + rng.uniform(-0.4, 0.4, (8000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, turned = smoothed((plane, normals), (plane, normals), 0.15)
    assert np.abs(points[:, 2]).mean() < 0.3 * np.abs(plane[:, 2]).mean()
    assert turned[:, 2].min() > 0.95
    exact = np.where(plane[:, :1] < 0, np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
    folded = np.stack([np.minimum(plane[:, 0], 0), plane[:, 1], -np.maximum(plane[:, 0], 0)], 1)
    points, turned = smoothed((folded, exact), (folded, exact), 0.15)
    assert np.allclose(turned, exact)
    assert np.allclose(points, folded, atol=1e-6)
