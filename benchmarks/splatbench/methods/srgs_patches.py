"""What SRGS is trained on: patches of super-resolved pictures beside their low-resolution originals, and its loss.
Apart from srgs.py because it needs torch, which no other row's process should carry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatbench.cases import PosedImages
from splatbench.methods.super_resolution import Prior, blocks, pooled
from splatpainter.fit.image_loss import picture_loss
from splatpainter.fit.optimize import TrainingView
from splatpainter.fit.torch_loss import torch_loss
from splatpainter.rendering import render
from splatpainter.splats import Splats

SSIM_SHARE = 0.2
"""Share of 1 - SSIM in both parts of the loss; the rest is L1."""
MIN_PATCH_PX = 16
"""Edge of a patch in low-resolution pixels, at least (SSIM's window is 11 wide)."""


@dataclass(frozen=True)
class TrainingPatch(TrainingView):
    """A window of a view in high resolution; `color` is what the prior made of it."""

    low: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32), repr=False)
    """[h, w, 3] float32 the same window of the low-resolution picture, h = H / factor."""
    low_mask: np.ndarray | None = field(default=None, repr=False)
    """[h, w] float32 weights of its pixels; `mask` is the same, factor times as large."""


def srgs_loss(texture: float, factor: int, image: Tensor, view: TrainingView) -> Tensor:
    """w L_tex + (1 - w) L_sub of a patch, w = `texture` (Feng et al., "SRGS", arXiv 2404.10318): L_tex compares the
    render [H, W, 3] with what the prior made, L_sub its means over factor x factor blocks with the low-resolution
    picture: the mean of the sub-pixels must be the pixel. Views that are no patches: compared as they are."""
    if image.device.type != "cpu":
        return loss_by_torch(texture, factor, image, view)
    value, slope = loss_by_kernels(texture, factor, image.detach().numpy(), view)
    return _FixedGradient.apply(image, torch.from_numpy(slope), value)  # type: ignore[return-value]


def loss_by_kernels(texture: float, factor: int, image: np.ndarray, view: TrainingView) -> tuple[float, np.ndarray]:
    """(loss, gradient [H, W, 3]) with the kernels of fit/image_loss.py: a tenth of the time of a step goes into the
    loss, not nine tenths as with torch on a CPU."""
    value, slope = picture_loss(image, view.color, view.mask, SSIM_SHARE)
    if not isinstance(view, TrainingPatch) or texture == 1:
        return value, slope
    low_value, low_slope = picture_loss(pooled(image, factor), view.low, view.low_mask, SSIM_SHARE)
    part = low_slope * np.float32((1 - texture) / factor**2)
    return texture * value + (1 - texture) * low_value, slope * np.float32(texture) + blocks(part, factor)


def loss_by_torch(texture: float, factor: int, image: Tensor, view: TrainingView) -> Tensor:
    """The loss of `loss_by_kernels`, differentiated by torch."""

    def part(render: Tensor, color: np.ndarray, mask: np.ndarray | None) -> Tensor:
        weights = None if mask is None else torch.as_tensor(mask, dtype=torch.float32, device=image.device)
        return torch_loss(render, torch.as_tensor(color, device=image.device), weights, SSIM_SHARE)

    loss = part(image, view.color, view.mask)
    if not isinstance(view, TrainingPatch) or texture == 1:
        return loss
    means = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)
    return texture * loss + (1 - texture) * part(means, view.low, view.low_mask)


class _FixedGradient(torch.autograd.Function):
    """A loss whose gradient was computed with it."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, slope: Tensor, value: float) -> Tensor:
        ctx.save_for_backward(slope)
        return image.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *pull: Tensor) -> tuple[Tensor, None, None]:
        return ctx.saved_tensors[0] * pull[0], None, None


def patches(
    images: PosedImages,
    asset: Splats,
    prior: Prior,
    factor: int,
    edge: int,
    count: int,
    rng: np.random.Generator,
    weights: np.ndarray | None = None,
) -> list[TrainingPatch]:
    """`count` random patches of every picture, `edge` pixels wide and high in high resolution (more than
    MIN_PATCH_PX low-resolution pixels, no more than the picture), placed where the asset is. weights: [V, H, W] of the
    pictures' pixels, >= 0; patches without any are left out.

    Their weight is edge / (factor x the picture's edge): a Gaussian's pull on the screen, which density control
    measures in pictures' halves, is then as in the whole picture."""
    out = []
    alphas = render(asset, list(images.cameras)).alphas[..., 0]
    for k, (camera, color) in enumerate(images):
        large = camera.resized(camera.width * factor, camera.height * factor)
        enlarged = prior(color)
        wide, high = (min(max(edge // factor, MIN_PATCH_PX), size) for size in (camera.width, camera.height))
        for x, y in _windows(alphas[k] > 0.05, wide, high, count, rng):
            window = large.cropped(x * factor, y * factor, wide * factor, high * factor)
            texture = enlarged[y * factor : (y + high) * factor, x * factor : (x + wide) * factor]
            weight = float(np.sqrt(wide * high / (camera.width * camera.height)))
            low = np.ascontiguousarray(color[y : y + high, x : x + wide])
            low_mask = None if weights is None else weights[k, y : y + high, x : x + wide].astype(np.float32)
            if low_mask is None or low_mask.min() == 1:
                out.append(TrainingPatch(window, np.ascontiguousarray(texture), weight, None, low))
            elif low_mask.any():
                out.append(
                    TrainingPatch(
                        window, np.ascontiguousarray(texture), weight, blocks(low_mask, factor), low, low_mask
                    )
                )
    return out


def _windows(where: np.ndarray, wide: int, high: int, count: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Left upper corners of `count` windows, each around a pixel of `where` [H, W] (any, if it is empty)."""
    ys, xs = np.nonzero(where if where.any() else np.ones_like(where))
    out = []
    for k in rng.integers(len(ys), size=count):
        x, y = xs[k] - rng.integers(wide), ys[k] - rng.integers(high)
        x, y = np.clip(x, 0, where.shape[1] - wide), np.clip(y, 0, where.shape[0] - high)
        out.append((int(x), int(y)))
    return out
