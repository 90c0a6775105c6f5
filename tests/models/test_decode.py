"""The decoder: bitwise identity at zero, closed forms, gradients that survive the zero initialisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpainter.models.decode import (
    LIMITS,
    AttributeHead,
    absolute,
    apply_residual,
    bounded,
    init_children,
    output_count,
)
from splatpainter.splats import ATTRIBUTES, Splats


def some_gaussians(count: int = 40, degree: int = 3, dtype: torch.dtype = torch.float32) -> Splats[Tensor]:
    g = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    return Splats(
        means=normal(count, 3).to(dtype),
        quats=(3 * normal(count, 4)).to(dtype),
        scales=torch.exp(normal(count, 3) - 3).to(dtype),
        opacities=torch.sigmoid(normal(count)).to(dtype),
        sh=normal(count, (degree + 1) ** 2, 3).to(dtype),
    )


def bits(values: Tensor) -> np.ndarray:
    return values.detach().numpy().view(np.int32)


def test_a_zero_residual_returns_the_very_same_bits() -> None:
    gaussians = some_gaussians()
    odd = gaussians.means.clone()
    odd[0] = torch.tensor([-0.0, 0.0, 1e-42])  # a sign and a denormal that x + 0 or exp(log x) would lose
    opacities = gaussians.opacities.clone()
    opacities[:4] = torch.tensor([0.0, 1.0, 1e-30, -0.0])
    scales = gaussians.scales.clone()
    scales[0] = torch.tensor([1e-30, 3e30, 1e-41])
    gaussians = replace(gaussians, means=odd, opacities=opacities, scales=scales)
    for zero in (0.0, -0.0):
        same = apply_residual(gaussians, torch.full((len(gaussians), output_count(3)), zero), 0.1)
        for name in ATTRIBUTES:
            assert (bits(getattr(same, name)) == bits(getattr(gaussians, name))).all(), name


def test_one_moved_number_moves_nothing_else() -> None:
    gaussians = some_gaussians()
    residual = torch.zeros(len(gaussians), output_count(3))
    residual[5, 4] = 0.5  # second log scale of Gaussian 5
    moved = apply_residual(gaussians, residual, 0.1)
    changed = {name: (bits(getattr(moved, name)) != bits(getattr(gaussians, name))) for name in ATTRIBUTES}
    assert changed["scales"].sum() == 1 and changed["scales"][5, 1]
    assert not any(changed[name].any() for name in ATTRIBUTES if name != "scales")


def test_closed_form() -> None:
    """Against the definition in numpy, float64: logs and logits taken."""
    gaussians = some_gaussians(degree=2)
    g = torch.Generator().manual_seed(4)
    residual = torch.randn(len(gaussians), output_count(2), generator=g)
    actual = apply_residual(gaussians, residual, 0.25).numpy()
    r, d = gaussians.numpy(), residual.numpy().astype(np.float64)
    values = {name: getattr(r, name).astype(np.float64) for name in ATTRIBUTES}
    logit = np.log(values["opacities"] / (1 - values["opacities"])) + d[:, 10]
    length = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    np.testing.assert_allclose(actual.means, values["means"] + 0.25 * d[:, :3], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.log(actual.scales), np.log(values["scales"]) + d[:, 3:6], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(actual.quats / length, values["quats"] / length + d[:, 6:10], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(actual.opacities, 1 / (1 + np.exp(-logit)), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(actual.sh, values["sh"] + d[:, 11:].reshape(len(r), -1, 3), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("asset", "model"), [(0, 3), (3, 1), (4, 3), (1, 1)])
def test_sh_degrees_of_asset_and_model_may_differ(asset: int, model: int) -> None:
    gaussians = some_gaussians(degree=asset)
    moved = apply_residual(gaussians, torch.ones(len(gaussians), output_count(model)), 0.1)
    common = (min(asset, model) + 1) ** 2
    assert moved.sh.shape == gaussians.sh.shape
    assert torch.equal(moved.sh[:, :common], gaussians.sh[:, :common] + 1)
    assert torch.equal(moved.sh[:, common:], gaussians.sh[:, common:])
    assert (
        absolute(gaussians, torch.ones(len(gaussians), output_count(model)), gaussians.means, 0.1).sh.shape
        == gaussians.sh.shape
    )


def test_fully_opaque_and_fully_transparent_gaussians_can_still_move() -> None:
    gaussians = replace(some_gaussians(2), opacities=torch.tensor([1.0, 0.0]))
    residual = torch.zeros(2, output_count(3))
    residual[0, 10], residual[1, 10] = -14.0, 14.0
    moved = apply_residual(gaussians, residual, 0.1)
    assert 0.3 < float(moved.opacities[0]) < 0.7 and 0.3 < float(moved.opacities[1]) < 0.7


def test_extreme_residuals_stay_finite() -> None:
    gaussians = some_gaussians()
    for size in (1e4, -1e4):
        moved = apply_residual(gaussians, torch.full((len(gaussians), output_count(3)), size), 0.1)
        for name in ATTRIBUTES:
            assert torch.isfinite(getattr(moved, name)).all(), name
        assert (moved.scales > 0).all() and (moved.opacities >= 0).all() and (moved.opacities <= 1).all()


def test_a_bounded_residual_keeps_gaussians_of_any_size_in_place() -> None:
    """However loud the network: not further away than their own size (or a voxel) allows, and not larger or smaller."""
    gaussians = some_gaussians()
    gaussians = replace(gaussians, scales=gaussians.scales * torch.logspace(-4, 1, len(gaussians))[:, None])
    head = AttributeHead(8, 3, "bounded")
    assert head.is_untrained
    centers = torch.zeros_like(gaussians.means)
    for size in (1e4, -1e4):
        moved = head.attributes(torch.full((len(gaussians), output_count(3)), size), gaussians, centers, voxel=0.05)
        away = (moved.means - gaussians.means).abs().amax(1)
        most = gaussians.scales.amax(1).clamp(max=0.05)
        assert (away <= most * LIMITS["centre"] + 1e-6 * gaussians.means.abs().amax(1)).all()
        growth = torch.log(moved.scales / gaussians.scales)
        torch.testing.assert_close(growth, torch.full_like(growth, np.sign(size) * LIMITS["scale"]))
    same = head.attributes(torch.zeros(len(gaussians), output_count(3)), gaussians, centers, voxel=0.05)
    assert all((bits(getattr(same, name)) == bits(getattr(gaussians, name))).all() for name in ATTRIBUTES)
    small = 1e-3 * torch.randn(5, output_count(1), generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(bounded(small), small, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("start", [0.0, 0.3])
def test_gradients_by_central_differences_also_at_zero(start: float) -> None:
    """float64, also exactly at the residual 0 where the Gaussian's own bits are returned: there a plain torch.where
    would say 0 and training could never begin."""
    gaussians = some_gaussians(3, degree=1, dtype=torch.float64)
    residual = torch.full((3, output_count(1)), start, dtype=torch.float64, requires_grad=True)
    generator = torch.Generator().manual_seed(9)
    cotangents = [
        torch.randn(getattr(gaussians, n).shape, generator=generator, dtype=torch.float64) for n in ATTRIBUTES
    ]

    def score(values: Tensor) -> Tensor:
        moved = apply_residual(gaussians, values, 0.2)
        return sum(
            ((getattr(moved, n) * c).sum() for n, c in zip(ATTRIBUTES, cotangents, strict=True)), torch.tensor(0.0)
        )

    score(residual).backward()
    assert residual.grad is not None
    step = 1e-5
    for index in np.ndindex(*residual.shape):
        nudge = torch.zeros_like(residual)
        nudge[index] = step
        with torch.no_grad():
            slope = (score(residual + nudge) - score(residual - nudge)) / (2 * step)
        assert float(residual.grad[index]) == pytest.approx(float(slope), rel=1e-6, abs=1e-8)
    assert (residual.grad != 0).all()


def test_a_fresh_head_is_the_identity_and_learns() -> None:
    gaussians, latents = some_gaussians(), torch.randn(40, 16, generator=torch.Generator().manual_seed(1))
    head = AttributeHead(16, 3, "residual")
    raw = head(latents)
    assert not raw.any() and head.is_untrained
    same = head.attributes(raw, gaussians, gaussians.means, 0.1)
    assert all((bits(getattr(same, n)) == bits(getattr(gaussians, n))).all() for n in ATTRIBUTES)
    optimizer = torch.optim.Adam(head.parameters(), 1e-2)
    target = gaussians.sh[:, 0] + 0.5
    errors = []
    for _ in range(30):
        loss = (head.attributes(head(latents), gaussians, gaussians.means, 0.1).sh[:, 0] - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(loss.detach()))
    assert errors[-1] < 0.3 * errors[0]
    assert not head.is_untrained


def test_absolute_depends_on_no_attribute_of_the_gaussian() -> None:
    head = AttributeHead(16, 3, "absolute")
    latents = torch.randn(40, 16, generator=torch.Generator().manual_seed(1))
    raw, centers = head(latents), torch.rand(40, 3)
    one, other = some_gaussians(), some_gaussians()
    other = replace(other, **{name: getattr(other, name) * 2 for name in ATTRIBUTES})
    a, b = (head.attributes(raw, gaussians, centers, 0.1) for gaussians in (one, other))
    assert raw.any() and all(torch.equal(getattr(a, n), getattr(b, n)) for n in ATTRIBUTES)
    calm = absolute(one, torch.zeros_like(raw), centers, 0.1)
    assert torch.equal(calm.means, centers) and (calm.opacities == 0.5).all() and (calm.scales == 0.05).all()


def test_children_are_smaller_and_fainter_and_keep_the_rest() -> None:
    gaussians = some_gaussians()
    child = init_children(gaussians)
    assert (child.scales < gaussians.scales).all() and (child.opacities < gaussians.opacities).all()
    assert all(getattr(child, n) is getattr(gaussians, n) for n in ("means", "quats", "sh"))
