"""What training minimises: squared error of pictures and their distance in perceptual features.

    L = mean w |render - truth|^2 + lambda LPIPS(render, truth)           (arXiv 2512.05354, training objectives)

The feature distance is LPIPS with the squeeze trunk: train against it, report the alex trunk (metrics/lpips.py). Knows
no model. C views of H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.metrics.lpips import MIN_SIDE_PX, Lpips, LpipsUnavailable
from splatpainter.nn.precision import exact

NEGLIGIBLE_ERROR = 2e-4
"""An error of which nothing need be left, where ratios count: 37 dB."""
MIN_EDITED_SHARE = 0.005
"""Share of a view that counts as edited at least: the loss of a dot must not outweigh everything else."""
DEPTH_SPREAD = 0.5
"""Standard deviation of a view's depths in the first steps of a reconstruction, half cubes."""


@dataclass(frozen=True)
class PictureTarget:
    """What some views should show."""

    colors: Tensor = field(repr=False)
    """[C, H, W, 3] in 0..1."""
    weights: Tensor = field(repr=False)
    """[C, H, W] >= 0, how much a pixel counts; the mean over the views of the sum per view is of order 1."""
    focus: Tensor = field(repr=False)
    """[C, H, W] bool: the pixels that reports are about (edited, or on the object)."""


@dataclass(frozen=True)
class PictureLoss:
    """The loss of rendered views, with its perceptual term if there are weights for it."""

    network: Lpips | None
    """The squeeze trunk, or None."""
    share: float
    """lambda, the weight of the perceptual term (the paper: 0.5)."""
    decibels: bool = False
    """Minimise the logarithm of that sum: what an edit gains counts by its ratio, however small its error already was.
    Without it (the paper) steps follow the samples that are farthest from their truth."""

    @staticmethod
    def load(share: float, folder: str | Path | None = None, device: torch.device | str = "cpu") -> PictureLoss:
        """share: 0 leaves the perceptual term out; folder: of the weights (`Lpips.load`). Raises LpipsUnavailable (a
        ValueError of one line) where the term is wanted and its weights are not there."""
        network = Lpips.load("squeeze", folder).to(device) if share > 0 else None
        return PictureLoss(network, share)

    def __call__(self, rendered: Tensor, target: PictureTarget, views: list[int] | None = None) -> dict[str, Tensor]:
        """{"squared": , "perceptual": , "loss": their weighted sum}; differentiable in rendered [C, H, W, 3]. views:
        those that the perceptual term looks at (all by default; it costs more than the renderer)."""
        squared = weighted_square(rendered, target)
        parts = {"squared": squared, "loss": squared}
        chosen = list(range(len(rendered))) if views is None else views
        if self.network is not None and chosen and min(rendered.shape[1:3]) >= MIN_SIDE_PX:
            first, second = (x[chosen].permute(0, 3, 1, 2) for x in (rendered.clamp(0, 1), target.colors))
            mask = target.weights[chosen][:, None]
            # Squeeze's first pixels are 4 wide: every pixel around the edit is in some tap's window.
            mask = F.max_pool2d(mask, 9, stride=1, padding=4) + 1e-6
            with exact(rendered.device):
                parts["perceptual"] = self.network(first.float(), second.float(), mask.float()).mean()
            parts["loss"] = squared + self.share * parts["perceptual"]
        if self.decibels:
            parts["loss"] = torch.log(parts["loss"] + NEGLIGIBLE_ERROR)
        return parts


def perceptual_or_not(
    share: float, folder: str | Path | None, device: torch.device | str = "cpu"
) -> tuple[PictureLoss, str | None]:
    """(the loss, None), or (the loss without its perceptual term, one line that says why)."""
    try:
        return PictureLoss.load(share, folder, device), None
    except LpipsUnavailable as error:
        return PictureLoss(None, 0.0), f"{error}; the perceptual term is dropped"


def weighted_square(rendered: Tensor, target: PictureTarget) -> Tensor:
    """sum w |a - b|^2 / (3 C): the mean over views of the weighted squared difference, over channels averaged."""
    difference = (rendered - target.colors).square().mean(-1)
    return (target.weights * difference).sum() / len(rendered)


def local_target(
    truth: Tensor, truth_before: Tensor, drawn: Tensor, keep: float, threshold: float = 0.02
) -> PictureTarget:
    """What views should show after a local edit. truth, truth_before: [C, H, W, 3] the object with and without the
    edit; drawn: the asset as it is.

    Where the edit changes the object, the truth counts; elsewhere the asset itself is wanted, with weight `keep`: an
    asset is coarser than the object it shows, and what nobody edited must stay. Weights are per edited pixel, so that a
    dot and a large stroke are worth the same.
    """
    changed = (truth - truth_before).abs().amax(-1) > threshold  # [C, H, W]
    # A render at the edit's border mixes both: one pixel around belongs to the edit.
    changed = F.max_pool2d(changed.float()[:, None], 3, stride=1, padding=1)[:, 0] > 0
    colors = torch.where(changed[..., None], truth, drawn)
    area = max(float(changed.float().mean()), MIN_EDITED_SHARE) * changed[0].numel()
    weights = torch.where(changed, 1.0, keep) / area
    return PictureTarget(colors, weights, changed)


def global_target(truth: Tensor, covered: Tensor) -> PictureTarget:
    """What views should show after a global edit, or what a reconstruction should show: the truth. truth: [C, H, W, 3];
    covered: [C, H, W] bool, the object's pixels, which reports are about. All pixels count the same, over the object's
    area: empty corners make no loss smaller."""
    area = max(float(covered.float().mean()), MIN_EDITED_SHARE) * covered[0].numel()
    return PictureTarget(truth, torch.full_like(truth[..., 0], 1 / area), covered)


def joined(parts: list[PictureTarget]) -> PictureTarget:
    """Several sets of views of one size as one."""
    return PictureTarget(*(torch.cat([getattr(p, name) for p in parts]) for name in ("colors", "weights", "focus")))


def masked_psnr(rendered: Tensor, target: PictureTarget) -> float | None:
    """dB over the focus pixels of all views together (clamped to 0..1); None where there are none."""
    if not bool(target.focus.any()):
        return None
    error = (rendered.clamp(0, 1) - target.colors).square().mean(-1)[target.focus].double().mean()
    return float(-10 * torch.log10(error.clamp_min(1e-12)))


def scattered_depth(distances: Tensor, views: int) -> Tensor:
    """The first steps of a reconstruction from pictures alone (reference recipe of GS-LRM's followers): pulls each
    view's depths towards a normal of standard deviation DEPTH_SPREAD around the camera's distance to the middle, before
    any colour counts; else points collapse into transparency.

    distances: [V * M] along the rays, minus the camera's distance to the middle, in units of the half cube."""
    per_view = distances.view(views, -1)
    centered = per_view - per_view.mean(1, keepdim=True)
    deviation = centered.detach().std(1, keepdim=True).clamp_min(1e-4)
    goal = (centered / deviation * DEPTH_SPREAD).detach()
    return (per_view - goal).square().mean()
