"""Pictures: CPU kernels against the torch reference, gsplat's own formulas, and a Gaussian worked out by hand."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import splatpainter as sp
from splatpainter.rendering import reference
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from tests.support.render_scenes import cameras, opaque_stack, scene, with_odd_gaussians

CASES = {
    "small": (scene(40, 1, 1), cameras(37, 29)),
    "one tile": (scene(40, 0, 2), cameras(16, 16)),
    "views": (scene(30, 2, 3), cameras(23, 40, count=3)),
    "degree 3": (scene(30, 3, 4), cameras(33, 17, count=2)),
    "degree 4": (scene(30, 4, 5), cameras(20, 50, count=2)),
    "antialiased": (scene(60, 1, 6, antialiased=True), cameras(31, 45, count=2)),
    "odd Gaussians": (with_odd_gaussians(scene(30, 1, 7)), cameras(35, 31, count=2)),
    "odd Gaussians, antialiased": (with_odd_gaussians(scene(30, 4, 8, antialiased=True)), cameras(41, 33)),
    "wide": (with_odd_gaussians(scene(30, 1, 9)), cameras(64, 24, count=2, fov=100)),
    "opaque": (opaque_stack(), cameras(32, 32)),
    "no Gaussians": (scene(0, 1), cameras(17, 5)),
    "one pixel": (scene(40, 1, 10), cameras(1, 1)),
}


@pytest.mark.parametrize("name", CASES)
def test_matches_the_reference(name):
    splats, views = CASES[name]
    ours = sp.render(splats, views, contributions=True)
    theirs = sp.render(splats, views, backend="reference", contributions=True)
    assert ours.colors.shape == (len(views), views[0].height, views[0].width, 3)
    assert ours.contributions is not None and ours.contributions.shape == (len(views), len(splats))
    # Float64 rounding only: both sides take the same Gaussians at the same pixels.
    for field in ("colors", "alphas", "depths", "contributions"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-9, atol=1e-9, err_msg=field)


def test_cases_exercise_what_they_name():
    """Guards the cases above: a stack that stops, Gaussians that reach over the picture's edge, Gaussians that are
    hidden."""
    splats, views = CASES["opaque"]
    alpha, *_ = reference.project(splats.torch(dtype=torch.float64), views[0])
    weight, _ = reference.composite(alpha)
    assert ((alpha > 0) & (weight == 0)).any() and alpha.max() == reference.MAX_ALPHA
    splats, views = CASES["odd Gaussians"]
    drawn = sp.render(splats, views, contributions=True).contributions
    assert drawn is not None
    assert not drawn[:, [*range(15), *range(50, 65)]].any() and drawn[0, 16] > 0 and drawn[0, 17] > 0


def test_float32_is_close_to_float64():
    splats, views = with_odd_gaussians(scene(200, 3, 11)), cameras(48, 40, count=2)
    exact = sp.render(splats, views)
    single = sp.render(
        replace(splats, **{name: getattr(splats, name).astype(np.float32) for name in ATTRIBUTES}), views
    )
    assert single.colors.dtype == np.float32
    # A pixel on the edge of the 1/255 cut or of the stop may go either way: allow a few such, each by one small step.
    off = np.abs(single.colors - exact.colors)
    assert np.quantile(off, 0.99) < 2e-5 and off.max() < 5e-3


def one_gaussian(**changes) -> Splats:
    """Isotropic, on the optical axis of `axis_camera`, red 0.8, green 0.5, blue 0.1."""
    values = {
        "means": [[0, 0, 2]],
        "quats": [[1, 0, 0, 0]],
        "scales": [[0.02, 0.02, 0.02]],
        "opacities": [0.6],
        "sh": [[[0.3 / SH_C0, 0, -0.4 / SH_C0]]],
    }
    return Splats(**{name: np.array(value, np.float64) for name, value in values.items()}, **changes)


axis_camera = sp.Camera(3, 3, 100, 100, 1.5, 1.5, np.eye(4), (0.0, 0.0, 1.0))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_one_gaussian_by_hand(backend, antialiased):
    picture = sp.render(one_gaussian(antialiased=antialiased), axis_camera, backend=backend, contributions=True)
    # 0.02 at distance 2 and focal length 100 is 1 px: variance 1 + 0.3 px^2 along both axes.
    opacity = 0.6 * (1 / 1.3 if antialiased else 1)
    for x, y, squared in [(1, 1, 0), (0, 1, 1), (1, 2, 1), (2, 2, 2)]:
        alpha = opacity * math.exp(-squared / 2 / 1.3)
        assert picture.alphas[0, y, x, 0] == pytest.approx(alpha, abs=1e-12)
        assert picture.depths[0, y, x, 0] == pytest.approx(2, abs=1e-12)
        color = alpha * np.array([0.8, 0.5, 0.1]) + (1 - alpha) * np.array([0, 0, 1])
        np.testing.assert_allclose(picture.colors[0, y, x], color, atol=1e-12)
    assert picture.contributions is not None
    assert picture.contributions[0, 0] == pytest.approx(picture.alphas.sum(), abs=1e-12)


def test_equal_depths_are_drawn_in_gaussian_order():
    first, second = one_gaussian(), replace(one_gaussian(), sh=np.zeros((1, 1, 3)))
    for front, behind in [(first, second), (second, first)]:
        center = sp.render(front.append(behind), axis_camera, background=[0, 0, 0]).colors[0, 1, 1]
        colors = [np.maximum(0.5 + SH_C0 * each.sh[0, 0], 0) for each in (front, behind)]
        np.testing.assert_allclose(center, 0.6 * colors[0] + 0.4 * 0.6 * colors[1], atol=1e-12)


def test_order_of_gaussians_does_not_matter():
    splats, views = scene(300, 1, 12, dtype=np.float32), cameras(40, 40)
    assert len(np.unique(splats.means[:, 2])) == 300  # the first camera looks along -z: no equal depths
    order = np.random.default_rng(0).permutation(300)
    one, other = sp.render(splats, views, contributions=True), sp.render(splats.take(order), views, contributions=True)
    np.testing.assert_array_equal(one.colors, other.colors)
    assert one.contributions is not None and other.contributions is not None
    np.testing.assert_array_equal(one.contributions[:, order], other.contributions)


def gsplat_formulas() -> ModuleType:
    """gsplat/cuda/_torch_impl.py by its path: importing the package itself would compile CUDA kernels."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or spec.origin is None:
        pytest.skip("gsplat is not installed: no comparison with its torch formulas")
    path = Path(spec.origin).parent / "cuda" / "_torch_impl.py"
    source = importlib.util.spec_from_file_location("gsplat_torch_impl", path)
    assert source is not None and source.loader is not None
    module = importlib.util.module_from_spec(source)
    source.loader.exec_module(module)
    return module


@pytest.mark.parametrize("antialiased", [False, True])
def test_matches_gsplats_torch_formulas(antialiased):
    gsplat = gsplat_formulas()
    splats, views = scene(50, 3, 13, antialiased=antialiased), cameras(24, 19, count=2, fov=70)
    ours = sp.render(splats, views, background=[0.2, 0.4, 0.6])
    s = splats.torch(dtype=torch.float64)
    covariances, _ = gsplat._quat_scale_to_covar_preci(s.quats, s.scales, True, False)
    matrices = torch.tensor(np.stack([view.world_to_camera for view in views]))
    intrinsics = torch.tensor(np.stack([view.intrinsics for view in views]))
    _, centers, depths, conics, compensations = gsplat._fully_fused_projection(
        s.means, covariances, matrices, intrinsics, 24, 19, calc_compensations=True
    )
    for c, view in enumerate(views):
        directions = s.means - torch.tensor(view.position)
        colors = (gsplat._spherical_harmonics(3, directions, s.sh) + 0.5).clamp_min(0).numpy()
        opacity = (s.opacities * compensations[c] if antialiased else s.opacities).numpy()
        order = [int(i) for i in torch.argsort(depths[c]) if depths[c, i] > 0.01]
        for y in range(19):
            for x in range(24):
                # gsplat's compositing loop (rasterize_to_pixels_3dgs_fwd), one pixel at a time
                left, color = 1.0, np.zeros(3)
                for i in order:
                    dx, dy = centers[c, i, 0].item() - (x + 0.5), centers[c, i, 1].item() - (y + 0.5)
                    a, b, d = conics[c, i].tolist()
                    alpha = min(0.999, opacity[i] * math.exp(-0.5 * (a * dx * dx + d * dy * dy) - b * dx * dy))
                    if alpha < 1 / 255:
                        continue
                    if left * (1 - alpha) <= 1e-4:
                        break
                    color += alpha * left * colors[i]
                    left *= 1 - alpha
                color += left * np.array([0.2, 0.4, 0.6])
                np.testing.assert_allclose(ours.colors[c, y, x], color, atol=1e-8)
                assert ours.alphas[c, y, x, 0] == pytest.approx(1 - left, abs=1e-8)
