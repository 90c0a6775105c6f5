"""The loss of 3DGS, (1 - s) L1 + s (1 - SSIM), and its gradient with respect to the render.

SSIM is that of metrics/images.py: 11 x 11 Gaussian window, mean over the pixels whose window lies in the picture. Two
forms of one formula: numpy kernels with the gradient written out, several times quicker on a CPU, and torch.

For a = render, b = target, windowed means m, variances v, covariance c, A1 = 2 m_a m_b + C1, A2 = 2 c + C2,
B1 = m_a^2 + m_b^2 + C1, B2 = v_a + v_b + C2 and S = A1 A2 / (B1 B2), with F the window:

    dL/da = F'(dS/dm_a - 2 m_a dS/dv_a - m_b dS/dc) + 2 a F'(dS/dv_a) + b F'(dS/dc)
    dS/dm_a = 2 (m_b A2 / (B1 B2) - m_a S / B1),   dS/dv_a = -S / B2,   dS/dc = 2 A1 / (B1 B2)
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from torch import Tensor

from splatpainter.kernels.parallel import run
from splatpainter.metrics.images import C1, C2, RADIUS, SIGMA

WINDOW = 2 * RADIUS + 1
SSIM_KERNEL = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
SSIM_KERNEL = (SSIM_KERNEL / SSIM_KERNEL.sum()).astype(np.float32)
"""[WINDOW] of the separable window."""
STRIPE = 8
"""Rows of pixels that a thread takes at a time."""


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
        image = np.where(heavy[..., None] > 0, image, target)
        each, total = np.repeat(heavy, 3, 1), float(heavy[RADIUS:-RADIUS, RADIUS:-RADIUS].mean(dtype=np.float64))
    image = np.ascontiguousarray(image, np.float32)
    rows, flat = (height, 3 * width), (height - WINDOW + 1, 3 * (width - WINDOW + 1))
    maps = np.empty((3, *flat) if share > 0 else (3, 0, 0), np.float32)
    sums = np.zeros((2, height), np.float64)
    a, b, gradient = image.reshape(rows), target.reshape(rows), np.empty(rows, np.float32)
    if share > 0:
        scale = np.float32(share / maps[0].size)
        run(_similarity, a, b, each, SSIM_KERNEL, scale, maps, sums[0])
    run(_gather, a, b, each, SSIM_KERNEL, np.float32((1 - share) / a.size), maps, gradient, sums[1])
    loss = (1 - share) * sums[1].sum() / a.size
    if share > 0:
        loss += share * (total - sums[0].sum() / maps[0].size)
    return float(loss), gradient.reshape(image.shape)


def torch_loss(image: Tensor, target: Tensor, weights: Tensor | None, share: float) -> Tensor:
    """The loss of `picture_loss` as a differentiable tensor, on any device."""
    if weights is None:
        weights = torch.ones_like(image[..., 0])
    image = torch.where(weights[..., None] > 0, image, target)
    loss = (1 - share) * ((image - target).abs() * weights[..., None]).mean()
    if share > 0:
        inner = weights[RADIUS:-RADIUS, RADIUS:-RADIUS, None]
        loss = loss + share * ((1 - ssim_map(image, target)) * inner).mean()
    return loss


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """[H - 10, W - 10, 3] SSIM around the pixels whose window lies in the picture. a, b: [H, W, 3]."""
    stack = torch.stack([a, b, a * a, b * b, a * b]).permute(0, 3, 1, 2).reshape(15, 1, *a.shape[:2])
    taps = torch.as_tensor(SSIM_KERNEL, dtype=a.dtype, device=a.device)
    blurred = torch.nn.functional.conv2d(stack, taps.view(1, 1, WINDOW, 1))
    blurred = torch.nn.functional.conv2d(blurred, taps.view(1, 1, 1, WINDOW))
    mean_a, mean_b, aa, bb, ab = blurred.reshape(5, 3, *blurred.shape[2:]).unbind(0)
    top = (2 * mean_a * mean_b + C1) * (2 * (ab - mean_a * mean_b) + C2)
    bottom = (mean_a**2 + mean_b**2 + C1) * (aa - mean_a**2 + bb - mean_b**2 + C2)
    return (top / bottom).permute(1, 2, 0)


_fast = njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, boundscheck=False)


@_fast
def _similarity(a, b, weights, taps, scale, maps, sums, thread, threads):
    """maps[0..2] = scale w times what F' is taken of in the three terms of dL/da, negated (the loss has 1 - SSIM);
    sums[y] = sum of w S over a row of windows. weights: [H, 3 W], as a and b."""
    down, across = maps.shape[1:]
    full = a.shape[1]
    line, mean = np.empty((5, full), np.float32), np.empty((5, across), np.float32)
    c1, c2, two = np.float32(C1), np.float32(C2), np.float32(2)
    for stripe in range(thread, (down + STRIPE - 1) // STRIPE, threads):
        for y in range(stripe * STRIPE, min(down, (stripe + 1) * STRIPE)):
            line[:] = 0
            for k in range(WINDOW):
                t = taps[k]
                for j in range(full):
                    u, v = a[y + k, j], b[y + k, j]
                    tu, tv = t * u, t * v
                    line[0, j] += tu
                    line[1, j] += tv
                    line[2, j] += tu * u
                    line[3, j] += tv * v
                    line[4, j] += tu * v
            mean[:] = 0
            for m in range(5):
                for k in range(WINDOW):
                    t = taps[k]
                    for j in range(across):
                        mean[m, j] += t * line[m, j + 3 * k]
            total = np.float32(0)
            for j in range(across):
                ma, mb = mean[0, j], mean[1, j]
                covariance = mean[4, j] - ma * mb
                top1, top2 = two * ma * mb + c1, two * covariance + c2
                low1 = ma * ma + mb * mb + c1
                low2 = mean[2, j] - ma * ma + mean[3, j] - mb * mb + c2
                s = top1 * top2 / (low1 * low2)
                w = weights[y + RADIUS, j + 3 * RADIUS]
                total += w * s
                by_variance = -s / low2
                by_covariance = two * top1 / (low1 * low2)
                by_mean = two * (mb * top2 / (low1 * low2) - ma * s / low1)
                w = -w * scale
                maps[0, y, j] = w * (by_mean - two * ma * by_variance - mb * by_covariance)
                maps[1, y, j] = w * two * by_variance
                maps[2, y, j] = w * by_covariance
            sums[y] = total


@_fast
def _gather(a, b, weights, taps, scale, maps, gradient, sums, thread, threads):
    """The window's transpose over the maps, and L1. scale: of the L1 term; sums[y] = sum of w |a - b| over a row."""
    height, full = a.shape
    down, across = maps.shape[1:]
    edge = 3 * (WINDOW - 1)
    line, out = np.zeros((3, full + edge), np.float32), np.empty((3, full), np.float32)
    zero, one = np.float32(0), np.float32(1)
    for stripe in range(thread, (height + STRIPE - 1) // STRIPE, threads):
        for y in range(stripe * STRIPE, min(height, (stripe + 1) * STRIPE)):
            total = zero
            for j in range(full):
                w = weights[y, j]
                d = a[y, j] - b[y, j]
                total += w * abs(d)
                sign = one if d > zero else (-one if d < zero else zero)
                gradient[y, j] = scale * w * sign
            sums[y] = total
            if down == 0:
                continue
            line[:, edge : edge + across] = 0
            for m in range(3):
                for k in range(max(0, y - down + 1), min(WINDOW, y + 1)):
                    t = taps[k]
                    for j in range(across):
                        line[m, edge + j] += t * maps[m, y - k, j]
            out[:] = 0
            for m in range(3):
                for k in range(WINDOW):
                    t, shift = taps[k], edge - 3 * k
                    for j in range(full):
                        out[m, j] += t * line[m, j + shift]
            for j in range(full):
                w = one if weights[y, j] > zero else zero
                gradient[y, j] += w * (out[0, j] + a[y, j] * out[1, j] + b[y, j] * out[2, j])
