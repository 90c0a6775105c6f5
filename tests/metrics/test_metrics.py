"""PSNR and SSIM against closed forms and scikit-image's numbers, LPIPS against the published network's."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpainter.metrics import Lpips, LpipsUnavailable, lpips, psnr, ssim, ssim_map


def pictures(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:height, :width]
    a = np.stack([0.5 + 0.5 * np.sin(x / 7 + y / 11), 0.5 + 0.4 * np.cos(x * y / 97), ((x * 3 + y * 5) % 17) / 17], -1)
    return a, np.clip(0.9 * a + 0.05 * np.sin(x + 2 * y)[..., None] + 0.03, 0, 1)


# scikit-image 0.26.0 on pictures(height, width): peak_signal_noise_ratio(a, b, data_range=1) and
# structural_similarity(a, b, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
# channel_axis=2); with full=True, its map's channels are averaged at [0, 0] and [20, 31] and over [:10, :20].
GOLDEN = {
    (48, 64): (25.83686559270638, 0.9245863843081447),
    (11, 23): (24.345472339185253, 0.8407953950231283),
}
GOLDEN_MAP = (0.780612033796817, 0.945268194966927, 0.8204381822155188)


@pytest.mark.parametrize("size", GOLDEN)
def test_psnr_and_ssim_are_those_of_scikit_image(size: tuple[int, int]) -> None:
    a, b = pictures(*size)
    assert psnr(a, b) == pytest.approx(GOLDEN[size][0], abs=1e-9)
    assert ssim(a, b) == pytest.approx(GOLDEN[size][1], abs=1e-9)


def test_the_ssim_map_and_its_mean_over_a_mask_are_those_of_scikit_image() -> None:
    a, b = pictures(48, 64)
    values = ssim_map(a, b)
    mask = np.zeros((48, 64), bool)
    mask[:10, :20] = True
    assert (values[0, 0], values[20, 31], ssim(a, b, mask)) == pytest.approx(GOLDEN_MAP, abs=1e-9)


def test_psnr_of_a_constant_difference_is_its_closed_form() -> None:
    a = np.full((4, 6, 3), 0.25)
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a) == math.inf
    b = a.copy()
    b[0, 0, 2] += 0.5  # one value of 72
    assert psnr(a, b) == pytest.approx(-10 * math.log10(0.25 / 72))
    assert psnr(a[..., 0], b[..., 2]) == pytest.approx(-10 * math.log10(0.25 / 24))


def test_a_mask_counts_only_its_pixels_and_weights_count_in_proportion() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((20, 30, 3)), rng.random((20, 30, 3))
    mask = rng.random((20, 30)) < 0.3
    assert psnr(a, b, mask) == pytest.approx(-10 * math.log10(((a - b)[mask] ** 2).mean()))
    assert psnr(a, np.where(mask[..., None], a, b), mask) == math.inf
    weights = rng.random((20, 30))
    expected = ((a - b) ** 2).mean(2)
    assert psnr(a, b, weights) == pytest.approx(-10 * math.log10((expected * weights).sum() / weights.sum()))
    assert psnr(a, b, 3 * weights) == pytest.approx(psnr(a, b, weights))


def test_ssim_of_flat_pictures_is_its_luminance_term() -> None:
    a, b = np.full((15, 15), 0.2), np.full((15, 15), 0.6)
    assert ssim(a, a) == pytest.approx(1)
    assert ssim(a, b) == pytest.approx((2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4))
    # Opposite patterns of equal mean: the structure term is -1 but for its constant.
    pattern = np.indices((32, 32)).sum(0) % 2 * 0.5
    assert ssim(0.25 + pattern, 0.75 - pattern) < -0.95


def test_ssim_changes_only_near_a_change() -> None:
    a, _ = pictures(60, 60)
    b = a.copy()
    b[:20, :20] = 1 - b[:20, :20]
    values = ssim_map(a, b)
    np.testing.assert_allclose(values[25:, :], 1, atol=1e-9)
    assert values[:20, :20].mean() < 0.6


@pytest.mark.parametrize(
    ("a", "b", "mask", "line"),
    [
        ((4, 4, 3), (4, 5, 3), None, r"PSNR: expected two pictures \[H, W\] or \[H, W, C\] of one shape, got .*"),
        ((4, 4, 3), (4, 4, 3), (4, 3), r"PSNR: expected a mask of shape \(4, 4\), got \(4, 3\)"),
        ((4, 4, 3), (4, 4, 3), 0, r"PSNR: expected a mask with at least one pixel and no negative weight"),
        ((4, 4, 3), (4, 4, 3), -1, r"PSNR: expected a mask with at least one pixel and no negative weight"),
    ],
)
def test_wrong_shapes_and_empty_masks_are_refused_in_one_line(a, b, mask, line: str) -> None:
    weights = None if mask is None else np.ones(mask) if isinstance(mask, tuple) else np.full((4, 4), mask)
    with pytest.raises(ValueError, match=f"^{line}$"):
        psnr(np.zeros(a), np.zeros(b), weights)


def test_eight_bit_and_tiny_pictures_are_refused() -> None:
    with pytest.raises(ValueError, match="expected floats in 0..1, got uint8"):
        psnr(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="SSIM: expected pictures of at least 11x11 pixels, got 12x10"):
        ssim(np.zeros((10, 12)), np.zeros((10, 12)))


@pytest.fixture(scope="module")
def weights(shared: Path) -> Path:
    if not (shared / "perceptual" / "lpips_alex.safetensors").exists():
        pytest.skip("no LPIPS weights in the shared folder")
    return shared / "perceptual"


# Published with the weights: mean distance of torch.rand(10, 3, 100, 100) twice after manual_seed.
@pytest.mark.shared
@pytest.mark.parametrize(
    ("net", "seed", "expected"),
    [("squeeze", 123, 0.1008), ("alex", 123, 0.1486), ("squeeze", 42, 0.1005), ("alex", 42, 0.1469)],
)
def test_lpips_of_noise_is_the_published_networks(weights: Path, net, seed: int, expected: float) -> None:
    import torch

    torch.manual_seed(seed)
    a, b = torch.rand(10, 3, 100, 100), torch.rand(10, 3, 100, 100)
    assert float(Lpips.load(net, weights)(a, b).mean()) == pytest.approx(expected, abs=2e-4)


@pytest.mark.shared
def test_lpips_of_arrays_is_zero_when_equal_and_masked_by_weight(weights: Path, monkeypatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_PERCEPTUAL", str(weights))
    a, b = (p.astype(np.float32) for p in pictures(64, 80))
    assert lpips(a, a) == 0
    assert 0.01 < lpips(a, b) < 1
    assert lpips(a, b, np.ones((64, 80))) == pytest.approx(lpips(a, b), rel=1e-4)
    half = b.copy()
    half[:, :40] = a[:, :40]
    left = np.zeros((64, 80), bool)
    left[:, :8] = True
    # The deepest features see far, so the equal side is not exactly zero.
    assert lpips(a, half, left) < 0.2 * lpips(a, half, ~left)


@pytest.mark.shared
def test_lpips_gradient_is_that_of_central_differences(weights: Path) -> None:
    """In float64, along one random direction: max-pooling and ReLU have kinks, which a small step seldom meets."""
    import torch

    network = Lpips.load("squeeze", weights).to(dtype=torch.float64)
    torch.manual_seed(0)
    a = torch.rand(1, 3, 40, 40, dtype=torch.float64, requires_grad=True)
    b, direction = torch.rand(2, 1, 3, 40, 40, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(network(a, b).sum(), a)
    step = 1e-6 * direction
    with torch.no_grad():
        slope = float((network(a + step, b) - network(a - step, b)).sum()) / 2e-6
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=1e-4)
    flat = torch.full((1, 3, 32, 32), 0.5, requires_grad=True)
    (still,) = torch.autograd.grad(Lpips.load("alex", weights)(flat, flat.detach()).sum(), flat)
    assert torch.isfinite(still).all()


def test_missing_weights_are_one_line_that_callers_can_tell(monkeypatch, tmp_path: Path) -> None:
    picture = np.zeros((40, 40, 3))
    monkeypatch.delenv("SPLATPAINTER_PERCEPTUAL", raising=False)
    with pytest.raises(LpipsUnavailable, match=r"^LPIPS: no weights; set SPLATPAINTER_PERCEPTUAL to [^\n]*$"):
        lpips(picture, picture)
    with pytest.raises(LpipsUnavailable, match=r"^LPIPS: no weights; expected the file [^\n]*lpips_alex.safetensors"):
        lpips(picture, picture, folder=tmp_path)
    (tmp_path / "lpips_alex.safetensors").write_bytes(b"not tensors")
    with pytest.raises(ValueError, match=r"lpips_alex.safetensors: expected a safetensors file [^\n]*$") as caught:
        lpips(picture, picture, folder=tmp_path)
    assert not isinstance(caught.value, LpipsUnavailable)


def test_a_missing_safetensors_package_is_one_line(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "lpips_squeeze.safetensors").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(LpipsUnavailable, match=r"^LPIPS: reading weights needs the safetensors package [^\n]*$"):
        Lpips.load("squeeze", tmp_path)


def test_weights_of_another_network_name_the_odd_tensor(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    save_file({"heads.0": np.zeros(64, np.float16)}, tmp_path / "lpips_alex.safetensors")
    with pytest.raises(ValueError, match=r"expected the 15 tensors of LPIPS alex; first missing or unknown: heads.1$"):
        Lpips.load("alex", tmp_path)


@pytest.mark.shared
def test_pictures_too_small_for_the_network_are_refused(weights: Path) -> None:
    with pytest.raises(ValueError, match="at least 32x32"):
        lpips(np.zeros((31, 64, 3)), np.zeros((31, 64, 3)), folder=weights)
    for net in ("alex", "squeeze"):
        assert lpips(np.zeros((32, 32, 3)), np.zeros((32, 32, 3)), net=net, folder=weights) == 0
