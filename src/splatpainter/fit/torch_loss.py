"""The loss of image_loss.py as torch differentiates it: on other devices, and as an oracle of the kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from splatpainter.fit.image_loss import SSIM_KERNEL, WINDOW
from splatpainter.metrics.images import C1, C2, RADIUS


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
