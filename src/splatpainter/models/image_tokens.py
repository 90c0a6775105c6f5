"""Edited pictures as tokens: channels per pixel, patches, and how much of each patch was edited.

Knows no network. W pictures of H x W pixels, T tokens, C channels, p pixels per edge of a patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.cameras import Camera
from splatpainter.models.config import RefineConfig
from splatpainter.models.gaussian_groups import GaussianGroups
from splatpainter.models.lrm import AssetViews, GaussianLrm, nearest_points, patchify, rays, slants
from splatpainter.system.quick_dataclass import dataclass

MAX_PICTURES = 16
"""Pictures of one edit, at most."""


@dataclass(frozen=True)
class Pictures:
    """The edited views of one edit: V pictures of one size, torch float32 on one device."""

    cameras: Sequence[Camera]
    """V, all of one size."""
    edited: Tensor = field(repr=False)
    """[V, H, W, 3] the pictures after editing, 0..1."""
    render: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 3] the asset as it is, from the same cameras; needed for the channels "render"."""
    depth: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 1] expected z-depth of that render, world units, 0 where there is nothing; for "geometry"."""
    alpha: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 1] its alpha, 0..1; for "geometry"."""
    mask: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 1] 1 where a pixel was edited, else 0; None: everywhere."""

    def __post_init__(self) -> None:
        width, height = one_size(self.cameras)
        for name, channels in (("edited", 3), ("render", 3), ("depth", 1), ("alpha", 1), ("mask", 1)):
            values = getattr(self, name)
            shape = [len(self.cameras), height, width, channels]
            if values is not None and list(values.shape) != shape:
                raise ValueError(f"edit: expected {name} {shape}, got {list(values.shape)}")


def one_size(cameras: Sequence[Camera]) -> tuple[int, int]:
    """(width, height) of the pictures of one edit. Raises ValueError for none, too many, or several sizes."""
    if not 1 <= len(cameras) <= MAX_PICTURES:
        raise ValueError(f"edit: expected 1 to {MAX_PICTURES} pictures, got {len(cameras)}")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sizes)
        raise ValueError(
            f"edit: expected pictures of one size, got {listed}; resize them, edit one after the other, or use the lift"
        )
    return sizes[0]


@dataclass(frozen=True)
class PictureTokens:
    """Patches of pictures, those that teach."""

    pixels: Tensor = field(repr=False)
    """[T, p * p * C], patch rows first, channels fastest; or, by the LRM's tokenizer, [T, its width]."""
    weights: Tensor = field(repr=False)
    """[T] share of edited pixels, above 0 and at most 1."""
    lengths: Tensor
    """[V] int64 on the host: tokens per picture."""


def tokenize(
    pictures: Pictures, groups: GaussianGroups, config: RefineConfig, lrm: GaussianLrm | None = None
) -> PictureTokens:
    """Cut pictures into patches, padding right and below with zeros (and nothing edited) to whole patches. Positions
    and rays are in the asset's cube (-1..1), so that world units do not matter. lrm: whose tokenizer makes the tokens
    where config.tokenizer is "lrm"; no gradient reaches it.

    With config.mask_tokens, patches without an edited pixel are left out: their learning rates would be 0 and nothing
    reads them, so the result is the same and a small edit is fast. Raises ValueError for a picture without what
    config.image_channels, or the LRM, asks for.
    """
    patch = config.patch
    mask = pictures.mask
    if mask is None:
        mask = torch.ones_like(pictures.edited[..., :1])
    # A patch weighs by its share of edited pixels: at the mask's edge it teaches less.
    views = AssetViews(pictures.cameras, pictures.edited, center=groups.center, half_extent=groups.half_extent)
    if config.tokenizer == "lrm":
        assert lrm is not None, "a model with an LRM"
        with torch.no_grad():  # frozen, as the paper has it
            tokens = lrm.tokenize(replace(views, depth=pictures.depth, alpha=pictures.alpha))
        pixels = tokens.unflatten(0, (len(pictures.cameras), -1))
    else:
        pixels = _patches(_channels(pictures, views, mask, config), patch)  # [V, L, p * p * C]
    weights = _patches(mask, patch).mean(2)  # [V, L]
    if not config.mask_tokens:
        lengths = torch.full((len(weights),), weights.shape[1], dtype=torch.int64)
        return PictureTokens(pixels.flatten(0, 1), torch.ones_like(weights).flatten(), lengths)
    # On the host, once per edit: what follows needs the sizes.
    edited = (weights > 0).cpu()
    index = edited.flatten().nonzero()[:, 0].to(pixels.device)
    return PictureTokens(pixels.flatten(0, 1)[index], weights.flatten()[index], edited.sum(1))


def _channels(pictures: Pictures, views: AssetViews, mask: Tensor, config: RefineConfig) -> Tensor:
    """[V, H, W, C] in the order of config.image_channels. views: the pictures in the asset's cube."""
    edited, half_extent = pictures.edited, views.half_extent
    origins, directions = rays(views)
    parts = []
    for name in config.image_channels:
        if name == "edited":
            parts.append(2 * edited - 1)
        elif name == "rays":
            parts += [directions, nearest_points(origins, directions).clamp(-4, 4)]
        elif name == "render":
            parts.append(2 * _present(pictures.render, name) - 1)
        elif name in ("geometry", "normals"):
            alpha = _present(pictures.alpha, name)
            along = _present(pictures.depth, name) / (half_extent * slants(pictures.cameras, directions))
            position = origins[:, None, None] + directions * along
            if name == "normals":
                parts.append(_normals(position, alpha, directions))
            else:
                parts += [position.clamp(-2, 2) * alpha, 2 * alpha - 1]
        else:
            parts.append(mask)
    return torch.cat(parts, dim=-1)


def _normals(position: Tensor, alpha: Tensor, directions: Tensor) -> Tensor:
    """[V, H, W, 3] unit normals towards the camera, times alpha, of positions [V, H, W, 3]: the cross product of
    central differences, after a mean over 3 x 3 pixels weighted by alpha. Zero where nothing is."""
    both = torch.cat([position * alpha, alpha], dim=-1).permute(0, 3, 1, 2)
    # Weighted by alpha, as positions beside the asset are no surface to average with.
    summed = F.avg_pool2d(F.pad(both, (2, 2, 2, 2), mode="replicate"), 3, stride=1).permute(0, 2, 3, 1)
    smooth = summed[..., :3] / summed[..., 3:].clamp(min=1e-4)
    across, down = smooth[:, 1:-1, 2:] - smooth[:, 1:-1, :-2], smooth[:, 2:, 1:-1] - smooth[:, :-2, 1:-1]
    normal = F.normalize(torch.linalg.cross(down, across), dim=-1)
    # The side that the camera sees: the sign of a cross product depends on the axes alone.
    away = (normal * directions).sum(-1, keepdim=True) > 0
    return torch.where(away, -normal, normal) * alpha


def _present(values: Tensor | None, name: str) -> Tensor:
    if values is None:
        raise ValueError(
            f"edit: this model's pictures have '{name}' channels; render the asset from their cameras first"
        )
    return values


def _patches(images: Tensor, patch: int) -> Tensor:
    """[V, H, W, C] -> [V, L, p * p * C], padded with zeros to whole patches."""
    height, width = images.shape[1:3]
    padded = F.pad(images, (0, 0, 0, -width % patch, 0, -height % patch))
    return patchify(padded, patch).unflatten(0, (len(images), -1))
