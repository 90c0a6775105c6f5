"""The optimiser's loss is that of the metrics, and its gradient is that of autograd and of finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatpainter import metrics
from splatpainter.fit.image_loss import picture_loss
from splatpainter.fit.torch_loss import ssim_map, torch_loss


def pair(height: int = 21, width: int = 33, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.random((height, width, 3))
    return np.clip(target + 0.2 * rng.standard_normal(target.shape), -0.1, 1.1), target


def weights(shape: tuple[int, int], kind: str) -> np.ndarray | None:
    rng = np.random.default_rng(1)
    mask = rng.random(shape) > 0.3
    return {"all": None, "mask": mask.astype(np.float64), "weights": mask * rng.uniform(0, 2, shape)}[kind]


def test_the_ssim_term_is_the_metric() -> None:
    image, target = pair()
    loss, _ = picture_loss(image.astype(np.float32), target.astype(np.float32), None, 1.0)
    assert loss == pytest.approx(1 - metrics.ssim(image, target), abs=2e-6)
    inner = metrics.ssim_map(image, target)[5:-5, 5:-5]
    ours = ssim_map(torch.from_numpy(image), torch.from_numpy(target)).mean(2).numpy()
    np.testing.assert_allclose(ours, inner, atol=1e-6)
    heavy = weights(image.shape[:2], "mask")
    assert heavy is not None
    blended = np.where(heavy[..., None] > 0, image, target)
    expected = (heavy[5:-5, 5:-5] * (1 - metrics.ssim_map(blended, target)[5:-5, 5:-5])).mean()
    masked, _ = picture_loss(image.astype(np.float32), target.astype(np.float32), heavy.astype(np.float32), 1.0)
    assert masked == pytest.approx(expected, abs=2e-6)


def test_the_other_term_is_the_mean_absolute_difference() -> None:
    image, target = (a.astype(np.float32) for a in pair(4, 5))
    loss, slope = picture_loss(image, target, None, 0.0)
    assert loss == pytest.approx(np.abs(image - target).mean(), abs=1e-7)
    np.testing.assert_allclose(slope, np.sign(image - target) / image.size, rtol=1e-6)
    assert picture_loss(target, target, None, 0.0)[0] == 0


@pytest.mark.parametrize("kind", ["all", "mask", "weights"])
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_the_kernels_give_autograds_gradient(kind: str, share: float) -> None:
    image, target = pair()
    heavy = weights(image.shape[:2], kind)
    leaf = torch.from_numpy(image).requires_grad_()
    expected = torch_loss(leaf, torch.from_numpy(target), None if heavy is None else torch.from_numpy(heavy), share)
    expected.backward()
    single = None if heavy is None else heavy.astype(np.float32)
    loss, slope = picture_loss(image.astype(np.float32), target.astype(np.float32), single, share)
    assert loss == pytest.approx(expected.item(), abs=2e-6)
    assert leaf.grad is not None
    np.testing.assert_allclose(slope, leaf.grad.numpy(), atol=1e-5 * float(leaf.grad.abs().max()))


def test_the_torch_form_has_the_slope_of_central_differences() -> None:
    """Along random directions; float64, so that the differences are good to about 1e-9 of the slope."""
    image, target = (torch.from_numpy(a) for a in pair(13, 12))
    leaf = image.clone().requires_grad_()
    torch_loss(leaf, target, None, 0.7).backward()
    assert leaf.grad is not None
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        way = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        low, high = (float(torch_loss(image + s * 1e-6 * way, target, None, 0.7)) for s in (-1, 1))
        assert float((leaf.grad * way).sum()) == pytest.approx((high - low) / 2e-6, rel=1e-6)


def test_pixels_without_weight_have_no_influence() -> None:
    image, target = (a.astype(np.float32) for a in pair())
    heavy = np.ones(image.shape[:2], np.float32)
    heavy[:, 16:] = 0
    other = image.copy()
    other[:, 16:] = 7.0
    first, second = picture_loss(image, target, heavy, 0.5), picture_loss(other, target, heavy, 0.5)
    assert first[0] == second[0] and np.array_equal(first[1], second[1])
    assert not first[1][:, 16:].any() and first[1][:, :16].all()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_number_of_threads_changes_no_bit(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image, target = (a.astype(np.float32) for a in pair(40, 30))
    monkeypatch.setenv("SPLATPAINTER_THREADS", "1")
    loss, slope = picture_loss(image, target, None, 0.2)
    monkeypatch.setenv("SPLATPAINTER_THREADS", str(count))
    again, same = picture_loss(image, target, None, 0.2)
    assert again == loss and np.array_equal(slope, same)
