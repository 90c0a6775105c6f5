"""Cells and Gaussians of sheets, against the formulas in numpy, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.lift.sheets.resurface import RESURFACING, _within_horizon
from splatpainter.lift.sheets.sheet import SHEET, Cells, SheetGeometry, flat_cells, pixel_gaussians
from splatpainter.splats import Splats
from splatpainter.surface.visible import depths_along
from splatpainter.transforms import matrix_to_quat, quat_to_matrix, row_norm, turned

CAMERA = look_at((1.0, 0.5, -4.0), (0, 0, 0), width=48, height=40)


@pytest.fixture(autouse=True, params=["1", "3"])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", request.param)


def expected_cells(colors: np.ndarray, covered: np.ndarray, depth: np.ndarray, fx: float) -> list[tuple[int, int, int]]:
    """(size, y, x) of the cells, the largest first, row by row: every block is looked at by itself."""
    left, out, largest = covered.copy(), [], SHEET.max_cell_px
    shape = [-(-length // largest) * largest for length in covered.shape]
    solid = np.zeros(shape, bool)
    solid[: covered.shape[0], : covered.shape[1]] = covered
    for size in (8, 4, 2, 1):
        for y in range(0, covered.shape[0] - size + 1, size):
            for x in range(0, covered.shape[1] - size + 1, size):
                block = (slice(y, y + size), slice(x, x + size))
                around = (slice(max(y - size, 0), y + 2 * size), slice(max(x - size, 0), x + 2 * size))
                if not left[block].all():
                    continue
                if size > 1:
                    inverse, last, half = 1 / depth[block], size - 1, size // 2
                    corners = [inverse[j, k] for j in (0, last) for k in (0, last)]
                    middle = inverse[half - 1 : half + 1, half - 1 : half + 1]
                    middle = ((middle[0, 0] + middle[0, 1]) + (middle[1, 0] + middle[1, 1])) / 4
                    bend = abs(sum(corners) / 4 - middle) + abs(corners[0] + corners[3] - corners[1] - corners[2]) / 2
                    spread = np.ptp(colors[around].reshape(-1, 3), axis=0).max()
                    if not solid[around].all() or not spread < np.float32(SHEET.flat_range):
                        continue
                    if not bend < SHEET.flat_depth_cells * size / fx * middle:
                        continue
                out.append((size, y, x))
                left[block] = False
    return out


@pytest.mark.parametrize("shape", [(40, 48), (33, 29), (8, 64), (5, 3)])
def test_cells_are_as_large_as_colour_and_plane_allow(shape: tuple[int, int]):
    rng = np.random.default_rng(shape)
    height, width = shape
    blotches = rng.integers(0, 3, (-(-height // 12), -(-width // 12), 3)).repeat(12, 0).repeat(12, 1)[:height, :width]
    colors = (0.3 * blotches + rng.uniform(0, 0.02, (*shape, 3))).astype(np.float32)
    covered = rng.random(shape) < 0.995
    y, x = np.mgrid[:height, :width]
    depth = np.where(covered, 1 / (0.2 + 0.001 * x + 0.002 * y + 0.01 * (x > width - 9) * (y % 5 == 0)), 0)
    cells = flat_cells(colors, covered, depth, 50.0)
    expected = expected_cells(colors, covered, depth, 50.0)
    sizes = np.array([size for size, _, _ in expected], float)
    np.testing.assert_array_equal(cells.sizes, sizes)
    np.testing.assert_array_equal(cells.centers, [(x + size / 2, y + size / 2) for size, y, x in expected])
    assert (cells.sizes**2).sum() == covered.sum()
    if height * width > 500:
        assert len(np.unique(cells.sizes)) >= 3, "the scene has cells of too few sizes"


def test_gaussians_of_a_sheet_lie_as_the_formula_says():
    rng, count = np.random.default_rng(3), 500
    pixels, depth = rng.uniform(0, 40, (count, 2)), rng.uniform(3, 5, count)
    normals = rng.normal(0, 0.6, (count, 3)) - (0, 0, 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rays = CAMERA.sight_lines(pixels)
    view = rays / row_norm(rays)[:, None]
    normals[:30] = -view[:30]  # facing the camera: no slant
    width, cell = rng.uniform(0.3, 5, (2, count))
    stretch, number, shift = rng.uniform(1, 8, count), rng.integers(1, 5, count), rng.uniform(-0.5, 0.5, count)
    result = pixel_gaussians(CAMERA, pixels, depth, normals, width, cell, stretch, number, shift)

    slant = normals - (normals * view).sum(1, keepdims=True) * view
    size = row_norm(slant)[:, None]
    fallback = np.cross(view, np.where(np.abs(view[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    across = np.where(size > 1e-6, np.cross(normals, slant / np.maximum(size, 1e-12)), np.cross(normals, fallback))
    across /= row_norm(across)[:, None]
    along = np.cross(normals, across)
    rotation = turned(CAMERA.world_to_camera[:3, :3].T, np.stack([across, along, normals], 2))
    assert (np.linalg.det(rotation) > 0.999).all()
    unit = depth / CAMERA.fx
    moved = (shift * cell * unit * stretch)[:, None] * (along @ CAMERA.world_to_camera[:3, :3])
    np.testing.assert_array_equal(result.quats, matrix_to_quat(rotation))
    np.testing.assert_allclose(result.means, CAMERA.unproject(depth, pixels) + moved, rtol=0, atol=1e-14)
    wide = width * depth / CAMERA.fx
    np.testing.assert_array_equal(
        result.scales, np.stack([wide, wide * stretch / number, wide * SHEET.thickness_ratio], 1)
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_hangs_past_the_horizon_is_moved_to_its_host(dtype: type):
    rng, count, hosts = np.random.default_rng(4), 600, 40
    pixels = rng.uniform((0, 0), (48, 40), (count, 2))
    means = CAMERA.unproject(rng.uniform(3.5, 4.5, count), pixels)
    geometry = SheetGeometry(means, rng.normal(size=(count, 4)), np.ones((count, 3)))
    of_hosts = (rng.normal(0, 0.4, (hosts, 3)), rng.normal(size=(hosts, 4)), rng.uniform(0.01, 0.6, (hosts, 3)))
    means_of, quats, scales = (values.astype(dtype) for values in of_hosts)
    hidden = Splats(means_of, quats, scales, np.ones(hosts, dtype), np.zeros((hosts, 1, 3), dtype))
    ids = rng.integers(0, hosts, count)
    heaviest = rng.integers(-1, hosts, (40, 48))
    result = _within_horizon(hidden, ids, heaviest, geometry, pixels, CAMERA)

    def sigmas(host: int, point: np.ndarray) -> float:
        scales = hidden.scales[host].astype(float)
        scales = np.maximum(scales, RESURFACING.min_host_flatness * scales.max())
        axes = quat_to_matrix(hidden.quats[host : host + 1].astype(float))[0]
        return float(np.linalg.norm((point - hidden.means[host]) @ axes / scales))

    normals = quat_to_matrix(geometry.quats)[:, :, 2]
    sight = means - CAMERA.position
    facing = np.abs((normals * sight).sum(1)) / np.linalg.norm(sight, axis=1)
    moved = np.zeros(count, bool)
    for k in np.flatnonzero(facing < np.cos(np.radians(RESURFACING.horizon_degrees))):
        x, y = pixels[k].astype(int)
        ys, xs = (np.clip(np.arange(at - 2, at + 3), 0, most) for at, most in ((y, 39), (x, 47)))
        near = [host for host in heaviest[np.ix_(ys, xs)].ravel() if host >= 0]
        moved[k] = all(sigmas(host, means[k]) > RESURFACING.max_host_sigmas for host in [ids[k], *near])
    depth, _ = depths_along(hidden, ids, CAMERA, CAMERA.sight_lines(pixels))
    expected = np.where((moved & (depth > 0))[:, None], CAMERA.unproject(depth, pixels), means)
    np.testing.assert_array_equal(result, expected)
    assert moved.sum() > 20 and not moved.all()
    nothing = replace(geometry, means=means[:0], quats=geometry.quats[:0])
    assert _within_horizon(hidden, ids[:0], heaviest, nothing, pixels[:0], CAMERA).shape == (0, 3)


def test_a_sheet_without_cells_is_empty():
    none = np.zeros((8, 8), bool)
    none[2, 3] = True
    cells = flat_cells(np.zeros((8, 8, 3), np.float32), none, none.astype(float), 50.0)
    assert isinstance(cells, Cells) and cells.centers.tolist() == [[3.5, 2.5]] and cells.sizes.tolist() == [1]
