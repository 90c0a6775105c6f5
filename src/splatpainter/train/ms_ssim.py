"""Multi-scale structural similarity, differentiable: Wang, Simoncelli & Bovik, "Multiscale structural similarity for
image quality assessment" (2003).

    MS-SSIM = prod_k mean(c_k)^w_k over the finer scales * mean(S_K)^w_K at the coarsest

c: SSIM's contrast and structure term, S: all of SSIM, both over pixels whose window lies in the picture
(metrics/images). Small pictures have fewer scales than the paper's five: those where a window still fits; their
exponents are divided by their sum.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.fit.loss import TAPS, WINDOW
from splatpainter.metrics.images import C1, C2

EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Of the scales, from the finest."""
LEAST = 1e-3
"""A scale's mean is at least this: a power of it must have a gradient."""


def ms_ssim(a: Tensor, b: Tensor) -> Tensor:
    """Scalar, at most 1: the mean over pictures and channels. a, b: [C, H, W, 3] in 0..1, of at least 11 x 11 pixels.
    Raises ValueError for smaller ones."""
    if min(a.shape[1:3]) < WINDOW:
        raise ValueError(f"MS-SSIM: expected pictures of at least {WINDOW}x{WINDOW}, got {a.shape[2]}x{a.shape[1]}")
    first, second = (x.permute(0, 3, 1, 2) for x in (a, b))
    count = 1
    while count < len(EXPONENTS) and min(a.shape[1:3]) >> count >= WINDOW:
        count += 1
    total = sum(EXPONENTS[:count])
    value = torch.ones_like(first[:, :, 0, 0])
    for k in range(count):
        structure, whole = _terms(first, second)
        value = value * (whole if k == count - 1 else structure).clamp_min(LEAST) ** (EXPONENTS[k] / total)
        first, second = F.avg_pool2d(first, 2), F.avg_pool2d(second, 2)
    return value.mean()


def _terms(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """[C, 3] means of c and of S, of pictures [C, 3, H, W]."""
    count = a.shape[0] * a.shape[1]
    stack = torch.stack([a, b, a * a, b * b, a * b]).reshape(5 * count, 1, *a.shape[2:])
    taps = torch.as_tensor(TAPS, dtype=a.dtype, device=a.device)
    blurred = F.conv2d(F.conv2d(stack, taps.view(1, 1, WINDOW, 1)), taps.view(1, 1, 1, WINDOW))
    mean_a, mean_b, aa, bb, ab = blurred.reshape(5, *a.shape[:2], *blurred.shape[2:]).unbind(0)
    structure = (2 * (ab - mean_a * mean_b) + C2) / (aa - mean_a**2 + bb - mean_b**2 + C2)
    light = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return structure.mean((2, 3)), (light * structure).mean((2, 3))
