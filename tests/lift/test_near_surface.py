"""Which Gaussians lie on the surface under a sheet, against the formula in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from splatpainter.cameras import look_at
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.sheets.near_surface import BESIDE, FAR_BEHIND, NEAR_SURFACE, TOUCHES, NearSurface
from splatpainter.splats import Splats
from splatpainter.surface.visible import PixelSurface
from splatpainter.transforms import quat_to_matrix

CAMERA = look_at((1.0, 0.5, -4.0), (0, 0, 0), width=48, height=40)


def near_surface(rng: np.random.Generator) -> tuple[NearSurface, np.ndarray]:
    """(a rough surface about 4 away, [H, W] bool the pixels that it covers)."""
    covered = np.zeros((40, 48), bool)
    covered[8:30, 10:40] = rng.random((22, 30)) < 0.8
    ys, xs = np.nonzero(covered)
    entry = np.full(covered.shape, -1, np.int64)
    entry[ys, xs] = np.arange(len(ys))
    normals = np.array((0.0, 0.0, -1.0)) + rng.normal(0, 0.3, (len(ys), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth, windows, residuals = rng.uniform((3.8, 0.05, 0), (4.2, 0.2, 0.02), (len(ys), 3)).T
    return NearSurface(
        nearest_pixels(covered), entry, PixelSurface(depth, normals, windows, residuals), CAMERA
    ), covered


def expected(near: NearSurface, splats: Splats) -> np.ndarray:
    """`sides` of all of some Gaussians, in numpy."""
    uv, z = CAMERA.project(splats.means.astype(np.float64))
    x, y = np.clip(np.nan_to_num(uv), 0, (47, 39)).astype(int).T
    line, column = np.divmod(near.nearest[y, x], 48)
    at, surface = near.entry[line, column], near.surface
    there = np.stack([column, line], 1) + 0.5
    normal = surface.normals[at] @ CAMERA.world_to_camera[:3, :3]
    height = ((splats.means - CAMERA.unproject(surface.depth[at], there)) * normal).sum(1)
    axes = quat_to_matrix(splats.quats.astype(np.float64))
    extent = np.linalg.norm(np.einsum("nik,ni->nk", axes, normal) * splats.scales, axis=1)
    limit = (
        NEAR_SURFACE.normal_sigmas * extent
        + NEAR_SURFACE.surface_windows * surface.windows[at]
        + 2 * surface.residuals[at]
    )
    far = height < -limit - NEAR_SURFACE.far_windows * surface.windows[at]
    return np.where(z > 0, np.where(np.abs(height) < limit, TOUCHES, np.where(far, FAR_BEHIND, BESIDE)), BESIDE)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_sides_are_those_of_the_formula(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    rng, count = np.random.default_rng(1), 4000
    near, _ = near_surface(rng)
    means = CAMERA.unproject(rng.uniform(2.5, 6, count), rng.uniform((-10, -10), (60, 50), (count, 2)))
    means[:9] = 2 * CAMERA.position - means[:9]  # behind the camera
    quats, scales = rng.normal(0, 1, (count, 4)), np.exp(rng.uniform(-5, 0, (count, 3)))
    means, quats, scales = (values.astype(np.float32) for values in (means, quats, scales))
    splats = Splats(means, quats, scales, np.ones(count, np.float32), np.zeros((count, 1, 3), np.float32))
    sides = near.sides(splats, np.arange(count))
    np.testing.assert_array_equal(sides, expected(near, splats))
    assert min(np.bincount(sides)) > 500 and not sides[:9].any()
    order = rng.permutation(count)
    np.testing.assert_array_equal(near.touches(splats, order), sides[order] == TOUCHES)
    some = order[:100]
    assert near.sides(splats, some[:0]).shape == (0,)


def test_gaussians_without_numbers_touch_nothing():
    near, _ = near_surface(np.random.default_rng(2))
    one = np.ones((3, 4), np.float32)
    splats = Splats(one[:, :3] * [[np.nan], [np.inf], [0]], one, one[:, :3], one[:, 0], one[:, None, :3])
    splats = replace(splats, means=splats.means.astype(np.float32), scales=splats.scales * np.float32(np.nan))
    assert not near.touches(splats, np.arange(2)).any()


@pytest.mark.parametrize("shape", [(5, 3), (40, 16), (33, 50), (70, 131)])
@pytest.mark.parametrize("share", [0.003, 0.05, 0.9])
def test_the_nearest_pixel_is_as_near_as_any(shape: tuple[int, int], share: float):
    rng = np.random.default_rng(shape[1])
    mask = rng.random(shape) < share
    mask[shape[0] // 2, shape[1] // 3] = True
    nearest = np.stack(np.divmod(nearest_pixels(mask), shape[1]), -1)
    here = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    away, _ = KDTree(np.argwhere(mask)).query(here)
    assert mask[tuple(nearest.reshape(-1, 2).T)].all()
    apart = np.linalg.norm(nearest - here, axis=-1) - away
    assert apart.min() >= -1e-12 and apart.max() < 0.5 and (apart > 1e-9).mean() < 0.01
    assert (nearest_pixels(np.zeros(shape, bool)) == -1).all()
