"""Gradients: kernels against autograd through the reference, and both against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import splatpainter as sp
from splatpainter.rendering import reference
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.render_scenes import cameras, opaque_stack, scene, with_odd_gaussians


def gradients(splats: Splats, views, background, backend, seed: int = 0) -> dict[str, np.ndarray]:
    """Of a random linear function of colours, alphas and depths."""
    leaves = {name: torch.tensor(getattr(splats, name)).requires_grad_() for name in ATTRIBUTES}
    behind = torch.tensor(background, dtype=torch.float64).requires_grad_()
    picture = sp.render(replace(splats, **leaves), views, background=behind, backend=backend)
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros((), dtype=torch.float64)
    for output in (picture.colors, picture.alphas, picture.depths):
        total = total + (output * torch.randn(output.shape, generator=generator, dtype=torch.float64)).sum()
    total.backward()
    return {name: np.asarray(leaf.grad) for name, leaf in {**leaves, "background": behind}.items()}


@pytest.mark.parametrize(
    "splats, views",
    [
        (scene(40, 2, 1), cameras(29, 37, count=2)),
        (with_odd_gaussians(scene(30, 4, 2)), cameras(40, 24, count=2, fov=80)),
        (with_odd_gaussians(scene(30, 1, 3, antialiased=True)), cameras(33, 33)),
        (opaque_stack(), cameras(20, 20)),
    ],
    ids=["views", "odd Gaussians", "antialiased", "opaque"],
)
def test_match_autograd_through_the_reference(splats, views):
    background = np.linspace(0.1, 0.9, 3 * len(views)).reshape(-1, 3)
    ours = gradients(splats, views, background, "cpu")
    theirs = gradients(splats, views, background, "reference")
    for name, expected in theirs.items():
        assert np.abs(expected).max() > 0, name
        # Relative to the attribute's largest gradient: float64 sums of some thousand terms in another order.
        np.testing.assert_allclose(ours[name], expected, rtol=1e-7, atol=1e-10 * np.abs(expected).max(), err_msg=name)


def test_a_gaussian_beyond_the_jacobian_limits_is_covered():
    """Guards the case "odd Gaussians": the clamp of the linearisation has a branch of its own in the backward pass."""
    splats, view = with_odd_gaussians(scene(30, 4, 2)), cameras(40, 24, fov=80)[0]
    drawn = sp.render(splats, view, contributions=True).contributions
    assert drawn is not None
    local = splats.means[drawn[0] > 0] @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    assert (np.abs(local[:, 0] / local[:, 2]) > 0.65 * view.width / view.fx).any()


@pytest.mark.parametrize("antialiased", [False, True])
def test_match_central_differences(antialiased):
    """Every number of four Gaussians, SH degree 4, moved by +-1e-5 (truncation of order 1e-10, rounding of order 1e-11
    of the loss). The renderer is smooth only between its cuts, so the scene keeps clear of them all, which is checked
    first: no alpha below 1/255 (hence Gaussians wider than the picture of 7 x 6 pixels, yet only about 2 px, so that
    the 0.3 px blur matters) or near the cap, no pixel near the stop, no colour near 0, no two depths alike. Rotations
    and view directions lie along no axis, so that every entry of their Jacobians counts."""
    rng = np.random.default_rng(3)
    splats = Splats(
        means=np.array([[-0.3, 0.1, 0.4], [0.2, -0.2, 0.1], [0.0, 0.3, -0.2], [0.3, 0.1, -0.5]]),
        quats=rng.normal(0, 1, (4, 4)),
        scales=rng.uniform(0.7, 1.2, (4, 3)),
        opacities=np.array([0.5, 0.7, 0.6, 0.8]),
        sh=np.concatenate([rng.uniform(0.5, 1, (4, 1, 3)), rng.normal(0, 0.05, (4, 24, 3))], 1),
        antialiased=antialiased,
    )
    view = replace(cameras(7, 6)[0], cx=3.2, cy=3.3)
    alpha, depth, color, _ = reference.project(splats.torch(dtype=torch.float64), view)
    _, left = reference.composite(alpha)
    assert 1.1 / 255 < alpha.min() and alpha.max() < 0.9 and left.min() > 1e-2
    assert len(alpha) == 4 and color.min() > 0.05 and depth.diff().min() > 0.1

    weights = [rng.normal(0, 1, (1, 6, 7, channels)) for channels in (3, 1, 1)]

    def loss(values: Splats) -> float:
        picture = sp.render(values, view)
        outputs = (picture.colors, picture.alphas, picture.depths)
        return sum(float((o * w).sum()) for o, w in zip(outputs, weights, strict=True))

    expected = {}
    for name in ATTRIBUTES:
        values = getattr(splats, name)
        expected[name] = np.empty(values.shape)
        for index in np.ndindex(values.shape):
            moved = []
            for step in (1e-5, -1e-5):
                changed = values.copy()
                changed[index] += step
                moved.append(loss(replace(splats, **{name: changed})))
            expected[name][index] = (moved[0] - moved[1]) / 2e-5

    leaves = {name: torch.tensor(getattr(splats, name)).requires_grad_() for name in ATTRIBUTES}
    for backend in ("cpu", "reference"):
        picture = sp.render(replace(splats, **leaves), view, backend=backend)
        outputs = (picture.colors, picture.alphas, picture.depths)
        total = torch.stack([(o * torch.tensor(w)).sum() for o, w in zip(outputs, weights, strict=True)]).sum()
        gradients = dict(zip(ATTRIBUTES, torch.autograd.grad(total, list(leaves.values())), strict=True))
        for name in ATTRIBUTES:
            scale = np.abs(expected[name]).max()
            assert scale > 1e-3, name
            np.testing.assert_allclose(gradients[name], expected[name], rtol=1e-6, atol=1e-8 * scale, err_msg=name)


def test_float32_gradients_are_close():
    splats, views = scene(300, 3, 4), cameras(48, 48, count=2)
    exact = gradients(splats, views, [0.0, 0.0, 0.0], "cpu")
    leaves = {name: torch.tensor(getattr(splats, name), dtype=torch.float32).requires_grad_() for name in ATTRIBUTES}
    picture = sp.render(replace(splats, **leaves), views, background=[0.0, 0.0, 0.0])
    generator = torch.Generator().manual_seed(0)
    outputs = (picture.colors, picture.alphas, picture.depths)
    total = torch.stack(
        [(o * torch.randn(o.shape, generator=generator, dtype=torch.float64).float()).sum() for o in outputs]
    ).sum()
    total.backward()
    for name, leaf in leaves.items():
        error = np.linalg.norm(np.asarray(leaf.grad) - exact[name]) / np.linalg.norm(exact[name])
        assert error < 2e-3, (name, error)


def test_only_what_requires_gradients_gets_them():
    splats = scene(10, 1, 5).torch(dtype=torch.float64)
    colors = splats.sh.clone().requires_grad_()
    picture = sp.render(replace(splats, sh=colors), cameras(16, 16), contributions=True)
    assert picture.colors.requires_grad and not picture.contributions.requires_grad
    picture.colors.sum().backward()
    assert colors.grad is not None and colors.grad.abs().max() > 0
    assert not sp.render(splats, cameras(16, 16)).colors.requires_grad


@pytest.mark.parametrize("what", ["parameter", "picture"])
def test_a_tensor_changed_before_backward_is_an_error(what):
    splats = scene(10, 1, 6).torch(dtype=torch.float64)
    means = splats.means.clone().requires_grad_()
    moved = means * 1
    picture = sp.render(replace(splats, means=moved), cameras(16, 16))
    loss = picture.colors.sum()
    with torch.no_grad():
        (moved if what == "parameter" else picture.colors).add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
