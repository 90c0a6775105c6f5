"""Kernels of lift, grading, frames, spread and data: the same bytes on every kind of CPU, for any number of threads."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.grading.color_grading import adjust_contrast, apply_to_sh, grade_sh
from splatpainter.grading.color_match import AffineMap
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.masks import box_mean
from splatpainter.server.frames import pack_base, pack_harmonics
from tests.support.kernel_goldens import CPUS, Numbers, check

F = np.float32
GOLDENS: dict[str, tuple[Callable[[], list[np.ndarray]], str]] = {}


def golden(expected: str):
    """Register a case by its name."""

    def register(case: Callable[[], list[np.ndarray]]):
        GOLDENS[case.__name__] = case, expected
        return case

    return register


@golden("bfb7b7ecd41d6f8a")
def nearest_pixels() -> list[np.ndarray]:
    mask = Numbers(1).integers(60, 40, 50) == 0
    y, x = (np.full(42 * 52, -(1 << 20), np.int32) for _ in range(2))
    out = np.full((40, 50), -1, np.int32)
    kernels.find_nearest_pixels(mask, y, x, int(np.flatnonzero(mask.any(1))[0]), out, 0, 1)
    return [out]


@golden("84724dad47f81eff")
def box_means() -> list[np.ndarray]:
    picture = Numbers(8).uniform(-1, 1, 61, 83, 3).astype(F)
    return [box_mean(picture, radius) for radius in (1, 2, 17)]


@golden("b8ba7296b41ac604")
def picture_changes() -> list[np.ndarray]:
    out = []
    for dtype in (F, np.float64):
        one, other = (Numbers(seed).uniform(-0.2, 1.2, 45, 67, 3).astype(dtype) for seed in (12, 13))
        apart, detail = np.empty((2, 45, 67), dtype)
        run(kernels.compare_pictures, one, other, apart)
        run(kernels.measure_contrast, other[..., 0].copy(), detail)
        out += [apart, detail]
    return out


@golden("acda959b2feb060c")
def regression() -> list[np.ndarray]:
    r, count = Numbers(14), 2001
    features, sh = r.uniform(-1, 1, count, 36).astype(F), r.uniform(-1, 1, count, 9, 3).astype(F)
    leverage = np.empty(count, F)
    run(kernels.turn_bands, features, r.uniform(-1, 1, 9, 9).astype(F), sh)
    run(kernels.measure_leverage, features, r.uniform(-1, 1, 36, 36).astype(F), leverage)
    return [sh, leverage]


@golden("91c839ff2d91926f")
def grades() -> list[np.ndarray]:
    """Sliders and a matrix on all bands, in both colour spaces, and the curve of sRGB."""
    r = Numbers(17)
    out: list[np.ndarray] = []
    sh = r.uniform(-2.2, 2.2, 8500, 9, 3).astype(F)  # more than is graded at a time
    hues = [{"hue": 20.0, "width": 80.0, "shift": 30.0, "saturation": 0.2, "lightness": -0.3}]
    for settings in ({"exposure": 0.5, "temperature": 0.3}, {"contrast": 0.4, "strength": 0.7}, {"hues": hues}):
        out.append(grade_sh(sh, {**settings, "saturation": 0.4}))
    recolored = AffineMap(r.uniform(-1, 1, 3, 3), r.uniform(0, 1, 3), r.uniform(0, 1, 3))
    out.append(apply_to_sh(sh, recolored))
    out += [grade_sh(sh[:, :bands].copy(), {"exposure": -0.5, "space": "linear"}) for bands in (1, 4)]
    levels = r.uniform(0, 1.2, 2003)
    return out + [portable.srgb(values, way) for values in (levels, levels.astype(F)) for way in (False, True)]


@golden("b94a611b1951e4f0")
def bent_levels() -> list[np.ndarray]:
    levels = Numbers(27).uniform(-0.1, 1.1, 2003).astype(F)
    return [adjust_contrast(levels, slope) for slope in (0.7, 1.9)]


@golden("191e25a73460619d")
def packed_colors() -> list[np.ndarray]:
    sh = (Numbers(18).uniform(-2.2, 2.2, 901, 4, 3) / np.array([1, 10, 100, 1e5])[:, None]).astype(F)
    return [pack_base(sh), pack_harmonics(sh)]


@golden("a59d4b8d8c48a6d7")
def partners() -> list[np.ndarray]:
    r, count = Numbers(2), 800
    cells = 1 << 20
    keys = np.sort((r.integers(12, count) * 2 * cells + r.integers(12, count)) * 2 * cells + r.integers(4, count))
    axes = r.uniform(0.3, 1.5, count, 3)
    covariances = np.zeros((count, 3, 3))
    for k in range(3):
        covariances[:, k, k] = axes[:, k] * axes[:, k]
    covariances[:, 0, 1] = covariances[:, 1, 0] = 0.3 * axes[:, 0] * axes[:, 1]
    points, logs = r.uniform(0, 12, count, 3), r.uniform(-2, 1, count)
    rest = (r.uniform(0.1, 2, count), r.uniform(0, 0.3, count, 3), r.uniform(0.02, 4, count), r.integers(3, count) == 0)
    costs, out = np.full(count, 0.1), np.full(count, -1)
    kernels.find_partners(keys, points, covariances, logs, *rest, 0.8, costs, out, 0, 1)
    assert (out >= 0).sum() > 100
    return [costs, out]


@golden("f0b0b751f6c438c1")
def sides() -> list[np.ndarray]:
    r, count = Numbers(3), 3000
    means = np.stack([r.uniform(-2, 2, count), r.uniform(-2, 2, count), r.uniform(-1, 6, count)], 1).astype(F)
    quats, scales = r.normal(count, 4).astype(F), r.uniform(0.001, 0.5, count, 3).astype(F)
    height, width = 30, 40
    nearest = r.integers(height * width, height, width).astype(np.int32)
    entry = np.arange(height * width).reshape(height, width)
    normals = r.uniform(-0.3, 0.3, height * width, 3) - np.array([0, 0, 0.9])
    surface = (r.uniform(2.8, 3.2, height * width), normals, *r.uniform(0, 0.2, 2, height * width))
    lens, out = np.array([40.0, 42, 20, 15]), np.empty(count, np.uint8)
    tables = (r.order(count), np.eye(4), lens, nearest, entry, *surface)
    run(kernels.classify_sides, means, quats, scales, *tables, False, out)
    assert len(np.unique(out)) == 3
    return [out]


@golden("a357191b2f258f94")
def sheets() -> list[np.ndarray]:
    """Cells, Gaussians in them, and which of these hang past the horizon."""
    r, count, shape = Numbers(16), 1500, (45, 67)
    colors = (np.repeat(np.repeat(r.integers(3, 2, 3, 3), 27, 0), 27, 1)[:45, :67] * 0.3).astype(F)
    covered, depth, edges = r.integers(3000, *shape) > 0, r.uniform(1.999, 2.001, *shape), np.zeros(shape, np.uint8)
    run(kernels.choose_cells, colors, covered, depth, 0.03, 0.08, 60.0, edges)
    rays = np.concatenate([r.uniform(-0.5, 0.5, count, 2), np.ones((count, 1))], 1)
    normals = r.uniform(-0.4, 0.4, count, 3) - np.array([0, 0, 0.9])
    layout = np.concatenate(
        [r.uniform(0.3, 5, count, 3), r.integers(4, count, 1) + 1.0, r.uniform(-0.5, 0.5, count, 1)], 1
    )
    out = [np.empty((count, columns)) for columns in (3, 4, 3)]
    run(kernels.lay_gaussians, rays, r.uniform(1, 3, count), normals, layout, np.eye(4), 60.0, 0.1, *out)
    hosts = (r.uniform(-1, 1, 90, 3), r.normal(90, 4), r.uniform(0.01, 0.6, 90, 3))
    heaviest, pixels, past = r.integers(91, *shape) - 1, r.uniform(0, 45, count, 2), np.empty(count, bool)
    where = (r.integers(90, count), pixels, heaviest, np.array([0.2, 0.1, -2.0]))
    run(kernels.mark_past_horizon, *hosts, *out[:2], *where, 0.8, 2.5, 0.3, 2, past)
    assert len(np.unique(edges)) == 5 and 0.02 < past.mean() < 0.9
    return [edges, *out, past]


def stopping_depths(dtype: type) -> list[np.ndarray]:
    """A picture of 3 x 2 tiles, the last ones cut off, 200 Gaussians in each."""
    r, tiles, each, shape = Numbers(4), 6, 200, (25, 40)
    projected = np.zeros((tiles * each, 16))
    tile = np.arange(tiles * each) // each
    projected[:, 0] = tile % 3 * 16 + r.uniform(-4, 20, len(tile))
    projected[:, 1] = tile // 3 * 16 + r.uniform(-4, 20, len(tile))
    projected[:, [2, 4]], projected[:, 3] = r.uniform(0.05, 0.5, len(tile), 2), r.uniform(-0.04, 0.04, len(tile))
    projected[:, 5], projected[:, 9] = r.uniform(0.01, 0.99, len(tile)), r.uniform(1, 3, len(tile))
    projected[:, 10:12], projected[:, 12] = 12, r.uniform(0, 11, len(tile))
    pixels, depth, host = r.integers(9, *shape) > 0, np.zeros(shape, F), np.full(shape, -1, np.int32)
    lists = (np.arange(len(tile), dtype=np.int32), np.arange(tiles, dtype=np.int32), np.arange(tiles + 1) * each)
    run(kernels.find_stopping_depths, readonly(projected, dtype), *lists, pixels, 0.4, depth, host)
    assert (depth > 0).mean() > 0.7
    return [depth, host]


@golden("60be9fc546d5a8b0")
def stopping_depths_float32() -> list[np.ndarray]:
    return stopping_depths(np.float32)


@golden("60be9fc546d5a8b0")
def stopping_depths_float64() -> list[np.ndarray]:
    return stopping_depths(np.float64)


@golden("749c21e7fd1330bb")
def smoothed_depths() -> list[np.ndarray]:
    r = Numbers(5)
    depth = r.uniform(1.98, 2.06, 40, 50).astype(F)
    depth[r.integers(3, 40, 50) == 0] = 0
    medians, means = np.zeros_like(depth), np.zeros_like(depth)
    run(kernels.take_depth_medians, depth, medians)
    run(kernels.take_depth_means, depth, means)
    return [medians, means]


@golden("175f3e0f375abb9b")
def details() -> list[np.ndarray]:
    r = Numbers(6)
    picture = (np.repeat(np.repeat(r.integers(3, 5, 7, 3), 8, 0), 8, 1) + r.uniform(0, 0.05, 40, 56, 3)).astype(F)
    depth, reaches = (r.integers(40, 40, 56) > 0).astype(F), np.array([0.4, 0.5, 1, 1.5, 2, 3, 4])
    ys, xs = (np.ascontiguousarray(at) for at in np.nonzero(r.integers(2, 40, 56)))
    directions = r.uniform(-1, 1, len(ys), 2)
    along = np.empty(len(ys))
    run(kernels.measure_reaches, picture, depth, ys, xs, directions, reaches, along)
    covered, chosen = np.zeros((40, 56), bool), np.zeros(len(ys), bool)
    kernels.choose_details(ys, xs, directions, along, along / 2, r.order(len(ys)), covered, chosen, 0, 1)
    assert len(np.unique(along)) > 4 and 0 < chosen.sum() < len(chosen)
    return [along, covered, chosen]


@golden("b166c8860e1a29d1")
def joint_colors() -> list[np.ndarray]:
    r, count, bands = Numbers(7), 3000, 4
    ids = np.sort(r.order(count)[:2500])
    basis = r.uniform(-0.5, 0.5, len(ids), bands).astype(F)
    colors, gain, divisor = (
        np.empty((len(ids), 3), F),
        np.zeros((count, bands, 3), F),
        np.zeros((count, bands, bands), F),
    )
    change, before = r.uniform(-0.5, 0.5, count, bands, 3).astype(F), r.uniform(0, 1.2, len(ids), 3).astype(F)
    run(kernels.change_colors, ids, basis, change, before, 1.0, colors)
    run(kernels.add_residual, ids, basis, colors, gain)
    run(kernels.add_squares, ids, basis, r.uniform(0, 3, len(ids)).astype(F), divisor)
    return [colors, gain, divisor]


@golden("65f696be55ae3d8b")
def neighbours() -> list[np.ndarray]:
    r, count = Numbers(8), 1500
    points = r.uniform(0, 6, count, 3)
    points[:40] = points[0]
    cells = np.floor(points).astype(np.int64) + 1000
    keys = cells[:, 0] << 40 | cells[:, 1] << 20 | cells[:, 2]
    order = np.argsort(keys, kind="stable")
    near = np.empty((count, 16), np.int32)
    run(kernels.find_neighbours, points, keys[order], order, cells, 1.0, near)
    values, weights = r.uniform(0, 1, count, 5).astype(F), r.uniform(0.1, 1, count).astype(F)
    mean, deviation, after = np.empty_like(values), np.empty_like(values), np.empty(count, F)
    run(kernels.take_neighbour_means, values, weights, near, mean, deviation)
    run(kernels.smooth_once, weights, values[:, 0].copy(), weights, np.full((count, 16), 1 / 16, F), near, after)
    return [near, mean, deviation, after]


@golden("85beee3d7d02be1a")
def classifier() -> list[np.ndarray]:
    r, count = Numbers(9), 500
    points, directions = r.uniform(-2, 2, count, 7).astype(F), r.uniform(-0.3, 0.3, 7, 192).astype(F)
    phases, features, out = r.uniform(0, 1, 192).astype(F), np.empty((count, 192), F), np.empty(count, F)
    run(kernels.take_fourier_features, points, directions, phases, features)
    matrix, right = 1e-3 * np.eye(192), np.zeros(192)
    run(kernels.add_normal_equations, features, r.uniform(0, 1, count), r.uniform(-1, 1, count), matrix, right)
    sums = np.triu(matrix), right.copy()
    kernels.solve_symmetric(matrix, right[:, None], 0, 1)
    run(kernels.predict_from_features, points, directions, phases, right.astype(F), out)
    return [features, *sums, right, out]


@golden("212d712ab9114c24")
def poisson_disk() -> list[np.ndarray]:
    r, count = Numbers(10), 2000
    points, normals = r.uniform(0, 1, count, 3).astype(F), r.uniform(-0.5, 0.5, count, 3).astype(F)
    low, dims = np.zeros(3, F), np.full(3, 13)
    taken, left = np.zeros(count, bool), np.array([900])
    heads, following = np.full(13**3, -1, np.int32), np.full(count, -1, np.int32)
    grid = (heads.copy(), following.copy(), low)
    kernels.throw_points(points, normals, r.order(count), taken, *grid, 0.08, 0.07, dims, left, 0, 1)
    distances, closest = np.empty(count, F), np.empty(count, np.int64)
    kernels.fill_point_grid(points, low, 0.08, dims, heads, following, 0, 1)
    run(kernels.take_mean_distances, points, normals, heads, following, low, 0.08, dims, distances)
    at = r.uniform(0, 1, count, 3).astype(F)
    run(kernels.find_closest_centers, at, normals, points, normals, heads, following, low, 0.08, dims, 0.01, closest)
    assert 0 < taken.sum() < count and (closest >= 0).mean() > 0.5
    return [taken, left, distances, closest]


@golden("86dbfb6e098d4bb2")
def meshes() -> list[np.ndarray]:
    r, count, across, down = Numbers(11), 300, 12, 9
    low = np.stack([r.integers(across, count), r.integers(down, count)], 1)
    high = np.minimum(low + r.integers(3, count, 2), [across - 1, down - 1])
    counts = np.zeros(across * down, np.int64)
    kernels.count_tile_members(low, high, across, counts, 0, 1)
    starts = np.concatenate([[0], np.cumsum(counts)])
    members = np.empty(starts[-1], np.int64)
    kernels.list_tile_members(low, high, across, starts[:-1].copy(), members, 0, 1)
    corners = r.uniform(-1, 1, count, 3, 3) + np.array([0, 0, 3])
    points, tile = r.uniform(-2, 2, 2000, 3) + np.array([0, 0, 5]), r.integers(across * down, 2000)
    alpha, visible = r.integers(256, 16, 20).astype(np.uint8), np.ones(2000, bool)
    uvs = r.uniform(-2, 2, count, 3, 2)
    run(kernels.hide_points, points, tile, corners, uvs, alpha, starts, members, visible)
    assert 0.02 < visible.mean() < 0.98
    pixels, colors = r.integers(256, 9, 13, 3).astype(np.uint8), np.empty((900, 3), F)
    run(kernels.sample_bilinear, pixels, uvs.reshape(-1, 2).astype(F), np.arange(256, dtype=F) / F(255), colors)
    return [starts, members, visible, colors]


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("name", GOLDENS)
def test_bytes_are_the_same_everywhere(name: str, cpu: str, monkeypatch: pytest.MonkeyPatch):
    case, expected = GOLDENS[name]
    check(case, expected, cpu, monkeypatch)
