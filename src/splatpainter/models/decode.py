"""The decoder: one linear layer from latents to attributes, as a residual on the Gaussian's own or absolutely.

The only place in models/ that turns what a network says into activated attributes, and the guard of the exact promise:
a residual of exactly zero returns the very same bits. M latents with their Gaussians, D width, C outputs per Gaussian.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from splatpainter.models.config import Decoder
from splatpainter.nn.precision import exact
from splatpainter.splats import SH_C0, Splats

CHILD_SCALE = 0.5
"""A child is born this much smaller than its parent: detail is finer than what is there."""
CHILD_OPACITY = 0.1
"""A child is born this much fainter, so that appending it hardly changes a picture, yet its pixels have gradients
(renderers skip alpha below 1/255, so that a child born invisible would never learn)."""
LIMITS = {"centre": 0.25, "scale": 0.1, "turn": 0.1, "opacity": 0.25, "sh": 2.0}
"""Limits of a bounded residual: sizes of the Gaussian, log scale, quaternion of norm 1, logits, SH coefficients.
Colours are free, the rest is a touch: with wide limits a model learns to fade and thicken the Gaussians of its training
assets, which ruins assets with finer ones (docs/LOG.md)."""
OPACITY_MARGIN = 1e-6
"""Opacities this near to 0 or 1 count as this near: from exactly 1 no logit could move."""


def output_count(degree: int) -> int:
    """C: 3 for the centre, 3 scales, 4 quaternion, 1 opacity, 3 (degree + 1)^2 SH."""
    return 11 + 3 * (degree + 1) ** 2


class AttributeHead(nn.Module):
    """LayerNorm and one linear layer, [M, D] -> [M, C] float32 (also under autocast: bits of a mean matter).

    residual and bounded: weights and bias start at zero; absolute: weights N(0, 0.02), zero bias."""

    def __init__(self, dim: int, degree: int, kind: Decoder) -> None:
        super().__init__()
        self.kind = kind
        self.norm = nn.LayerNorm(dim)
        self.linear = nn.Linear(dim, output_count(degree))
        nn.init.zeros_(self.linear.bias)
        if kind != "absolute":
            nn.init.zeros_(self.linear.weight)
        elif not self.linear.weight.is_meta:
            nn.init.normal_(self.linear.weight, std=0.02)

    def forward(self, latents: Tensor) -> Tensor:
        with exact(latents.device):
            return self.linear(self.norm(latents.float()))

    @property
    def is_untrained(self) -> bool:
        """Whether every weight is zero, so that it says exactly nothing about anything: an untrained residual."""
        return not (self.linear.weight.any() or self.linear.bias.any())

    def attributes(self, raw: Tensor, gaussians: Splats[Tensor], centers: Tensor, voxel: float) -> Splats[Tensor]:
        """The decoded Gaussians. raw: [M, C]; gaussians: the M Gaussians, torch float32; centers: [M, 3] of their
        voxels, and voxel, the edge of one, world units."""
        if self.kind == "residual":
            return apply_residual(gaussians, raw, voxel)
        if self.kind == "bounded":
            # In the Gaussian's own size: a step that is small for a coarse asset would scatter a fine one.
            size = gaussians.scales.detach().amax(1, keepdim=True).clamp(max=voxel)
            return apply_residual(gaussians, bounded(raw), size)
        return absolute(gaussians, raw, centers, voxel)


def bounded(raw: Tensor) -> Tensor:
    """raw [M, C] with every number softly within LIMITS; small ones, and 0 exactly, stay what they are."""
    counts = {"centre": 3, "scale": 3, "turn": 4, "opacity": 1, "sh": raw.shape[1] - 11}
    limits = torch.cat([raw.new_full((counts[name],), limit) for name, limit in LIMITS.items()])
    return limits * torch.tanh(raw / limits)


def color_change(raw: Tensor, kind: Decoder) -> Tensor:
    """[M, 3] change of base colour, display colours, that raw [M, C] of a residual decoder means. Raises ValueError for
    an absolute one."""
    if kind == "absolute":
        raise ValueError("decode: expected a residual decoder; an absolute one predicts no change")
    return SH_C0 * (bounded(raw) if kind == "bounded" else raw)[:, 11:14]


def apply_residual(gaussians: Splats[Tensor], residual: Tensor, unit: float | Tensor) -> Splats[Tensor]:
    """Gaussians moved by a residual [M, C]: centre in units (world, one or [M, 1]), log scale, quaternion (of the
    Gaussian's own norm), logit opacity, SH of the bands that C has (others stay). Where a number of the residual is
    exactly 0, the Gaussian's own number returns bit for bit. Differentiable in both, at 0 too.

    Log and logit are never taken: exp(log s + d) = s exp(d), and
    sigmoid(logit o + d) = o e^d / (1 - o + o e^d).
    """
    centre, scale, turn, opacity, sh = _split(residual)
    norm = gaussians.quats.norm(dim=1, keepdim=True)
    # Clamped, as no training should meet an infinite opacity or size on its way.
    odds = torch.exp(opacity.clamp(-16, 16))
    o = gaussians.opacities.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    # Bands that the model has not learnt stay as they are, whatever the asset has of them.
    bands = min(sh.shape[1], gaussians.sh.shape[1])
    low = _keep(gaussians.sh[:, :bands] + sh[:, :bands], gaussians.sh[:, :bands], sh[:, :bands])
    return replace(
        gaussians,
        means=_keep(gaussians.means + unit * centre, gaussians.means, centre),
        scales=_keep(gaussians.scales * torch.exp(scale.clamp(-8, 8)), gaussians.scales, scale),
        quats=_keep(gaussians.quats + norm * turn, gaussians.quats, turn),
        opacities=_keep(o * odds / (1 - o + o * odds), gaussians.opacities, opacity),
        sh=low if bands == gaussians.sh.shape[1] else torch.cat([low, gaussians.sh[:, bands:]], dim=1),
    )


def absolute(gaussians: Splats[Tensor], raw: Tensor, centers: Tensor, voxel: float) -> Splats[Tensor]:
    """Gaussians as raw [M, C] says, with constants so that raw 0 is a grey, round, half transparent Gaussian of half a
    voxel in its voxel's middle. gaussians gives only the number of SH bands and what is not an attribute."""
    centre, scale, turn, opacity, sh = _split(raw)
    bands = gaussians.sh.shape[1]
    sh = sh[:, :bands]
    if sh.shape[1] < bands:
        sh = torch.cat([sh, sh.new_zeros(len(sh), bands - sh.shape[1], 3)], dim=1)
    return replace(
        gaussians,
        means=centers.to(raw.dtype) + voxel * centre,
        scales=0.5 * voxel * torch.exp(scale.clamp(-8, 8)),
        quats=turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]),
        opacities=torch.sigmoid(opacity),
        sh=sh,
    )


def init_children(parents: Splats[Tensor]) -> Splats[Tensor]:
    """What children of `native` are a residual on: their parents, smaller and fainter (CHILD_SCALE, CHILD_OPACITY)."""
    return replace(parents, scales=parents.scales * CHILD_SCALE, opacities=parents.opacities * CHILD_OPACITY)


def _split(raw: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Centre [M, 3], scale [M, 3], quaternion [M, 4], opacity [M], SH [M, K, 3]."""
    centre, scale, turn, opacity, sh = raw.split([3, 3, 4, 1, raw.shape[1] - 11], dim=1)
    return centre, scale, turn, opacity[:, 0], sh.unflatten(1, (-1, 3))


class _Keep(torch.autograd.Function):
    """where(residual == 0, old, new), with the gradient of `new` everywhere.

    Plain torch.where would give a zero-initialised head a zero gradient, for ever; x + 0 would turn -0.0 into 0.0."""

    @staticmethod
    def forward(ctx: Any, new: Tensor, old: Tensor, residual: Tensor) -> Tensor:
        return torch.where(residual == 0, old, new)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return grads[0], None, None  # new is a function of old, which gets its gradient through it


def _keep(new: Tensor, old: Tensor, residual: Tensor) -> Tensor:
    return _Keep.apply(new, old, residual)  # type: ignore[return-value]
