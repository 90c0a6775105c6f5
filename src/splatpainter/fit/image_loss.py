"""The loss of 3DGS, (1 - s) L1 + s (1 - SSIM), and its gradient with respect to the render.

SSIM is that of metrics/images.py: 11 x 11 Gaussian window, mean over the pixels whose window lies in the picture. Two
forms of one formula: CPU kernels with the gradient written out, several times quicker on a CPU, and torch
(torch_loss.py).

For a = render, b = target, windowed means m, variances v, covariance c, A1 = 2 m_a m_b + C1, A2 = 2 c + C2,
B1 = m_a^2 + m_b^2 + C1, B2 = v_a + v_b + C2 and S = A1 A2 / (B1 B2), with F the window:

    dL/da = F'(dS/dm_a - 2 m_a dS/dv_a - m_b dS/dc) + 2 a F'(dS/dv_a) + b F'(dS/dc)
    dS/dm_a = 2 (m_b A2 / (B1 B2) - m_a S / B1),   dS/dv_a = -S / B2,   dS/dc = 2 A1 / (B1 B2)
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads
from splatpainter.metrics.images import RADIUS, SIGMA

WINDOW = 2 * RADIUS + 1
SSIM_KERNEL = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
SSIM_KERNEL = (SSIM_KERNEL / SSIM_KERNEL.sum()).astype(np.float32)
"""[WINDOW] of the separable window."""


@np.errstate(over="ignore", invalid="ignore")  # pictures beyond float32 have an infinite loss, or NaN
def picture_loss(
    image: np.ndarray, target: np.ndarray, weights: np.ndarray | None, share: float
) -> tuple[float, np.ndarray]:
    """(loss, its gradient [H, W, 3] with respect to the image).

    image, target: [H, W, 3] float32; weights: [H, W] float32 >= 0 of pixels, None: 1. share: s of the formula above,
    0..1; above 0 pictures have at least 11 x 11 pixels. A mean over all pixels of the picture, not over the weights: a
    pixel pulls as hard whether others count or not. Pixels of weight 0 have no influence: SSIM sees the target there.
    """
    height, width = target.shape[:2]
    target = np.ascontiguousarray(target, np.float32)
    if weights is None:
        each, total = np.ones((height, 3 * width), np.float32), 1.0
    else:
        heavy = np.ascontiguousarray(weights, np.float32)
        # Pixels of weight 0 are made equal, so that windows beside them see no difference.
        image = np.where(heavy[..., None] > 0, image, target)
        each, total = np.repeat(heavy, 3, 1), float(heavy[RADIUS:-RADIUS, RADIUS:-RADIUS].mean(dtype=np.float64))
    image = np.ascontiguousarray(image, np.float32)
    rows, flat = (height, 3 * width), (height - WINDOW + 1, 3 * (width - WINDOW + 1))
    maps = np.empty((3, *flat) if share > 0 else (3, 0, 0), np.float32)
    sums = np.zeros((2, height), np.float64)
    a, b, gradient = image.reshape(rows), target.reshape(rows), np.empty(rows, np.float32)
    if share > 0:
        # Scratch of a few lines for each thread: windows are summed line by line, not in whole pictures.
        lines = np.empty((threads(), 10, 3 * width), np.float32)
        run(kernels.ssim_maps, a, b, each, SSIM_KERNEL, share / maps[0].size, maps, sums[0], lines)
    lines = np.zeros((threads(), 6, 3 * (width + WINDOW - 1)), np.float32)
    run(kernels.loss_gradient, a, b, each, SSIM_KERNEL, (1 - share) / a.size, maps, gradient, sums[1], lines)
    loss = (1 - share) * sums[1].sum() / a.size
    if share > 0:
        loss += share * (total - sums[0].sum() / maps[0].size)
    return float(loss), gradient.reshape(image.shape)
