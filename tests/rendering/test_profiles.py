"""`render(profile=)`: against loops over one pixel at a time, against the reference, what is refused; size limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import splatpainter as sp
from splatpainter.rendering import MAX_PIXELS, MAX_SIDE_PX
from splatpainter.splats import SH_C0, Splats
from tests.support.render_scenes import cameras, opaque_stack, scene, with_odd_gaussians

CASES = {
    "degree 2": (scene(40, 2, 1), cameras(37, 29, count=2)),
    "antialiased": (scene(60, 1, 6, antialiased=True), cameras(31, 45, count=2)),
    "odd Gaussians": (with_odd_gaussians(scene(30, 1, 7)), cameras(35, 31, count=2)),
    "opaque": (opaque_stack(), cameras(32, 32)),
}


@pytest.mark.parametrize("name", CASES)
def test_playcanvas_matches_the_reference(name):
    splats, views = CASES[name]
    ours = sp.render(splats, views, contributions=True, profile="playcanvas")
    theirs = sp.render(splats, views, contributions=True, profile="playcanvas", backend="reference")
    for field in ("colors", "alphas", "depths", "contributions"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-9, atol=1e-9, err_msg=field)


def round_splats(count: int) -> tuple[Splats, sp.Camera]:
    """Spheres on the optical axis, seen at 100 px focal length from where 0.02 z is 1 px; the last ones opaque."""
    rng = np.random.default_rng(0)
    z = np.sort(rng.uniform(2, 4, count))
    opacities = np.where(np.arange(count) % 3 == 2, 1.0, rng.uniform(0.05, 0.9, count))
    means = np.stack([0 * z, 0 * z, z], 1)
    sh = rng.normal(0, 0.5, (count, 1, 3))
    splats = Splats(means, np.tile([1.0, 0, 0, 0], (count, 1)), np.tile(0.02 * z[:, None], (1, 3)), opacities, sh)
    return splats, sp.Camera(11, 11, 100, 100, 5.5, 5.5, np.eye(4), (0.2, 0.3, 0.4))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("profile", ["inria", "playcanvas"])
def test_profiles_by_hand(profile, backend):
    """splat-transform's rasterize-binned.ts, and gsplat's loop, written down once more for variances of 2^2 + 0.3."""
    splats, view = round_splats(9)
    picture = sp.render(splats, view, profile=profile, backend=backend)
    deepest = 1.0
    for y in range(11):
        for x in range(11):
            color, left = np.zeros(3), 1.0
            for i in range(9):
                power = -((x - 5) ** 2 + (y - 5) ** 2) / 2 / 4.3
                if profile == "inria":
                    alpha = min(0.999, splats.opacities[i] * math.exp(power))
                    if alpha >= 1 / 255 and left * (1 - alpha) <= 1e-4:
                        break
                else:
                    if left < 1e-4:
                        break
                    alpha = min(0.99, splats.opacities[i] * max(0.0, math.exp(power) - math.exp(-0.5 * 3 * 3)))
                if alpha < 1 / 255:
                    continue
                color += left * alpha * np.maximum(0.5 + SH_C0 * splats.sh[i, 0], 0)
                left *= 1 - alpha
            color += left * np.array(view.background)
            np.testing.assert_allclose(picture.colors[0, y, x], color, atol=1e-9)
            assert picture.alphas[0, y, x, 0] == pytest.approx(1 - left, abs=1e-9)
            deepest = min(deepest, left)
    # One takes the Gaussian that closes the pixel, the other does not.
    assert (deepest < 1e-4) == (profile == "playcanvas")


def test_inria_is_the_default_and_playcanvas_is_another_picture():
    splats, views = with_odd_gaussians(scene(30, 1, 7, dtype=np.float32)), cameras(35, 31)
    plain, named = sp.render(splats, views).alphas, sp.render(splats, views, profile="inria").alphas
    other = sp.render(splats, views, profile="playcanvas").alphas
    np.testing.assert_array_equal(plain, named)
    assert (other <= plain + 1e-6).all() and (other < plain - 0.005).mean() > 0.05


def test_gradients_of_other_profiles_are_the_references_only():
    splats, view = scene(10, 0).torch(dtype=torch.float64), cameras(16, 16)[0]
    splats = replace(splats, means=splats.means.requires_grad_())
    with pytest.raises(ValueError, match="profile 'inria' or backend 'reference' for gradients") as error:
        sp.render(splats, view, profile="playcanvas")
    assert "\n" not in str(error.value)
    with torch.no_grad():
        ours = sp.render(splats, view, profile="playcanvas").colors
    theirs = sp.render(splats, view, profile="playcanvas", backend="reference").colors
    np.testing.assert_allclose(ours, theirs.detach(), atol=1e-9)
    theirs.sum().backward()
    assert splats.means.grad.abs().max() > 0


def test_a_profile_that_is_not_there():
    with pytest.raises(ValueError, match="expected a profile of inria, playcanvas, got 'webgl'") as error:
        sp.render(scene(10, 0), cameras(16, 16), profile="webgl")  # pyright: ignore[reportArgumentType]
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("size", [(MAX_SIDE_PX + 1, 1), (1, MAX_SIDE_PX + 1), (1 << 20, 1 << 20), (MAX_SIDE_PX,) * 2])
def test_sizes_above_the_limit_are_refused_in_one_line(size):
    width, height = size
    views = [sp.Camera(width, height, 50, 50, 1, 1, np.eye(4))] * 5
    assert MAX_PIXELS < 5 * MAX_SIDE_PX**2
    for backend in ("cpu", "reference"):
        with pytest.raises(ValueError, match="expected views of 1 to 8192 pixels a side") as error:
            sp.render(scene(2, 0), views if width == height else views[0], backend=backend)
        assert "\n" not in str(error.value) and f"{width} x {height}" in str(error.value)
