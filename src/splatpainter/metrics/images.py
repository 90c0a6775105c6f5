"""PSNR and SSIM of two pictures with values in 0..1, in float64 numpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

RADIUS = 5
"""SSIM's window reaches 5 pixels each way: 11 x 11."""
SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels."""
C1, C2 = 0.01**2, 0.03**2
"""SSIM's stabilising constants for a data range of 1."""


def psnr(a: Any, b: Any, mask: Any = None) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 of the mean squared difference over pixels and channels; inf when
    equal. a, b: [H, W] or [H, W, C] floats, 1 = white; mask: [H, W] bool, or weights >= 0, of the pixels that count.
    Raises ValueError when shapes differ, a picture is of integers, or no pixel counts."""
    first, second, weights = checked(a, b, mask, "PSNR")
    # Channels first, so that a mask weighs pixels and not channels.
    squared = ((first - second) ** 2).mean(2)
    error = float(squared.mean() if weights is None else (squared * weights).sum() / weights.sum())
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(a: Any, b: Any, mask: Any = None) -> float:
    """Mean structural similarity, at most 1: Wang, Bovik, Sheikh & Simoncelli, "Image Quality Assessment: From Error
    Visibility to Structural Similarity" (IEEE TIP 13(4), 2004), with its 11 x 11 Gaussian window of sigma 1.5, per
    channel, averaged.

    a, b: [H, W] or [H, W, C] floats, 1 = white. Without a mask, the mean over the pixels whose window lies in the
    picture (the paper's); with one ([H, W] bool, or weights >= 0), the mean of the whole `ssim_map` over it, so that
    an edit at the picture's edge counts too. Raises ValueError as psnr, and for a picture under 11 x 11 pixels."""
    first, second, weights = checked(a, b, mask, "SSIM")
    # Windows that reach beyond the picture see its mirror image: a mask may ask for them, the paper leaves them out.
    values = _ssim(first, second)
    if weights is None:
        return float(values[RADIUS:-RADIUS, RADIUS:-RADIUS].mean())
    return float((values * weights).sum() / weights.sum())


def ssim_map(a: Any, b: Any) -> np.ndarray:
    """[H, W] SSIM around each pixel, mean over channels; beyond the edges the pictures are mirrored. Arguments and
    errors as `ssim`."""
    first, second, _ = checked(a, b, None, "SSIM")
    return _ssim(first, second)


def _ssim(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # Moments under the window, not of deviations: five blurs in place of one window for every pixel.
    if min(a.shape[:2]) <= 2 * RADIUS:
        raise ValueError(f"SSIM: expected pictures of at least 11x11 pixels, got {a.shape[1]}x{a.shape[0]}")
    mean_a, mean_b = _blurred(a), _blurred(b)
    var_a = _blurred(a * a) - mean_a**2
    var_b = _blurred(b * b) - mean_b**2
    covariance = _blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    structure = (2 * covariance + C2) / (var_a + var_b + C2)
    return (luminance * structure).mean(2)


def _blurred(image: np.ndarray) -> np.ndarray:
    """[H, W, C] averaged under the window; the edge pixel is repeated when mirroring."""
    # Normalised, so that a flat picture stays what it is and its variance is 0.
    taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        width = [(RADIUS, RADIUS) if axis == k else (0, 0) for k in range(3)]
        padded = np.pad(image, width, "symmetric")
        rolled = np.moveaxis(padded, axis, 0)
        size = len(rolled) - 2 * RADIUS
        total = taps[0] * rolled[:size]
        for k in range(1, len(taps)):
            total += taps[k] * rolled[k : k + size]
        image = np.moveaxis(total, 0, axis)
    return image


def checked(a: Any, b: Any, mask: Any, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """([H, W, C], [H, W, C], [H, W] or None) in float64, or a ValueError of one line that begins with `name`."""
    pictures = []
    # 8-bit pictures would score as if 255 were 1: refused, as the number would look plausible.
    for picture in (a, b):
        array = np.asarray(picture)
        if array.dtype.kind != "f":
            raise ValueError(f"{name}: expected floats in 0..1, got {array.dtype} (divide 8-bit pictures by 255)")
        pictures.append(array.astype(np.float64))
    first, second = pictures
    if first.shape != second.shape or first.ndim not in (2, 3) or first.size == 0:
        raise ValueError(
            f"{name}: expected two pictures [H, W] or [H, W, C] of one shape, got {first.shape} and {second.shape}"
        )
    if first.ndim == 2:
        first, second = first[..., None], second[..., None]
    if mask is None:
        return first, second, None
    weights = np.asarray(mask, np.float64)
    if weights.shape != first.shape[:2]:
        raise ValueError(f"{name}: expected a mask of shape {first.shape[:2]}, got {weights.shape}")
    # A mean over no pixel is no number, and a table would print it.
    if not (weights >= 0).all() or not weights.sum() > 0:
        raise ValueError(f"{name}: expected a mask with at least one pixel and no negative weight")
    return first, second, weights
