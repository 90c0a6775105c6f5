"""Gaussians outside their range: drawn by no backend, seen by no gradient, and no reason for a crash or a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import splatpainter as sp
from splatpainter.cameras import bounding_sphere
from splatpainter.kernels.library import kernels
from splatpainter.rendering.cpu import projected_view
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import voxelize
from tests.support.render_scenes import cameras, scene

EXTREME = {
    "opacities": [3.4e38, 1e30, 1.01, -0.1, np.inf, np.nan],
    "means": [1e16, 1e30, -3e38, np.inf, np.nan],
    "scales": [1e16, 1e30, 3e38, np.inf, np.nan, 0, -1],
    "quats": [1e16, 1e30, 3e38, np.inf, np.nan],
    "sh": [1e16, -1e38, np.inf, np.nan],
}


def hostile(dtype: type) -> Splats:
    """Sound Gaussians, and for each extreme value one that has it in its last number, and one that has it
    everywhere."""
    parts = [scene(40, 2, 3, dtype=dtype)]
    for name, values in EXTREME.items():
        for value in values:
            bad = scene(2, 2, 4, dtype=dtype)
            bad.scales[:], bad.opacities[:] = 0.3, 0.9
            column = getattr(bad, name)
            column.reshape(2, -1)[0, -1], column[1] = value, value
            parts.append(bad)
    splats = parts[0]
    for part in parts[1:]:
        splats = part.append(splats)
    return splats


@pytest.mark.parametrize("size", [(5, 3), (64, 48), (400, 300)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gaussians_out_of_range_are_invisible_and_counted(dtype, size):
    splats, views = hostile(dtype), cameras(*size)
    assert (~splats.drawable).sum() == 2 * sum(map(len, EXTREME.values()))
    valid = splats.take(splats.drawable)
    for profile in ("inria", "playcanvas"):
        with_them = sp.render(splats, views, contributions=True, profile=profile)
        without = sp.render(valid, views, contributions=True, profile=profile)
        for name in ("colors", "alphas", "depths"):
            np.testing.assert_array_equal(getattr(with_them, name), getattr(without, name))
        assert with_them.contributions is not None
        assert not with_them.contributions[:, ~splats.drawable].any()


def test_the_reference_leaves_the_same_gaussians_out():
    splats, views = hostile(np.float64), cameras(24, 20)
    ours = sp.render(splats, views, contributions=True)
    theirs = sp.render(splats, views, contributions=True, backend="reference")
    np.testing.assert_allclose(ours.colors, theirs.colors, atol=1e-9)
    assert ours.contributions is not None and theirs.contributions is not None
    np.testing.assert_allclose(ours.contributions, theirs.contributions, atol=1e-9)


def test_gaussians_out_of_range_have_no_gradient():
    splats = hostile(np.float32)
    leaves = {name: torch.from_numpy(getattr(splats, name)).requires_grad_() for name in ATTRIBUTES}
    picture = sp.render(replace(splats, **leaves), cameras(48, 40))
    (picture.colors.sum() + picture.depths.sum()).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None and leaf.grad.isfinite().all(), name
        assert not leaf.grad[torch.from_numpy(~splats.drawable)].any(), name


@pytest.mark.parametrize("eye", [1e-3, 1e9, 1e30, 1e100])
def test_cameras_at_any_distance_draw_finite_pictures(eye):
    view = sp.look_at([0, 0, eye], [0, 0, 0], width=32, height=32)
    wide = sp.Camera(32, 32, 1e300, 1e-300, 1e300, -1e300, view.world_to_camera)
    for camera in (view, wide):
        for values in vars(sp.render(hostile(np.float32), camera)).values():
            assert values is None or np.isfinite(values).all()


def test_huge_footprints_are_drawn_or_left_out_but_never_overflow():
    splats = scene(60, 1, 5, dtype=np.float32)
    splats.scales[:] = np.geomspace(1e-30, 1e15, 180).reshape(60, 3)
    splats.means[:20] *= 1e14
    picture = sp.render(splats, cameras(40, 40), contributions=True)
    assert np.isfinite(picture.colors).all() and splats.drawable.all()


def test_framing_and_voxels_leave_them_out_without_a_warning():
    splats = hostile(np.float32)
    valid = splats.take(splats.drawable)
    np.testing.assert_array_equal(bounding_sphere(splats)[0], bounding_sphere(valid)[0])
    assert (voxelize(splats, 8).index >= 0).sum() == len(valid)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e19, -1e19, 0.0, -0.0, 1e-45])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_spans_are_within_their_bounds_whatever_comes_in(value, dtype):
    extents = np.array([0, 30, np.inf, np.nan], dtype)
    out = np.empty((len(extents), 5), np.int64)
    kernels.probe_spans(np.full_like(extents, value), extents, 2, 7, out, 0, 1)
    for clamped, first_tile, end_tile, first_block, end_block in out:
        assert 0 <= clamped <= 7
        assert 2 <= first_tile <= end_tile <= 7
        assert 0 <= first_block <= end_block <= 4 or end_block == 0


def test_more_gaussian_and_tile_pairs_than_indices_reach_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch):
    splats, view = scene(40, 0, dtype=np.float32), cameras(64, 64)[0]
    pairs = len(projected_view.project(splats, view).flatten_ids)
    monkeypatch.setattr(projected_view, "MAX_PAIRS", pairs - 1)
    with pytest.raises(
        ValueError, match="Gaussians that touch at most .* tiles of 16 x 16 pixels in all, got"
    ) as error:
        sp.render(splats, view)
    assert "\n" not in str(error.value)
