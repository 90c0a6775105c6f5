"""PSNR, SSIM and LPIPS of an asset's renders against pictures, as means over views: what every table's scores are made
of. Knows no protocol.

W views of H x W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from splatbench.cases import PosedImages
from splatpainter.cameras import Camera
from splatpainter.metrics import psnr, ssim
from splatpainter.metrics.images import RADIUS
from splatpainter.metrics.lpips import MIN_SIDE_PX as MIN_LPIPS_PX
from splatpainter.splats import Splats

MAX_PSNR_DB = 100.0
"""PSNR of pictures that are equal, or nearly: else one such view would make every mean infinite."""
MIN_SSIM_PX = 2 * RADIUS + 1
"""Pixels; SSIM's window."""


def decibels(value: float | None) -> str:
    """For people, without the unit."""
    return "–" if value is None else f"{value:.1f}"


def rendered(splats: Splats, cameras: Sequence[Camera]) -> np.ndarray:
    """[V, H, W, 3] float32 renders, clamped to 0..1. cameras: of one size."""
    from splatpainter.rendering import render

    return np.clip(render(splats.numpy(), list(cameras)).colors, 0, 1).astype(np.float32)


def object_masks(images: PosedImages) -> np.ndarray:
    """[W, H, W] bool where the pictures are not exactly their camera's background, as far as float16 tells them apart
    (cases are kept so). Where a picture's alpha is known, `alpha > 0` says it better: an object may have the
    background's colour."""
    background = np.array([camera.background for camera in images.cameras], np.float16)[:, None, None]
    return (images.colors.astype(np.float16) != background).any(-1)


def scored(
    splats: Splats, images: PosedImages, masks: np.ndarray | None, perceptual: Any | None
) -> dict[str, float | None]:
    """{"psnr", "ssim", "lpips"} of the renders of `splats` against `images`; see `compared`."""
    if not len(images) or (masks is not None and not np.any(masks)):
        return {"psnr": None, "ssim": None, "lpips": None}
    return compared(rendered(splats, images.cameras), images.colors, masks, perceptual)


def compared(
    rendered: np.ndarray, target: np.ndarray, masks: np.ndarray | None, perceptual: Any | None
) -> dict[str, float | None]:
    """{"psnr": dB, "ssim", "lpips"}, each a mean over views, of pictures [V, H, W, 3] in 0..1.

    masks: [V, H, W] bool pixels that count (None: all). PSNR and SSIM are means inside the mask; LPIPS is of the crop
    of the mask's bounding box (at least 32 pixels each way), in which pixels outside of the mask are the target's.
    Views without such a pixel are left out; None where no view is left, where pictures are too small for a measure
    (11 and 32 pixels), and for LPIPS without `perceptual` (an LPIPS-Alex, metrics.lpips). PSNR is at most MAX_PSNR_DB.
    """
    figures: dict[str, list[float]] = {"psnr": [], "ssim": [], "lpips": []}
    edge = min(target.shape[1:3])
    for k, (a, b) in enumerate(zip(rendered, target, strict=True)):
        mask = None if masks is None else np.asarray(masks[k], bool)
        if mask is not None and not mask.any():
            continue
        figures["psnr"].append(min(psnr(a, b, mask), MAX_PSNR_DB))
        if edge >= MIN_SSIM_PX:
            figures["ssim"].append(ssim(a, b, mask))
        if perceptual is not None and edge >= MIN_LPIPS_PX:
            figures["lpips"].append(_distance(a, b, mask, perceptual))
    return {name: float(np.mean(values)) if values else None for name, values in figures.items()}


def bounding_box(mask: np.ndarray, min_px: int = MIN_LPIPS_PX) -> tuple[slice, slice]:
    """(rows, columns) of the smallest window of mask [H, W] that holds all its pixels, grown about its middle to
    `min_px` pixels each way as far as the picture reaches. Raises ValueError for a mask without a pixel."""
    if not mask.any():
        raise ValueError("bounding box: expected a mask with at least one pixel")
    sides = []
    for axis in (1, 0):
        inside = np.flatnonzero(mask.any(axis))
        size = mask.shape[1 - axis]
        first, last = int(inside[0]), int(inside[-1]) + 1
        short = max(min(min_px, size) - (last - first), 0)
        first = min(max(first - short // 2, 0), size - (last - first) - short)
        sides.append(slice(first, max(last, first + min(min_px, size))))
    return sides[0], sides[1]


def _distance(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None, perceptual: Any) -> float:
    import torch

    if mask is not None:
        window = bounding_box(mask)
        a, b = np.where(mask[..., None], a, b)[window], b[window]
    device = next(iter(perceptual.weights.values())).device
    pair = (torch.from_numpy(np.ascontiguousarray(p.transpose(2, 0, 1), np.float32))[None] for p in (a, b))
    with torch.no_grad():
        return float(perceptual(*(p.to(device) for p in pair)))
